"""Drivers who differ: which of a law's parameters, by how much, and each driver's own."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

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
from nnode.population.followers import Followers, Paths, score_bias
from nnode.population.likelihood import Marginal, PushNoise, marginal
from nnode.simulation.rhs import formula_of

#: Bounds of standard deviations of logarithms of parameters, and where searches start.
LEAST_SPREAD, MOST_SPREAD, SPREAD = 1e-3, 1.0, 0.1
#: Share of an upper bound that an estimate is away from it at least; one that is nearer is none.
NEAR = 1e-3
#: A parameter differs between drivers if the data leave less than this share of its variance, in
#: the median over drivers.
SHRINKAGE = 0.7
#: Pushes: bounds of their standard deviation, and its start, by the law's order, in m/s or m/s².
PUSH = {1: (1e-4, 5.0, 0.2), 2: (1e-4, 5.0, 0.1)}
#: Bounds of the time that pushes last, in sampling intervals and as a share of the record: one that
#: lasts longer is a difference between drivers. Where searches start, s.
SHORT, LONG, LASTING = 1.0, 1 / 3, 3.0
#: Standard deviations of starts: of positions in errors of measurement, of speeds in m/s.
START_POSITION, START_SPEED = 3.0, (0.02, 3.0, 0.3)
#: Step of a parameter's logarithm at most, and how closely estimates converge.
LONGEST, TOLERANCE = 0.3, 1e-2
#: At most so many parameters are estimated to differ before the best is chosen.
RANKED = 2
#: Linearisations of each of these before the best is chosen. Most estimates converge in fewer; the
#: search for the chosen one is continued if it did not.
RANKING_STEPS = 15
#: Pairs of simulations that tell the bias. The error that two pairs leave is a fifth of an
#: estimate's standard error.
PAIRS = 2
#: Fewer followers say nothing of how drivers differ.
LEAST_DRIVERS = 5
#: s, longest step of the simulations, by the Runge-Kutta method of fourth order.
STEP = 0.2

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Population:
    """A calibrated law, and the drivers that it was calibrated to.

    Attributes:
        model: the law behind measured leaders.
        noise: pushes and errors of measurement.
        estimate: parameters, deviations, variances.
        bias: ``(P,)`` by how much the parameters were too large before they were corrected, in the
            scales in which they are varied.
    """

    model: Followers
    noise: PushNoise
    estimate: Estimate
    bias: np.ndarray

    @property
    def marginal(self) -> Marginal:
        """The likelihood, and what follows from it."""
        return self.estimate.marginal

    @property
    def random(self) -> list[str]:
        """Names of the parameters that differ between drivers."""
        return [self.model.names[q] for q in self.model.random]


def fit_drivers(
    system: System,
    paths: Paths,
    drivers: str | Iterable[str] = "auto",
    first: Mapping[str, float] | None = None,
    *,
    seed: int = 0,
    pairs: int = PAIRS,
) -> Population:
    """Calibrate a law to drivers who differ.

    Args:
        system: the law, with effects; a search starts at its parameters.
        paths: the followers.
        drivers: ``auto``: parameters of which the data tell how they differ; ``none``; or names,
            as ``T``.
        first: parameters by name, as ``idm.T``, where another search starts; that which ends at
            the larger likelihood counts.
        seed: of the simulations that tell the bias.
        pairs: of these simulations, see :func:`nnode.population.followers.score_bias`; 0: the
            estimates are not corrected, nor are those that did not converge.

    Raises:
        ConfigError: a name that the law does not have, a model without a formula, or simulations
            that blow up.
    """
    plain, noise = Followers(system, paths), PushNoise(paths.error)
    begin = plain(plain.start, np.zeros((0, 0)), np.zeros((0, 0)))
    if not np.isfinite(begin.columns).all():
        raise ConfigError(
            "drivers who differ: followers behind their measured leaders are not simulated to "
            f"finite positions in steps of {2 * paths.half:g} s; start from other parameters, or "
            "take drivers=none"
        )
    row = plain.natural(plain.start)
    other = [(first or {}).get(n, v) for n, v in zip(plain.names, row, strict=True)]
    starts = [plain.start] if first is None else [plain.start, plain.at(np.array(other))]
    law = plain.that_may_differ
    if drivers == "auto":
        found = _differing(_best(plain, noise, starts))
    else:
        names = [] if drivers == "none" else known_names(drivers, law)
        model = Followers(system, paths, names) if names else plain
        found = _best(model, noise, starts)
    sound = pairs > 0 and found.estimate.converged
    return _corrected(found, np.random.default_rng(seed), pairs) if sound else found


def obstacle(system: System, sequences: list[Sequence]) -> str | None:
    """Why drivers who differ have no place in a model or in its data; None: they have."""
    physical = sum(value.numel() for value, _ in system.physical().values())
    if system.domain != "traffic":
        return "people meet everybody in their sequence, and only cars follow measured leaders"
    if sum(p.numel() for p in system.parameters() if p.requires_grad) > physical:
        return "the model contains a network, whose weights are no quantities of a driver"
    lane = formula_of(system)
    if lane is None:
        return "the model is no formula of a lane"
    if any(name not in ("x", "v") for name, _ in lane.ahead):
        return "the model reads what other drivers remember, which was not measured"
    if "dt" in getattr(system.formula, "symbols", ()):
        return "the law is a map from step to step"
    number = sum(s.n_agents - 1 for s in sequences)
    if number < LEAST_DRIVERS:
        return f"there are {number} followers behind measured leaders, fewer than {LEAST_DRIVERS}"
    if not np.ptp([s.dt for s in sequences]) < 1e-6:
        return "the sequences have different sampling intervals"
    return None


def fit_again(before: Population, system: System, paths: Paths, *, fixed: bool) -> Population:
    """Calibrate another model to drivers, from an estimate of a model of the same law.

    Args:
        before: where the search starts; further parameters may differ.
        system, paths: the model and the followers.
        fixed: only deviations are estimated; parameters are the system's, variances those before.
    """
    model, known = Followers(system, paths, before.random), before.estimate
    variances = _started(known.variances, model)
    same = before.model.paths.names == paths.names
    same &= known.start.shape == (len(paths.agent), model.starts)
    modes = (known.agents, known.start) if same else (None, None)
    if not fixed:
        return _differing(_estimated(model, before.noise, model.start, variances, *modes))
    agents, start = modes
    found = fit_deviations(model, before.noise, model.start, variances, agents=agents, start=start)
    return replace(before, model=model, estimate=found, bias=np.zeros(len(model.start)))


def known_names(drivers: Iterable[str], law: Iterable[str]) -> list[str]:
    """Names of a law's parameters, with the law's, from those without.

    Args:
        law: the parameters' names with the law's, as ``idm.T``.

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


