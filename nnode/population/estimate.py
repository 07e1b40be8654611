"""Parameters, differences between agents and disturbances, estimated together.

Two steps take turns until neither changes the result. The first maximises the marginal likelihood
of the linearised samples over the variances. The second minimises the penalised sum of squares

    (y - f)' V0^-1 (y - f) + b' Omega^-1 b + h' S^-1 h

over the parameters, the deviations of agents and those of starts, by a step of Gauss and Newton's
that is halved until the sum falls, for agents whose own sum rises. A step that turns back is
shortened as well: the covariance changes with the parameters, so the steps might cycle.

Source: Lindstrom & Bates 1990, Biometrics 46; Wolfinger & Lin 1997, Comput. Stat. Data Anal. 25.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.optimize import minimize

from nnode.population.likelihood import Linearised, Marginal, Noise, Products, marginal

#: Difference of logarithms of standard deviations for derivatives.
DIFFERENCE = 1e-6
#: Halvings of a step at most.
HALVINGS = 6
#: How closely deviations are found where parameters and variances are given, see :func:`estimate`.
MODES = 0.02
#: Linearisations of a search at most.
STEPS = 40
#: The smallest share of a step that turns back.
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
    """Standard deviations, and the times for which disturbances last.

    Attributes:
        noise: of the :class:`~nnode.population.likelihood.Noise`, in the order of its names.
        spread: ``(Q,)`` of the agents' deviations.
        start: ``(H,)`` of the starts' deviations.
        low, high: of all of them, one after the other; where these are equal, nothing is estimated.
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
    """What was estimated.

    Attributes:
        theta: ``(P,)`` parameters.
        agents: ``(D, Q)`` deviations of the agents. start: ``(S, H)`` of the starts.
        variances: standard deviations.
        data: the samples, linearised there.
        marginal: the likelihood there.
        steps: linearisations.
        converged: whether the last step changed nothing.
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
    """Estimate a model of agents who differ.

    Args:
        response: the model.
        noise: what differs from sample to sample.
        theta: ``(P,)`` where the search starts.
        variances: where it starts, and bounds.
        low, high: ``(P,)`` bounds of the parameters.
        restricted: REML, for few agents.
        longest: step of a parameter at most, in its own unit.
        steps: linearisations at most.
        tolerance: the search ends when a step moves no parameter by more than this share of its
            standard error, no standard deviation by more than this share of itself, and no agent's
            deviation by more than this share of their standard deviation.
        agents, start: ``(D, Q)``, ``(S, H)`` deviations that the search starts from; by default 0.
    """
    theta = np.array(theta, dtype=float)
    low = np.full(len(theta), -np.inf) if low is None else low
    high = np.full(len(theta), np.inf) if high is None else high
    none = np.zeros((0, 0))
    data = response(theta, none if agents is None else agents, none if start is None else start)
    converged, taken, number = False, 1, int(data.agent.max()) + 1
    agents = np.zeros((number, data.random.shape[-1])) if agents is None else agents
    start = np.zeros(data.start.shape[::2]) if start is None else start
    most, last = 1.0, np.zeros(len(theta))
    for _ in range(steps):
        before = variances
        variances = fit_variances(
            data, noise, variances, restricted=restricted, tolerance=tolerance
        )
        products = noise.products(data, variances.noise)
        here = marginal(data, products, variances.spread, variances.start, restricted=restricted)
        change = np.clip(here.change, -longest, longest)
        change = np.clip(change, low - theta, high - theta)
        misfit = _misfit(data, products, variances, agents, start)
        turned = last @ here.information @ change < 0
        most, last = max(most / 2, LEAST) if turned else min(1.25 * most, 1.0), change
        share, shares, found, there = most, np.full((number, 1), most), None, data
        for _ in range(HALVINGS):
            trial = (
                theta + share * change,
                agents + shares * (here.deviations - agents),
                start + shares[data.agent] * (here.start - start),
            )
            there, taken = response(*trial), taken + 1
            fixed = replace(there, step=data.step, forced=data.forced)
            then = _misfit(fixed, noise.products(fixed, variances.noise), variances, *trial[1:])
            if then.sum() <= misfit.sum():
                found = trial
                break
            share, shares = share / 2, np.where((then > misfit)[:, None], shares / 2, shares)
        scale = np.sqrt(np.maximum(np.diag(here.information), 1e-300))
        moved = np.max(np.abs(change) * scale, initial=0.0)
        moved = max(moved, np.max(np.abs(np.log(variances.row / before.row)), initial=0.0))
        differ = np.abs(here.deviations - agents) / variances.spread
        moved = max(moved, np.max(differ, initial=0.0))
        if found is not None:
            (theta, agents, start), data = found, there
        if moved < tolerance or found is None:
            converged = bool(moved < tolerance)
            break
    variances = fit_variances(data, noise, variances, restricted=restricted, tolerance=tolerance)
    products = noise.products(data, variances.noise)
    final = marginal(data, products, variances.spread, variances.start, restricted=restricted)
    return Estimate(
        theta=theta,
        agents=agents,
        start=start,
        variances=variances,
        data=data,
        marginal=final,
        steps=taken,
        converged=converged,
    )


def fit_deviations(
    response: Response,
    noise: Noise,
    theta: np.ndarray,
    variances: Variances,
    *,
    agents: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> Estimate:
    """Estimate the deviations of agents and of starts, parameters and variances given.

    Args:
        response, noise, agents, start: see :func:`estimate`.
        theta: ``(P,)`` the parameters.
    """
    fixed = replace(variances, low=variances.row, high=variances.row)
    found = estimate(
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
    return replace(found, variances=variances)


def fit_variances(
    data: Linearised,
    noise: Noise,
    variances: Variances,
    *,
    restricted: bool = False,
    tolerance: float = 1e-3,
) -> Variances:
    """The variances that are most likely, the samples' linearisation given.

    Logarithms of standard deviations are scaled by the spread of the agents' scores, which is their
    curvature (Berndt et al. 1974).

    Args:
        tolerance: the search ends when a step gains less in the logarithm of the likelihood.
    """
    whole, free = np.log(variances.row), np.flatnonzero(variances.low < variances.high)
    if not len(free):
        return variances

    def at(row: np.ndarray) -> tuple[Marginal, list[Marginal]]:
        """The likelihood, and those with a little more of each standard deviation."""
        known: dict[tuple[float, ...], Products] = {}  # most of them have the same noise

        def one(row: np.ndarray) -> Marginal:
            logs = whole.copy()
            logs[free] = row
            found = variances.filled(np.exp(logs))
            key = tuple(found.noise)
            if key not in known:
                known[key] = noise.products(data, found.noise)
            return marginal(data, known[key], found.spread, found.start, restricted=restricted)

        return one(row), [one(row + step) for step in DIFFERENCE * np.eye(len(row))]

    first, sides = at(whole[free])
    scores = np.stack([(up.each - first.each) / DIFFERENCE for up in sides])
    scale = 1 / np.sqrt(np.maximum((scores**2).sum(1), 1.0))

    def value(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        here, sides = at(scaled * scale)
        slope = np.array([up.loglik - here.loglik for up in sides]) / DIFFERENCE
        return -here.loglik, -slope * scale

    low, high = np.log(variances.low[free]) / scale, np.log(variances.high[free]) / scale
    best = minimize(
        value,
        whole[free] / scale,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        options={"ftol": tolerance / max(abs(first.loglik), 1.0), "gtol": tolerance},
    )
    whole[free] = best.x * scale
    return variances.filled(np.exp(whole))


def _misfit(
    data: Linearised,
    products: Products,
    variances: Variances,
    agents: np.ndarray,
    start: np.ndarray,
) -> np.ndarray:
    """``(D,)`` the agents' penalised sums of squares; infinite where a simulation blows up."""
    number, count = data.fixed.shape[-1], len(agents)
    blown = ~np.isfinite(np.where(data.seen, data.residual, 0.0)).all(1)
    back = -np.concatenate([agents[data.agent], start], 1)
    weights = np.concatenate([np.ones((len(back), 1)), np.zeros((len(back), number)), back], 1)
    square = np.einsum("si,sij,sj->s", weights, products.gram, weights)
    square = np.where(blown, np.inf, square + ((start / variances.start) ** 2).sum(1))
    tied = ((agents / variances.spread) ** 2).sum(1)
    return np.bincount(data.agent, square, count) + tied
