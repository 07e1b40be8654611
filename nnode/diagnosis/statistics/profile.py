"""Profile likelihood of the edges of zones and periods."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import stats

from nnode.calibrate.parameters import with_parameters
from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.model.effects import Effect
from nnode.model.extend import place_of

#: Number of places on either side of an edge, and the nearest as a share of the whole extent.
PLACES, NEAREST = 16, 5e-4
#: Largest number of moves of an edge to another minimum.
MOVES = 3


@dataclass
class Profile:
    """The profile of the cost over the place of an edge; other parameters are refitted linearly.

    Attributes:
        index: of the edge in the row of parameters.
        value: the estimated place.
        at: ``(T,)`` other places, ascending.
        rise: ``(T,)`` increase of the cost at these places.
        bounds: the extent of the data, within which an edge can lie.
    """

    index: int
    value: float
    at: np.ndarray
    rise: np.ndarray
    bounds: tuple[float, float]

    def interval(self, max_rise: float) -> tuple[float, float]:
        """The interval around the edge in which the rise is at most ``max_rise``."""
        ends = []
        for bound, (at, rise) in zip(self.bounds, self._sides(), strict=True):
            k = _crossing(rise, max_rise)
            if k is None:
                ends.append(bound)
            elif np.isfinite(rise[k]):
                share = (max_rise - rise[k - 1]) / (rise[k] - rise[k - 1])
                ends.append(float(at[k - 1] + share * (at[k] - at[k - 1])))
            else:
                ends.append(float(at[k]))
        return ends[0], ends[1]

    def between(self, max_rise: float) -> np.ndarray:
        """Further places between those whose rises bracket ``max_rise``, on both sides."""
        trial_places = [np.empty(0)]
        for at, rise in self._sides():
            k = _crossing(rise, max_rise)
            if k is not None:
                trial_places.append(np.linspace(at[k - 1], at[k], PLACES + 2)[1:-1])
        return np.concatenate(trial_places)

    def with_more(self, at: np.ndarray, rise: np.ndarray) -> Profile:
        """The profile with further places."""
        at, rise = np.append(self.at, at), np.append(self.rise, rise)
        order = np.argsort(at, kind="stable")
        return replace(self, at=at[order], rise=rise[order])

    def _sides(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Places and rises below and above the edge, outwards."""
        below = self.at < self.value
        sides = (self.at[below][::-1], self.rise[below][::-1]), (self.at[~below], self.rise[~below])
        return [(np.append(self.value, at), np.append(0.0, rise)) for at, rise in sides]


def profiles(engine: Engine, fit: Fit, name: str) -> dict[str, Profile]:
    """The profile of both edges of a named effect."""
    place = place_of(fit.system, name)
    effect = fit.system.terms[place]
    assert isinstance(effect, Effect)
    cells = effect.probes(engine.batch, fit.system)
    bounds = cells[0].options["a"], cells[-1].options["b"]
    index = {edge: fit.names.index(f"terms.{place}.{edge}") for edge in ("a", "b")}
    a, b = (float(fit.row[k]) for k in index.values())
    by_edge = {}
    for edge, low, high in (("a", bounds[0], b), ("b", a, bounds[1])):
        value = float(fit.row[index[edge]])
        at = _around(value, low, high, bounds[1] - bounds[0])
        rise = _rises(engine, fit, index[edge], at)
        by_edge[edge] = Profile(index[edge], value, at, rise, bounds)
    return by_edge


def intervals(engine: Engine, fit: Fit, name: str) -> dict[str, tuple[float, float]]:
    """95 % profile likelihood intervals of both edges.

    The likelihood ratio is scaled by the design effect of the strengths' intervals, because
    residuals within clusters are dependent. Unlike the derivative by an edge, a profile accounts
    for gaps between sequences: an edge may lie anywhere in a gap.
    """
    max_rise = float(stats.chi2.ppf(0.95, 1)) * _unit(engine, fit, name)
    by_edge = {}
    for edge, profile in profiles(engine, fit, name).items():
        trial_places = profile.between(max_rise)
        by_edge[edge] = profile.with_more(
            trial_places, _rises(engine, fit, profile.index, trial_places)
        ).interval(max_rise)
    return by_edge


def refined_edges(engine: Engine, fit: Fit, name: str) -> Fit:
    """The fit with edges moved to the best minimum of their profiles."""
    for _ in range(MOVES):
        candidates = [
            profile for profile in profiles(engine, fit, name).values() if len(profile.at)
        ]
        best = min(candidates, key=lambda profile: float(profile.rise.min()), default=None)
        if best is None or best.rise.min() >= 0:
            break
        row = fit.row.copy()
        row[best.index] = best.at[int(np.argmin(best.rise))]
        trial = refine(engine, with_parameters(fit.system, row))
        if trial.cost >= fit.cost:
            break
        fit = trial
    return fit


def residuals_at(engine: Engine, fit: Fit, index: int, at: np.ndarray) -> np.ndarray:
    """``(T, n)`` residuals with one parameter at ``(T,)`` other places."""
    rows = np.repeat(fit.row[None], len(at), 0)
    rows[:, index] = at
    trials: np.ndarray = engine.residuals(fit.system, torch.from_numpy(rows)).numpy()
    return trials


# -- parts ---------------------------------------------------------------------------------------


def _around(value: float, low: float, high: float, extent: float) -> np.ndarray:
    """Places on both sides up to the bounds, denser near the edge."""
    trial_places = []
    for sign, extent_left in ((-1.0, value - low), (1.0, high - value)):
        if extent_left > NEAREST * extent:
            trial_places += list(value + sign * np.geomspace(NEAREST * extent, extent_left, PLACES))
    return np.sort(np.array(trial_places))


def _crossing(rise: np.ndarray, max_rise: float) -> int | None:
    """The first place where the cost has risen by more than ``max_rise``."""
    beyond = np.flatnonzero(rise > max_rise)
    return int(beyond[0]) if len(beyond) else None


def _rises(engine: Engine, fit: Fit, index: int, at: np.ndarray) -> np.ndarray:
    """``(T,)`` changes of the cost with one parameter at ``(T,)`` other places."""
    rises = np.full(len(at), np.inf)
    if not len(at):
        return rises
    trials = residuals_at(engine, fit, index, at)
    finite = np.isfinite(trials).all(1)
    free = fit.free.copy()
    free[index] = False
    base, _ = np.linalg.qr(fit.jacobian[:, free])
    residuals = np.concatenate([fit.residual[None], trials[finite]])
    cost = (residuals**2).sum(1) - ((residuals @ base) ** 2).sum(1)
    rises[finite] = cost[1:] - cost[0]
    return rises


def _unit(engine: Engine, fit: Fit, name: str) -> float:
    """The unit of the likelihood ratio in this cost: the variance of the residuals, times the
    design effect of the strengths (robust over naive variance)."""
    place, columns = place_of(fit.system, name), fit.tangents
    variance = fit.cost / max(len(fit.residual) - columns.shape[1], 1)
    plain = np.full(len(fit.row), np.nan)
    plain[fit.free] = variance * np.diag(np.linalg.pinv(columns.T @ columns))
    ratios = fit.errors(engine.cluster) ** 2 / plain
    effect = fit.system.terms[place]
    assert isinstance(effect, Effect)
    strength_ratios = [
        ratios[fit.names.index(f"terms.{place}.{strength}")] for strength in effect.strengths
    ]
    return variance * max([1.0, *(float(ratio) for ratio in strength_ratios if np.isfinite(ratio))])
