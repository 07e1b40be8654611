"""Mixed-effects calibration: random effects of drivers, their variances and their modes."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nnode.calibrate.parameters import with_parameters
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError, SimulationError
from nnode.model.system import System
from nnode.population.estimate import (
    STEPS,
    Estimate,
    Variances,
    estimate,
    fit_deviations,
    fit_variances,
)
from nnode.population.followers import (
    FLOOR,
    PAIRS,
    Followers,
    Paths,
    score_biases,
    simulated_pairs,
    variance_biases,
)
from nnode.population.likelihood import Linearised, Marginal, PushNoise, marginal
from nnode.simulation.rhs import formula_of

#: Bounds of standard deviations of logarithms of parameters, and where searches start.
LEAST_SPREAD, MOST_SPREAD, SPREAD = 1e-3, 1.0, 0.1
#: An estimate within this share of an upper bound counts as being at the bound.
NEAR = 1e-3
#: Pushes: bounds of their standard deviation, and its start, by the law's order, in m/s or m/s².
PUSH = {1: (1e-4, 5.0, 0.2), 2: (1e-4, 5.0, 0.1)}
#: Bounds of the correlation time of pushes, in sampling intervals and as a share of the record (a
#: longer one is a difference between drivers), and where searches start, s.
SHORT, LONG, LASTING = 1.0, 1 / 3, 3.0
#: Standard deviations of starts: of positions in standard deviations of the measurement errors; of
#: speeds the bounds and the start of searches, m/s.
START_POSITION, START_SPEED = 3.0, (0.02, 3.0, 0.3)
#: Largest step of a parameter's logarithm, and the tolerance of estimates.
LONGEST, TOLERANCE = 0.3, 1e-2
#: Tolerance of estimates that only have to show the best of several starts, whose log likelihoods
#: usually differ by hundreds.
ROUGH = 1.0
#: Bounds of standard deviations of errors of positions, m, and of the correlation time of
#: autocorrelated ones, s.
ERRORS, ERROR_TIMES = (0.001, 1.0), (0.1, 5.0)
#: Correlation times of errors where searches start, s. From a single start of 1 s, errors behind
#: ``lin`` were attributed to shorter pushes, see docs/method.md.
ERROR_TIME_STARTS = (0.3, 3.0)
#: At most so many candidate random effects are estimated before the best is chosen.
RANKED = 2
#: Linearisations of each of these before the best is chosen. Most estimates converge in fewer. If
#: the chosen one did not, its search is continued.
RANKING_STEPS = 15
#: With fewer followers, variances between drivers are not estimated.
LEAST_DRIVERS = 5
#: Pushes above this share of the standard deviation of measured rates show that a missing effect,
#: or errors of positions, are attributed to them. Simulations by ``lin`` and ``idm`` without errors
#: and with their effects: 0.16 to 0.35; without a hidden zone: 0.7 to 1.1. Smoothed
#: measurements (NGSIM, TGSIM, Waymo): 0.44 to 5.7.
EXPLAINED = 0.4
#: Number of sequences that decide whether positions without errors were smoothed.
CHECKED = 20
#: Longest step of the simulations, s, by the Runge-Kutta method of fourth order.
STEP = 0.2

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Population:
    """A calibrated mixed-effects model of drivers.

    Attributes:
        model: the law behind measured leaders.
        estimate: parameters, deviations, variances.
        bias: ``(P,)`` the bias that was subtracted from the parameters, in the scales in which
            they are varied.
        variance_bias, variance_error: ``(V,)`` the factors by which standard deviations and times
            were divided, in the order of :attr:`~nnode.population.estimate.Variances.row`, and the
            standard errors of their logarithms.
    """

    model: Followers
    estimate: Estimate
    bias: np.ndarray
    variance_bias: np.ndarray
    variance_error: np.ndarray

    @classmethod
    def uncorrected(cls, model: Followers, estimate: Estimate) -> Population:
        """An estimate without correction of its bias."""
        row = estimate.variances.row
        return cls(
            model=model,
            estimate=estimate,
            bias=np.zeros_like(estimate.theta),
            variance_bias=np.ones_like(row),
            variance_error=np.zeros_like(row),
        )

    @property
    def marginal(self) -> Marginal:
        """The marginal likelihood and the quantities derived from it."""
        return self.estimate.marginal

    @property
    def system(self) -> System:
        """The model with the estimated parameters of the typical driver."""
        row = self.model.natural(self.estimate.theta)
        return with_parameters(self.model.system, row)

    @property
    def random(self) -> list[str]:
        """Names of the parameters that differ between drivers."""
        return [self.model.names[q] for q in self.model.random]

    @property
    def plausible(self) -> bool:
        """Whether pushes are small compared to the rates and shorter than the longest allowed.
        Others stand for a deviation of the law."""
        variances = self.estimate.variances
        short = bool(variances.noise[1] < (1 - NEAR) * variances.high[1])
        return short and self.explains_rates

    @property
    def explains_rates(self) -> bool:
        """Whether pushes are small compared to the variation of the highest rate of the followers'
        smoothed paths, see :data:`EXPLAINED`. Otherwise positions without errors are not those of a
        simulation by a similar model."""
        paths, rates = self.model.paths, []
        for sequence, place in zip(paths.sequence, paths.place, strict=True):
            rate = np.gradient(paths.smoothed[sequence][:, place], paths.dt)
            first_order = self.model.lane.order == 1
            rates.append(rate - rate.mean() if first_order else np.gradient(rate, paths.dt))
        variation = float(np.sqrt(np.mean(np.concatenate(rates) ** 2)))
        return float(self.estimate.variances.noise[0]) <= EXPLAINED * variation

    @property
    def criterion(self) -> float:
        """Log marginal likelihood minus half the number of parameters times the logarithm of the
        number of drivers (BIC); the larger the better."""
        variances = self.estimate.variances
        number = len(self.estimate.theta) + np.count_nonzero(variances.low < variances.high)
        return self.marginal.loglik - number * _price(len(self.estimate.agents))


def fit_drivers(
    system: System,
    paths: Paths,
    drivers: str | Iterable[str] = "auto",
    first: Mapping[str, float] | None = None,
    *,
    seed: int = 0,
    pairs: int = PAIRS,
) -> Population:
    """Calibrate a mixed-effects model: a law whose parameters differ between drivers.

    Args:
        system: the law, with effects; a search starts at its parameters.
        paths: the followers.
        drivers: ``auto``: random effects are selected; ``none``; or names, such as ``T``.
        first: parameters by name, such as ``idm.T``, where a second search starts; the result with
            the larger likelihood is taken.
        seed: of the simulations that estimate the bias.
        pairs: of these simulations, see :func:`nnode.population.followers.simulated_pairs`; 0: the
            estimates are not corrected. Estimates that did not converge are never corrected.

    Raises:
        ConfigError: a name that the law does not have, a model without a formula, or simulations
            that blow up.
        SimulationError: the linear response diverges at all starts.
    """
    plain = Followers(system, paths)
    if not _simulated_finitely(plain):
        raise ConfigError(
            "drivers who differ: followers behind their measured leaders are not simulated to "
            f"finite positions in steps of {2 * paths.half:g} s; start from other parameters, or "
            "take drivers=none"
        )
    row = plain.natural(plain.start)
    alternative = [(first or {}).get(n, v) for n, v in zip(plain.names, row, strict=True)]
    starts = [plain.start] if first is None else [plain.start, plain.at(np.array(alternative))]
    names = [] if drivers in ("auto", "none") else full_names(drivers, plain.may_differ)
    alike = _with_lasting_errors(_most_likely(plain, starts))
    if drivers == "auto":
        population = with_random_effects(alike)
        better = _with_lasting_errors(population)
        population = population if better is population else with_random_effects(better)
    else:
        population = _with_lasting_errors(_with_named_effects(alike, names)) if names else alike
    return bias_corrected(population, seed, pairs) if pairs else population


def _simulated_finitely(model: Followers) -> bool:
    """Whether the paths from a model's start parameters, and their derivatives, are finite."""
    initial = model(model.start, np.zeros((0, 0)), np.zeros((0, 0)))
    return bool(np.isfinite(initial.columns).all())


