"""Estimation of mixed-effects models with autocorrelated disturbances.

Two steps alternate until convergence. The first maximises the marginal likelihood of the linearised
samples over the variances. The second minimises the penalised sum of squares

    (y - f)' V0^-1 (y - f) + b' Omega^-1 b + h' S^-1 h

over the parameters, the deviations of agents and those of starts (the empirical Bayes modes), by a
Gauss-Newton step. The step is halved until the sum falls, also separately for agents whose own sum
rises. A step that reverses the previous one is shortened too, because the covariance changes with
the parameters and the steps might cycle.

Source: Lindstrom & Bates 1990, Biometrics 46; Wolfinger & Lin 1997, Comput. Stat. Data Anal. 25.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaincinv

from nnode.errors import SimulationError
from nnode.population.likelihood import (
    Linearised,
    Marginal,
    Noise,
    Products,
    log_likelihood,
    marginal,
)

#: Difference of logarithms of standard deviations for derivatives.
DIFFERENCE = 1e-6
#: Largest number of halvings of a step.
HALVINGS = 6
#: Tolerance of deviations with given parameters and variances, see :func:`estimate`.
MODES = 0.02
#: Largest number of steps of a search. Most converge in 6 to 16. The variances of a zone with free
#: ends may need more: with 20 steps, the log likelihood of one ended at 25,152 in place of 26,914.
STEPS = 40
#: A search ends when the log likelihood has not exceeded its maximum for so many steps, for example
#: because the steps cycle around a kink of the model. It counts as converged if all of these steps
#: remained within the confidence region of this level around the maximum. A first step without
#: deviations of agents does not count: its linearisation can be far too optimistic.
PATIENCE, REGION = 10, 0.95
#: The smallest relaxation factor of steps that reverse the previous one.
LEAST = 0.2


class Response(Protocol):
    """A model of agents, simulated and linearised."""

    def __call__(self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        """The samples, linearised.

        Args:
            theta: ``(P,)`` parameters.
            agents: ``(D, Q)`` deviations of the agents.
            start: ``(S, H)`` deviations of the segments' starts.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Variances:
    """Standard deviations, and the correlation times of disturbances.

    Attributes:
        noise: of the :class:`~nnode.population.likelihood.Noise`, in the order of its names.
        spread: ``(Q,)`` of the agents' deviations.
        start: ``(H,)`` of the starts' deviations.
        low, high: bounds of all of them, concatenated; values with equal bounds are fixed. Within
            bounds that are many orders of magnitude apart, a search may end at values for which
            rounding errors dominate the likelihood.
    """

    noise: np.ndarray
    spread: np.ndarray
    start: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def row(self) -> np.ndarray:
        """All of them."""
        return np.concatenate([self.noise, self.spread, self.start])

    def filled(self, row: np.ndarray) -> Variances:
        """With other values."""
        ends = np.cumsum([len(self.noise), len(self.spread)])
        noise, spread, start = np.split(row, ends)
        return replace(self, noise=noise, spread=spread, start=start)


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """An estimate of a mixed-effects model.

    Attributes:
        theta: ``(P,)`` parameters.
        agents: ``(D, Q)`` deviations of the agents. start: ``(S, H)`` of the starts.
        variances: standard deviations.
        data: the samples, linearised at the estimate.
        marginal: the marginal likelihood at the estimate.
        steps: number of linearisations.
        converged: whether the last step was below the tolerance, or the last ones remained close
            to the maximum, see :data:`PATIENCE`. If the last step was not, the estimate is the
            iterate with the largest likelihood.
    """

    theta: np.ndarray
    agents: np.ndarray
    start: np.ndarray
    variances: Variances
    data: Linearised
    marginal: Marginal
    steps: int
    converged: bool