def _corrected(found: Population, rng: np.random.Generator, pairs: int) -> Population:
    """Without the bias of the parameters that simulations of the estimated model show.

    The linearisation at the modes and the errors of smoothed leaders shift estimates. Standard
    deviations stay as they are: their bias is smaller than what few simulations add to their error.
    """
    model, noise, before = found.model, found.noise, found.estimate
    try:
        bias = score_bias(model, noise, before, rng, pairs)
    except (SimulationError, np.linalg.LinAlgError):  # drawn drivers whose simulations blow up
        log.warning("parameters are not corrected for their bias: simulated drivers left the road")
        return found
    bias = np.clip(bias, -LONGEST, LONGEST)
    theta = np.clip(before.theta - bias, model.low, model.high)
    there = fit_deviations(model, noise, theta, before.variances)
    there = replace(there, converged=before.converged)
    return replace(found, estimate=there, bias=before.theta - theta)


def _estimated(
    model: Followers,
    noise: PushNoise,
    theta: np.ndarray,
    variances: Variances,
    agents: np.ndarray | None = None,
    start: np.ndarray | None = None,
    steps: int = STEPS,
) -> Population:
    """The estimate of a model; the search starts at parameters, standard deviations and, where they
    are given, deviations of drivers and of starts."""
    found = estimate(
        model,
        noise,
        theta,
        variances,
        low=model.low,
        high=model.high,
        longest=LONGEST,
        tolerance=TOLERANCE,
        agents=agents,
        start=start,
        steps=steps,
    )
    return Population(model=model, noise=noise, estimate=found, bias=np.zeros(len(found.theta)))


def _best(model: Followers, noise: PushNoise, starts: list[np.ndarray]) -> Population:
    """The estimate of a model from several starts, that of the largest likelihood."""
    found = [_estimated(model, noise, theta, _variances(model)) for theta in starts]
    return max(found, key=lambda one: one.marginal.loglik)