def at_steps(sequences: list[Sequence]) -> list[Sequence]:
    """Sequences with samples as far apart as steps of the simulations allow."""
    stride = max(1, int(STEP / sequences[0].dt + 1e-9))
    return [s.every(stride) for s in sequences]


def with_smaller_errors(population: Population) -> Population:
    """The estimate in which measurement errors may be smaller than was assumed. Errors that are too
    large lengthen the pushes."""
    before, variances = population.estimate, population.estimate.variances
    low = variances.low.copy()
    low[2] = ERRORS[0]
    variances = replace(variances, low=low)
    return _estimated(population.model, before.theta, variances, before.agents, before.start)


def fit_all_random(starts: Iterable[tuple[System, Paths]]) -> Population:
    """A quick estimate in which all parameters of the law differ between drivers, for a comparison
    of laws. The variances of those that do not differ become small.

    Args:
        starts: the law with different parameters, and its followers. The search continues from
            those that are most likely after one step.

    Raises:
        ConfigError: a model without a formula.
        SimulationError: the simulations of all starts diverge.
    """
    quick = list[Population]()
    for system, paths in starts:
        plain = Followers(system, paths)
        model = plain.with_random(plain.may_differ)
        with suppress(SimulationError, np.linalg.LinAlgError):
            if _simulated_finitely(plain):
                variances = initial_variances(model)
                quick.append(_estimated(model, model.start, variances, steps=1, tolerance=ROUGH))
    if not quick:
        raise SimulationError("the followers' paths diverge from all starts")
    return _continued(max(quick, key=lambda fit: fit.marginal.loglik), RANKING_STEPS)


