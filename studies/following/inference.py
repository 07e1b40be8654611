"""How sure the parameters of one candidate are: clusters, profiles, and drivers who differ."""

from __future__ import annotations

from typing import Any

import numpy as np

from nnode.calibrate import pooling
from nnode.calibrate.intervals import influence
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.calibrate.resampling import paired
from nnode.data.clusters import folds as by_cluster
from nnode.data.sequence import collate
from studies.following import data
from studies.following.candidates import EVERY, starts
from studies.following.fit import at_limits, costs_of, named

Result = dict[str, Any]

#: Factors on a parameter, at which all others are calibrated again.
PROFILE = tuple(float(f) for f in np.geomspace(0.25, 4, 17))


def precision(folder: str, name: str, row: list[float]) -> Result:
    """Half widths of intervals from clusters, correlations, and a profile of every parameter."""
    batch = data.batch(folder)
    label = data.labels(data.pairs(folder))
    cost = costs_of(EVERY[name], batch)
    best = np.array(row)
    free = np.array([n not in at_limits(cost, best) for n in named(cost, best)])
    influences = influence(cost, best, label, free)
    covariance, half = np.zeros((len(best), len(best))), np.zeros(len(best))
    covariance[np.ix_(free, free)], half[free] = influences.covariance(), influences.half_widths()
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    return {
        "names": list(named(cost, best)),
        "row": row,
        "half": half.tolist(),
        "correlation": (covariance / np.outer(scale, scale)).tolist(),
        "profiles": {one: profile(cost, best, i, label) for i, one in enumerate(named(cost, best))},
    }


def profile(cost: ResidualProblem, best: np.ndarray, place: int, label: np.ndarray) -> Result:
    """Costs with one parameter held at other values, all others calibrated again.

    Returns:
        ``values``; ``rise``: mean over pairs, m; ``low`` and ``high``: of its 95 % interval,
        clusters resampled.
    """
    low, high = cost.low.copy(), cost.high.copy()
    before = cost.costs(best)
    points: Result = {"values": [], "rise": [], "low": [], "high": []}
    try:
        for values in (PROFILE[: len(PROFILE) // 2][::-1], PROFILE[len(PROFILE) // 2 :]):
            start = best
            for factor in values:
                value = float(np.clip(best[place] * factor, low[place], high[place]))
                cost.low[place] = cost.high[place] = value
                row = start.copy()
                row[place] = value
                start = pooled(cost, row).row
                rise = paired(cost.costs(start), before, label, seed=0)
                for key, x in zip(
                    points, (value, rise.difference, rise.low, rise.high), strict=True
                ):
                    points[key].append(x)
    finally:
        cost.low[:], cost.high[:] = low, high
    order = np.argsort(points["values"], kind="stable")
    return {key: [x[i] for i in order] for key, x in points.items()}


def halves(
    folder: str, name: str, row: list[float], folds: int, restarts: int, seed: int
) -> Result:
    """Pooled, alone and in between: calibrated on the first half of every pair, judged on the
    second.

    How much pairs are drawn towards the pool is chosen for each fold from the pairs outside it.
    """
    both = data.pairs(folder)
    first, second = (
        costs_of(EVERY[name], collate([s.part(low, low + 0.5) for s in both])) for low in (0.0, 0.5)
    )
    label = data.labels(both)
    fold = by_cluster(label, folds, seed)
    others = starts(EVERY[name], first, restarts, seed)
    results = pooling.halves(first, second, np.array(row), others, fold)
    return {
        "names": list(named(first, results.centre)),
        **{field: np.array(values).tolist() for field, values in vars(results).items()},
        "clusters": label.tolist(),
    }