def _differing(best: Population) -> Population:
    """With those further parameters that differ between drivers, as far as the data tell.

    Parameters are added one after the other, while twice the logarithm of the marginal likelihood
    rises by more than the logarithm of the number of drivers (Schwarz's criterion). Candidates are
    ranked by the marginal likelihood of the samples as they are linearised without them, with
    variances of their own; the best two are then estimated.
    """
    price = math.log(max(len(best.model.paths.names), 2)) / 2
    while (better := _better(best, price)) is not None:
        best = better
    return best


def _better(best: Population, price: float) -> Population | None:
    """With one more parameter that differs; None: no parameter raises the likelihood enough."""
    limit = best.marginal.loglik + price
    left = [name for name in best.model.that_may_differ if name not in best.random]
    ranked = [(_linearised(best, name), name) for name in left]
    tried = [name for value, name in sorted(ranked, reverse=True) if value > limit]
    better: list[Population] = []
    for name in tried:
        system, paths = best.model.system, best.model.paths
        model, before = Followers(system, paths, [*best.random, name]), best.estimate
        variances = _widened(before.variances)
        found = _estimated(model, best.noise, before.theta, variances, steps=RANKING_STEPS)
        if _differs(found.estimate) and found.marginal.loglik > limit:
            better.append(found)
        if len(better) == RANKED:
            break
    chosen = max(better, key=lambda one: one.marginal.loglik, default=None)
    if chosen is None or chosen.estimate.converged:
        return chosen
    there = chosen.estimate
    modes = there.agents, there.start
    return _estimated(chosen.model, best.noise, there.theta, there.variances, *modes)


def _linearised(best: Population, name: str) -> float:
    """The logarithm of the marginal likelihood with one more parameter that differs, the samples'
    linearisation kept."""
    model, found = best.model, best.estimate
    random = [*model.random, model.names.index(name)]
    data = replace(found.data, random=found.data.fixed[..., random])
    variances = fit_variances(data, best.noise, _widened(found.variances), tolerance=TOLERANCE)
    products = best.noise.products(data, variances.noise)
    return marginal(data, products, variances.spread, variances.start).loglik


def _differs(found: Estimate) -> bool:
    """Whether the data tell how each of the parameters differs."""
    told = np.median(found.marginal.shrinkage, 0) < SHRINKAGE
    return bool((told & (found.variances.spread < (1 - NEAR) * MOST_SPREAD)).all())


def _variances(model: Followers) -> Variances:
    paths, order = model.paths, model.lane.order
    number, length = len(model.random), paths.dt * paths.x.shape[1]
    low_push, high_push, push = PUSH[order]
    short, long = SHORT * paths.dt, max(LONG * length, 2 * SHORT * paths.dt)
    position = START_POSITION * paths.error
    low_speed, high_speed, speed = START_SPEED
    starts, least, most = [position], [position], [position]
    for _ in range(model.starts - 1):  # of speeds, and of what terms remember
        starts, least, most = [*starts, speed], [*least, low_speed], [*most, high_speed]
    return Variances(
        noise=np.array([push, np.clip(LASTING, short, long)]),
        spread=np.full(number, SPREAD),
        start=np.array(starts),
        low=np.array([low_push, short, *[LEAST_SPREAD] * number, *least]),
        high=np.array([high_push, long, *[MOST_SPREAD] * number, *most]),
    )


def _started(variances: Variances, model: Followers) -> Variances:
    """With the standard deviations of as many starts as a model has."""
    number, usual = len(variances.start), _variances(model)
    if number == model.starts:
        return variances
    kept = min(number, model.starts)
    start = np.append(variances.start[:kept], usual.start[kept:])
    ends = len(variances.row) - number
    low = np.append(variances.low[:ends], usual.low[-model.starts :])
    high = np.append(variances.high[:ends], usual.high[-model.starts :])
    return replace(variances, start=start, low=low, high=high)


def _widened(variances: Variances) -> Variances:
    """With one more parameter that differs. Pushes that last as long as they may stood in for
    that, and the search begins with others."""
    at = len(variances.noise) + len(variances.spread)
    push, lasts = variances.noise
    if lasts >= (1 - NEAR) * variances.high[1]:
        push, lasts = push / 2, np.clip(LASTING, *np.stack([variances.low, variances.high])[:, 1])
    return replace(
        variances,
        noise=np.array([push, lasts]),
        spread=np.append(variances.spread, SPREAD),
        low=np.insert(variances.low, at, LEAST_SPREAD),
        high=np.insert(variances.high, at, MOST_SPREAD),
    )