def no_drivers(system: System) -> str | None:
    """Why the parameters of a model are not those of single drivers; None if they are."""
    physical = sum(value.numel() for value, _ in system.physical().values())
    if system.domain != "traffic":
        return "people meet everybody in their sequence, and only cars follow measured leaders"
    if sum(p.numel() for p in system.parameters() if p.requires_grad) > physical:
        return "the model contains a network, whose weights are no quantities of a driver"
    return None


def obstacle(system: System, sequences: list[Sequence], needed: int = LEAST_DRIVERS) -> str | None:
    """Why drivers who differ cannot be estimated for a model or its data; None if they can.

    Args:
        needed: number of followers.
    """
    reason = no_drivers(system)
    if reason is not None:
        return reason
    lane = formula_of(system)
    if lane is None:
        return "the model is no formula of a lane"
    if any(name not in ("x", "v") for name, _ in lane.ahead):
        return "the model reads what other drivers remember, which was not measured"
    if system.is_map:
        return "the law is a map from step to step"
    n_followers = sum(s.n_agents - 1 for s in sequences)
    if n_followers < needed:
        return f"there are {n_followers} followers behind measured leaders, fewer than {needed}"
    if not np.ptp([s.dt for s in sequences]) < 1e-6:
        return "the sequences have different sampling intervals"
    return None


def refit(before: Population, system: System, paths: Paths, *, fixed: bool) -> Population:
    """Calibrate another model of the same law, starting from an earlier estimate.

    Args:
        before: where the search starts; its random effects are kept.
        system, paths: the model and the followers.
        fixed: only estimate deviations, with the system's parameters and the earlier variances.
    """
    model, previous = Followers(system, paths).with_random(before.random), before.estimate
    variances = _with_starts(previous.variances, model)
    same_followers = before.model.paths.names == paths.names
    same_followers &= previous.start.shape == (len(paths.agent), model.starts)
    modes = (previous.agents, previous.start) if same_followers else (None, None)
    if not fixed:
        return _estimated(model, model.start, variances, *modes)
    agents, start = modes
    deviations = fit_deviations(
        model, PushNoise(), model.start, variances, agents=agents, start=start
    )
    return Population.uncorrected(model, deviations)


def full_names(drivers: Iterable[str], law: Iterable[str]) -> list[str]:
    """Full names of a law's parameters, from their short names.

    Args:
        law: the full names, such as ``idm.T``.

    Raises:
        ConfigError: a name that the law does not have.
    """
    short = {name.rpartition(".")[2]: name for name in law}
    unknown = [name for name in drivers if name not in short]
    if unknown:
        raise ConfigError(
            f"drivers={unknown[0]} is no parameter of the law that can differ; expected auto, "
            f"none, or some of {', '.join(short)}"
        )
    return [short[name] for name in drivers]