def estimate(
    response: Response,
    noise: Noise,
    theta: np.ndarray,
    variances: Variances,
    *,
    low: np.ndarray | None = None,
    high: np.ndarray | None = None,
    restricted: bool = False,
    longest: float = np.inf,
    steps: int = STEPS,
    tolerance: float = 1e-3,
    agents: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> Estimate:
    """Estimate a mixed-effects model.

    Args:
        response: the model.
        noise: the residual covariance.
        theta: ``(P,)`` where the search starts.
        variances: where it starts, and bounds.
        low, high: ``(P,)`` bounds of the parameters.
        restricted: REML, for few agents.
        longest: largest step of a parameter, in its own unit.
        steps: largest number of steps; halving one takes further linearisations.
        tolerance: the search ends when a step moves no parameter by more than this share of its
            standard error, no standard deviation by more than this share of itself, and the agents'
            deviations, root mean square, by no more than this share of their standard deviation.
            Single agents may cycle around kinks of the model without effect on the other estimates.
        agents, start: ``(D, Q)``, ``(S, H)`` deviations that the search starts from; by default 0.

    Raises:
        SimulationError: the linear response diverges where the search starts.
    """
    theta = np.array(theta, dtype=float)
    low = np.full(len(theta), -np.inf) if low is None else low
    high = np.full(len(theta), np.inf) if high is None else high
    empty = np.zeros((0, 0))
    data = response(theta, empty if agents is None else agents, empty if start is None else start)
    converged, stalled, n_linearisations = False, False, 1
    n_agents = int(data.agent.max()) + 1
    agents = np.zeros((n_agents, len(data.random))) if agents is None else agents
    start = np.zeros(data.start.shape[::2]) if start is None else start
    point = _Point(theta, agents, start, data)
    relaxation, previous_change = 1.0, np.zeros(len(theta))
    best, logliks = (point, variances), list[float]()
    # half of the quantile of chi squared
    region = float(gammaincinv(max(len(theta), 1) / 2, REGION))
    for _ in range(steps):
        before = variances
        to_low, to_high = low - point.theta, high - point.theta
        try:
            variances = fit_variances(
                point.data,
                noise,
                variances,
                low=to_low,
                high=to_high,
                restricted=restricted,
                tolerance=tolerance,
            )
            products = noise.products(point.data, variances.noise)
            current = marginal(
                point.data,
                products,
                variances.spread,
                variances.start,
                low=np.maximum(to_low, -longest),
                high=np.minimum(to_high, longest),
                restricted=restricted,
            )
        except SimulationError:
            if not logliks:
                raise
            break  # the last step led to a model without a likelihood
        counts = point.agents.any() or not point.agents.size
        logliks.append(current.unchanged if counts else -np.inf)
        if logliks[-1] == max(logliks):
            best = point, variances
        change = current.change
        reversed_step = previous_change @ current.information @ change < 0
        relaxation = max(relaxation / 2, LEAST) if reversed_step else min(1.25 * relaxation, 1.0)
        previous_change = change
        largest_change = _largest_change(current, point.agents, variances, before)
        accepted, tried = _step(response, noise, point, products, variances, current, relaxation)
        n_linearisations += tried
        point = point if accepted is None else accepted
        converged = largest_change < tolerance
        stalled = max(logliks[-PATIENCE:]) < max(logliks)
        if converged or accepted is None or stalled:
            break
    if not converged:
        point, variances = best
        converged = stalled and max(logliks) - min(logliks[-PATIENCE:]) < region
    bounds: dict[str, Any] = {
        "low": low - point.theta,
        "high": high - point.theta,
        "restricted": restricted,
    }
    variances = fit_variances(point.data, noise, variances, tolerance=tolerance, **bounds)
    products = noise.products(point.data, variances.noise)
    final = marginal(point.data, products, variances.spread, variances.start, **bounds)
    return Estimate(
        theta=point.theta,
        agents=point.agents,
        start=point.start,
        variances=variances,
        data=point.data,
        marginal=final,
        steps=n_linearisations,
        converged=converged,
    )


class _Point(NamedTuple):
    """Parameters, deviations of agents and of starts, and the samples, linearised there."""

    theta: np.ndarray
    agents: np.ndarray
    start: np.ndarray
    data: Linearised


def _step(
    response: Response,
    noise: Noise,
    point: _Point,
    products: Products,
    variances: Variances,
    current: Marginal,
    relaxation: float,
) -> tuple[_Point | None, int]:
    """A step toward the estimates of ``current``, shortened until the penalised sum of squares
    falls; None if it does not. And the number of steps that were tried.

    Args:
        products: of the samples at the point. relaxation: share of the step that is tried first.
    """
    theta, agents, start, data = point
    misfit = _misfit(data, products, variances, agents, start)
    share, shares = relaxation, np.full((len(agents), 1), relaxation)
    for tried in range(1, HALVINGS + 1):
        trial = (
            theta + share * current.change,
            agents + shares * (current.deviations - agents),
            start + shares[data.agent] * (current.start - start),
        )
        linearised = response(*trial)
        fixed = replace(linearised, step=data.step, forced=data.forced)
        trial_products = noise.products(fixed, variances.noise)
        trial_misfit = _misfit(fixed, trial_products, variances, *trial[1:])
        if trial_misfit.sum() <= misfit.sum():
            return _Point(*trial, linearised), tried
        rises = (trial_misfit > misfit)[:, None]
        share, shares = share / 2, np.where(rises, shares / 2, shares)
    return None, HALVINGS


def fit_deviations(
    response: Response,
    noise: Noise,
    theta: np.ndarray,
    variances: Variances,
    *,
    agents: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> Estimate:
    """The empirical Bayes modes of agents and of starts, given parameters and variances.

    Args:
        response, noise, agents, start: see :func:`estimate`.
        theta: ``(P,)`` the parameters.

    Returns:
        An estimate whose marginal likelihood is that of free parameters, with their change.
    """
    fixed = replace(variances, low=variances.row, high=variances.row)
    modes = estimate(
        response,
        noise,
        theta,
        fixed,
        low=theta,
        high=theta,
        tolerance=MODES,
        agents=agents,
        start=start,
    )
    products = noise.products(modes.data, variances.noise)
    free = marginal(modes.data, products, variances.spread, variances.start)
    return replace(modes, variances=variances, marginal=free)


def fit_variances(
    data: Linearised,
    noise: Noise,
    variances: Variances,
    *,
    low: np.ndarray | None = None,
    high: np.ndarray | None = None,
    restricted: bool = False,
    tolerance: float = 1e-3,
) -> Variances:
    """The maximum likelihood variances at the present linearisation.

    Logarithms of standard deviations are scaled by the outer product of the agents' scores, which
    approximates the information (Berndt et al. 1974).

    Args:
        low, high: ``(P,)`` bounds of the change of the parameters, which have their most likely
            values.
        tolerance: the search ends when a step raises the log likelihood by less.
    """
    logs_all, free = np.log(variances.row), np.flatnonzero(variances.low < variances.high)
    if not len(free):
        return variances

    def likelihood(row: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """The log likelihood, its slope by ``row``, and the agents' scores ``(len(row), D)``. The
        change of the parameters maximises it, so that derivatives may keep the change fixed."""
        log_row = logs_all.copy()
        log_row[free] = row
        trial = variances.filled(np.exp(log_row))
        deviations = trial.spread, trial.start
        products = noise.products(data, trial.noise)
        centre = marginal(data, products, *deviations, low=low, high=high, restricted=restricted)
        by_noise = np.zeros((len(trial.noise), len(centre.each)))
        scores = np.concatenate([by_noise, centre.by_spread.T, centre.by_start.T])
        slope = scores.sum(1)
        for place in free[free < len(trial.noise)]:
            shifted = trial.noise.copy()
            shifted[place] *= np.exp(DIFFERENCE)
            products = noise.products(data, shifted)
            loglik, each = log_likelihood(
                data, products, *deviations, centre.change, restricted=restricted
            )
            scores[place] = (each - centre.each) / DIFFERENCE
            slope[place] = (loglik - centre.loglik) / DIFFERENCE
        return centre.loglik, slope[free], scores[free]

    first = likelihood(logs_all[free])
    loglik_at_start, _, scores = first
    scale = 1 / np.sqrt(np.maximum((scores**2).sum(1), 1.0))
    start = logs_all[free] / scale

    def value(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        at_start = np.array_equal(scaled, start)
        loglik, slope, _ = first if at_start else likelihood(scaled * scale)
        return -loglik, -slope * scale

    lowest, highest = np.log(variances.low[free]) / scale, np.log(variances.high[free]) / scale
    best = minimize(
        value,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(lowest, highest, strict=True)),
        options={"ftol": tolerance / max(abs(loglik_at_start), 1.0), "gtol": tolerance},
    )
    logs_all[free] = best.x * scale
    return variances.filled(np.exp(logs_all))


def _largest_change(
    current: Marginal, agents: np.ndarray, variances: Variances, before: Variances
) -> float:
    """The largest change of a step, in the units of the tolerance of :func:`estimate`."""
    scale = np.sqrt(np.maximum(np.diag(current.information), 1e-300))
    changes = (
        np.abs(current.change) * scale,
        np.abs(np.log(variances.row / before.row)),
        np.sqrt(np.mean((current.deviations - agents) ** 2, 0)) / variances.spread,
    )
    return max(float(np.max(values, initial=0.0)) for values in changes)


def _misfit(
    data: Linearised,
    products: Products,
    variances: Variances,
    agents: np.ndarray,
    start: np.ndarray,
) -> np.ndarray:
    """``(D,)`` the agents' penalised sums of squares; infinite where a simulation diverges."""
    number, count = data.fixed.shape[-1], len(agents)
    finite = np.isfinite(products.gram).all((1, 2))
    negative_deviations = -np.concatenate([agents[data.agent], start], 1)
    weights = np.concatenate(
        [
            np.ones((len(negative_deviations), 1)),
            np.zeros((len(negative_deviations), number)),
            negative_deviations,
        ],
        1,
    )
    square = np.full(len(weights), np.inf)
    square[finite] = np.einsum(
        "si,sij,sj->s", weights[finite], products.gram[finite], weights[finite]
    )
    square += ((start / variances.start) ** 2).sum(1)
    penalty = ((agents / variances.spread) ** 2).sum(1)
    return np.bincount(data.agent, square, count) + penalty
