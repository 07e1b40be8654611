"""How sure the parameters of one candidate are: clusters, profiles, and drivers who differ."""

from __future__ import annotations

from operator import itemgetter
from typing import Any

import numpy as np

from nnode.calibrate import pooling
from nnode.calibrate.intervals import at_bounds, influence
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.calibrate.resampling import paired
from nnode.data.clusters import folds as by_cluster
from nnode.data.sequence import collate
from studies.following import data
from studies.following.candidates import EVERY, starts
from studies.following.fit import costs_of, named

Result = dict[str, Any]

#: Factors on a parameter, at which all others are calibrated again.
PROFILE = np.geomspace(0.25, 4, 17)


def precision(folder: str, name: str, row: list[float]) -> Result:
    """Half widths of intervals from clusters, correlations, and a profile of every parameter."""
    label = data.labels(data.pairs(folder))
    cost, best = costs_of(EVERY[name], data.batch(folder)), np.array(row)
    names = list(named(cost, best))
    free = at_bounds(best, cost.low, cost.high) == ""
    influences = influence(cost, best, label, free)
    covariance, half = np.zeros((len(best), len(best))), np.zeros(len(best))
    covariance[np.ix_(free, free)], half[free] = influences.covariance(), influences.half_widths()
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    return {
        "names": names,
        "row": row,
        "half": half,
        "correlation": covariance / np.outer(scale, scale),
        "profiles": {one: profile(cost, best, i, label) for i, one in enumerate(names)},
    }


def profile(cost: ResidualProblem, best: np.ndarray, place: int, label: np.ndarray) -> Result:
    """Costs with one parameter held at other values, all others calibrated again.

    Returns:
        ``values``; ``rise``: mean over pairs, m; ``low`` and ``high``: of its 95 % interval,
        clusters resampled.
    """
    low, high = cost.low.copy(), cost.high.copy()
    before, points = cost.costs(best), []
    try:
        # from the best value downwards, and upwards
        for factors in (PROFILE[PROFILE < 1][::-1], PROFILE[PROFILE >= 1]):
            start = best
            for factor in factors:
                value = float(np.clip(best[place] * factor, low[place], high[place]))
                cost.low[place] = cost.high[place] = value
                row = start.copy()
                row[place] = value
                start = pooled(cost, row).row
                rise = paired(cost.costs(start), before, label, seed=0)
                points.append((value, rise.difference, rise.low, rise.high))
    finally:
        cost.low[:], cost.high[:] = low, high
    columns = zip(*sorted(points, key=itemgetter(0)), strict=True)
    return dict(zip(("values", "rise", "low", "high"), columns, strict=True))


def halves(
    folder: str, name: str, row: list[float], folds: int, restarts: int, seed: int
) -> Result:
    """Pooled, alone and in between: calibrated on the first half of every pair, judged on the
    second.

    How much pairs are drawn towards the pool is chosen for each fold from the pairs outside it.
    """
    pairs = data.pairs(folder)
    first, second = (
        costs_of(EVERY[name], collate([s.part(low, low + 0.5) for s in pairs]))
        for low in (0.0, 0.5)
    )
    label = data.labels(pairs)
    fold = by_cluster(label, folds, seed)
    others = starts(EVERY[name], first, restarts, seed)
    results = pooling.halves(first, second, np.array(row), others, fold)
    return {"names": list(named(first, results.centre)), **vars(results), "clusters": label}