class Biases(NamedTuple):
    """Biases of estimates in simulations, a row per antithetic pair.

    Attributes:
        theta: see :func:`nnode.population.followers.score_biases`.
        variances: see :func:`nnode.population.followers.variance_biases`.
    """

    theta: np.ndarray
    variances: np.ndarray


def corrected_biases(population: Population, seed: int, pairs: int) -> Biases:
    """Biases of the estimates, by simulation.

    The linearisation at the modes and the errors of smoothed leaders bias the estimates. The biases
    of parameters are computed again with once corrected estimates, which halves what one correction
    leaves of the bias of v0 of ``idm``. A second correction of the standard deviations would
    amplify their sampling errors (tables in docs/method.md).

    Args:
        seed, pairs: see :func:`nnode.population.followers.simulated_pairs`.

    Raises:
        SimulationError: drawn drivers leave the road.
    """
    simulated = simulated_pairs(population.model, population.estimate, seed, pairs)
    first = Biases(score_biases(simulated), variance_biases(simulated))
    once = _corrected(population, first)
    again = simulated_pairs(population.model, once, seed, pairs)
    return first._replace(theta=score_biases(again))


def bias_corrected(population: Population, seed: int, pairs: int) -> Population:
    """The estimate, corrected for the bias of its parameters and variances; the same if it did not
    converge or if simulations diverge."""
    before = population.estimate
    if not before.converged:
        return population
    try:
        biases = corrected_biases(population, seed, pairs)
        corrected = _corrected(population, biases)
    except (SimulationError, np.linalg.LinAlgError):  # drawn drivers whose simulations blow up
        log.warning("parameters are not corrected for their bias: simulated drivers left the road")
        return population
    ratios = biases.variances
    return replace(
        population,
        estimate=replace(corrected, converged=before.converged),
        bias=before.theta - corrected.theta,
        variance_bias=before.variances.row / corrected.variances.row,
        variance_error=ratios.std(0, ddof=1) / math.sqrt(pairs) / ratios.mean(0),
    )


def _corrected(population: Population, biases: Biases) -> Estimate:
    """The deviations of drivers and starts with parameters and variances that are corrected by the
    mean of biases."""
    model, before = population.model, population.estimate
    bias = np.clip(biases.theta.mean(0), -LONGEST, LONGEST)
    theta = np.clip(before.theta - bias, model.low, model.high)
    variances = before.variances
    row = np.clip(variances.row / biases.variances.mean(0), variances.low, variances.high)
    return fit_deviations(model, PushNoise(), theta, variances.filled(row))


def _estimated(
    model: Followers,
    theta: np.ndarray,
    variances: Variances,
    agents: np.ndarray | None = None,
    start: np.ndarray | None = None,
    steps: int = STEPS,
    tolerance: float = TOLERANCE,
) -> Population:
    """The estimate of a model, from given parameters, standard deviations and, optionally,
    deviations of drivers and of starts."""
    result = estimate(
        model,
        PushNoise(),
        theta,
        variances,
        low=model.low,
        high=model.high,
        longest=LONGEST,
        tolerance=tolerance,
        agents=agents,
        start=start,
        steps=steps,
    )
    return Population.uncorrected(model, result)


def _most_likely(model: Followers, starts: list[np.ndarray]) -> Population:
    """The estimate with the largest likelihood from several starts.

    Raises:
        SimulationError: the linear response diverges at all of them.
    """
    fits = list[Population]()
    for theta in starts:
        with suppress(SimulationError):
            fits.append(_estimated(model, theta, initial_variances(model)))
    if not fits:
        raise SimulationError(
            "drivers who differ: small changes of the followers' simulated paths grow without "
            "bound; start from other parameters, or take drivers=none"
        )
    return max(fits, key=lambda fit: fit.marginal.loglik)


def _price(agents: int) -> float:
    """Increase of the log likelihood that one more parameter needs (Schwarz 1978)."""
    return math.log(max(agents, 2)) / 2


def _with_lasting_errors(best: Population) -> Population:
    """The estimate with autocorrelated errors of measurement, if they raise the log likelihood by
    more than two parameters need; otherwise the same. White errors, which fourth differences then
    overestimate, are estimated with them."""
    before, model = best.estimate, best.model
    push, push_time, white, *lasting = before.variances.noise
    if lasting:
        return best
    low, high = before.variances.low.copy(), before.variances.high.copy()
    low[2], high[2] = ERRORS
    only_white = replace(before.variances, low=low, high=high)
    extended = replace(
        before.variances,
        low=np.insert(low, 3, [ERRORS[0], ERROR_TIMES[0]]),
        high=np.insert(high, 3, [ERRORS[1], ERROR_TIMES[1]]),
    )
    limit = _refitted(best, before.data, only_white)[0] + 2 * _price(len(before.agents))
    refitted = []
    for time in ERROR_TIME_STARTS:
        start = replace(extended, noise=np.array([push, push_time, white, white, time]))
        refitted.append(_refitted(best, before.data, start))
    loglik, variances = max(refitted, key=lambda fit: fit[0])
    if loglik <= limit:
        return best
    estimated = _estimated(model, before.theta, variances, before.agents, before.start)
    return estimated if estimated.marginal.loglik > limit else best


def likeliest(populations: Iterable[Population]) -> Population:
    """The estimate with the best BIC. The variances of a model that lacks an effect would attribute
    it to autocorrelated pushes, which would hide it."""
    return max(populations, key=lambda population: population.criterion)


def with_random_effects(best: Population) -> Population:
    """Forward selection of random effects, then backward elimination.

    Random effects are added while twice the log marginal likelihood rises by more than the
    logarithm of the number of drivers (BIC, Schwarz 1978). Candidates are ranked by the marginal
    likelihood of the samples as linearised without them, with refitted variances; then the best two
    are estimated. Then those are removed without which the likelihood falls by less. They were
    needed only before others were added, or imitated an effect that the model lacked before.
    """
    price = _price(len(best.model.paths.names))
    while (better := _next_random_effect(best, price)) is not None:
        best = better
    while (smaller := _without_least_needed(best, price)) is not None:
        best = smaller
    return best


def _with_named_effects(alike: Population, names: list[str]) -> Population:
    """The estimate in which parameters differ between drivers, from that of drivers alike."""
    model, before = alike.model.with_random(names), alike.estimate
    variances = before.variances
    for _ in names:
        variances = _with_random_effect(variances)
    return _estimated(model, before.theta, variances)


def _next_random_effect(best: Population, price: float) -> Population | None:
    """The estimate with one more random effect; None if none raises the likelihood enough."""
    limit = best.marginal.loglik + price
    remaining = [name for name in best.model.may_differ if name not in best.random]
    ranked = [(_linearised_loglik(best, name), name) for name in remaining]
    candidates = [name for value, name in sorted(ranked, reverse=True) if value > limit]
    improved: list[Population] = []
    for name in candidates:
        model, before = best.model.with_random([*best.random, name]), best.estimate
        variances = _with_random_effect(before.variances)
        try:
            fit = _estimated(model, before.theta, variances, steps=RANKING_STEPS)
        except SimulationError:
            continue
        bounded = (fit.estimate.variances.spread < (1 - NEAR) * MOST_SPREAD).all()
        if bounded and fit.marginal.loglik > limit:
            improved.append(fit)
        if len(improved) == RANKED:
            break
    chosen = max(improved, key=lambda fit: fit.marginal.loglik, default=None)
    return chosen if chosen is None or chosen.estimate.converged else _continued(chosen)


def _continued(population: Population, steps: int = STEPS) -> Population:
    """The estimate after further steps."""
    last = population.estimate
    modes = last.agents, last.start
    return _estimated(population.model, last.theta, last.variances, *modes, steps)


def _without_least_needed(best: Population, price: float) -> Population | None:
    """The estimate without the random effect that raises the likelihood least; None if all raise it
    enough."""
    model, before = best.model, best.estimate
    limit = best.marginal.loglik - price
    reduced = list[tuple[float, int, Variances]]()
    for place in range(len(model.random)):
        data = replace(before.data, random=np.delete(before.data.random, place))
        loglik, variances = _refitted(best, data, _without_random_effect(before.variances, place))
        reduced.append((loglik, place, variances))
    if not reduced:
        return None
    loglik, place, variances = max(reduced)
    if loglik < limit:
        return None
    smaller = model.with_random(np.delete(best.random, place))
    agents = np.delete(before.agents, place, 1)
    fit = _estimated(smaller, before.theta, variances, agents, before.start)
    return fit if fit.marginal.loglik >= limit else None


def _linearised_loglik(best: Population, name: str) -> float:
    """The log marginal likelihood with one more random effect, at the present linearisation."""
    model, previous = best.model, best.estimate
    random = [*model.random, model.names.index(name)]
    data = replace(previous.data, random=np.array(random))
    return _refitted(best, data, _with_random_effect(previous.variances))[0]


def _refitted(best: Population, data: Linearised, variances: Variances) -> tuple[float, Variances]:
    """The log marginal likelihood of linearised samples with refitted variances, and these."""
    theta, model = best.estimate.theta, best.model
    bounds = {"low": model.low - theta, "high": model.high - theta}
    refitted = fit_variances(data, PushNoise(), variances, tolerance=TOLERANCE, **bounds)
    products = PushNoise().products(data, refitted.noise)
    result = marginal(data, products, refitted.spread, refitted.start, **bounds)
    return result.loglik, refitted


def initial_variances(model: Followers) -> Variances:
    """Standard deviations and times where a search starts, and their bounds."""
    paths, order = model.paths, model.lane.order
    number, length = len(model.random), paths.dt * paths.x.shape[1]
    low_push, high_push, push = PUSH[order]
    short, long = SHORT * paths.dt, max(LONG * length, 2 * SHORT * paths.dt)
    position = START_POSITION * paths.error
    low_error = paths.error if paths.error > FLOOR else ERRORS[0]
    low_speed, high_speed, speed = START_SPEED
    starts, lowest, highest = [position], [position], [position]
    for _ in range(model.starts - 1):  # of speeds, and of what terms remember
        starts, lowest, highest = [*starts, speed], [*lowest, low_speed], [*highest, high_speed]
    return Variances(
        noise=np.array([push, np.clip(LASTING, short, long), paths.error]),
        spread=np.full(number, SPREAD),
        start=np.array(starts),
        low=np.array([low_push, short, low_error, *[LEAST_SPREAD] * number, *lowest]),
        high=np.array([high_push, long, paths.error, *[MOST_SPREAD] * number, *highest]),
    )


def _with_starts(variances: Variances, model: Followers) -> Variances:
    """Variances with as many standard deviations of starts as a model needs."""
    n_starts, defaults = len(variances.start), initial_variances(model)
    if n_starts == model.starts:
        return variances
    kept = min(n_starts, model.starts)
    start = np.append(variances.start[:kept], defaults.start[kept:])
    ends = len(variances.row) - n_starts
    low = np.append(variances.low[:ends], defaults.low[-model.starts :])
    high = np.append(variances.high[:ends], defaults.high[-model.starts :])
    return replace(variances, start=start, low=low, high=high)


def _with_random_effect(variances: Variances) -> Variances:
    """Variances with one more random effect. If the correlation time of the pushes is at its bound,
    it stood in for this effect, and the search restarts with a shorter one."""
    at = len(variances.noise) + len(variances.spread)
    push, push_time, *error = variances.noise
    if push_time >= (1 - NEAR) * variances.high[1]:
        push, push_time = push / 2, np.clip(LASTING, variances.low[1], variances.high[1])
    return replace(
        variances,
        noise=np.array([push, push_time, *error]),
        spread=np.append(variances.spread, SPREAD),
        low=np.insert(variances.low, at, LEAST_SPREAD),
        high=np.insert(variances.high, at, MOST_SPREAD),
    )


def _without_random_effect(variances: Variances, place: int) -> Variances:
    """Variances without one of the random effects."""
    at = len(variances.noise) + place
    low, high = np.delete(variances.low, at), np.delete(variances.high, at)
    return replace(variances, spread=np.delete(variances.spread, place), low=low, high=high)
