"""How sure the parameters of one candidate are: sandwich, profiles, and drivers who differ."""

from __future__ import annotations

from typing import Any

import numpy as np

from nnode.calibrate.gauss_newton import TangentCost, alone, pooled, sandwich
from nnode.data.sequence import collate
from nnode.study.following import data
from nnode.study.following.candidates import EVERY, starts
from nnode.study.following.fit import at_limits, costs_of, named
from nnode.study.statistics import paired

Result = dict[str, Any]

#: Factors on a parameter, at which all others are calibrated again.
PROFILE = tuple(float(f) for f in np.geomspace(0.25, 4, 17))
#: Factors on the penalty by which pairs are drawn towards the pool.
STRENGTHS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
#: A parameter's spread between pairs is at least this share of the pooled value.
LEAST_SPREAD = 0.02


def precision(folder: str, name: str, row: list[float]) -> Result:
    """Standard errors from clusters, correlations, and a profile of every parameter."""
    batch = data.batch(folder)
    label = data.labels(data.pairs(folder))
    cost = costs_of(EVERY[name], batch)
    best = np.array(row)
    free = np.array([n not in at_limits(cost, best) for n in named(cost, best)])
    weights = np.full(len(batch), 1 / len(batch))
    covariance = sandwich(cost(best), weights, label, free)
    error = np.sqrt(np.diag(covariance))
    scale = np.where(error > 0, error, 1.0)
    return {
        "names": list(named(cost, best)),
        "row": row,
        "error": error.tolist(),
        "correlation": (covariance / np.outer(scale, scale)).tolist(),
        "profiles": {one: profile(cost, best, i, label) for i, one in enumerate(named(cost, best))},
    }


def profile(cost: TangentCost, best: np.ndarray, place: int, label: np.ndarray) -> Result:
    """Costs with one parameter held at other values, all others calibrated again.

    Returns:
        ``values``; ``rise``: mean over pairs, m; ``low`` and ``high``: of its 95 % interval,
        clusters resampled.
    """
    low, high = cost.low.copy(), cost.high.copy()
    before = cost.costs(best)
    found: Result = {"values": [], "rise": [], "low": [], "high": []}
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
                    found, (value, rise.difference, rise.low, rise.high), strict=True
                ):
                    found[key].append(x)
    finally:
        cost.low[:], cost.high[:] = low, high
    order = np.argsort(found["values"], kind="stable")
    return {key: [x[i] for i in order] for key, x in found.items()}


def halves(
    folder: str, name: str, row: list[float], folds: int, restarts: int, seed: int
) -> Result:
    """Pooled, alone and in between: calibrated on the first half of every pair, judged on the
    second.

    What lasts of a driver is the covariance of its numbers in both halves (method of moments).
    Drawn towards the pool, squares of deviations, in units of that spread, add to a pair's
    cost; how much is chosen for each fold from the pairs outside it.
    """
    both = data.pairs(folder)
    first, second = (
        costs_of(EVERY[name], collate([data.part(s, low, low + 0.5) for s in both]))
        for low in (0.0, 0.5)
    )
    centre = pooled(first, np.array(row)).row
    begin = [centre, *starts(EVERY[name], first, restarts, seed)]

    def best(cost: TangentCost, pool: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray:
        fits = [alone(cost, one, pool=pool) for one in (begin if pool is None else begin[:1])]
        which = np.argmin(np.array([fit.cost for fit in fits]), axis=0)
        return np.stack([fits[k].row[b] for b, k in enumerate(which)])

    own = [best(cost, None) for cost in (first, second)]
    lasting = _lasting(*own)
    spread = np.maximum(np.sqrt(lasting), LEAST_SPREAD * np.abs(centre))
    rows = {s: best(first, (centre, s / spread**2)) if s else own[0] for s in STRENGTHS}
    costs = np.stack([second.costs(one) for one in rows.values()])
    usual = second.costs(np.array(centre))
    label = data.labels(both)
    fold = data.folds(label, folds, seed)
    shrunk, chosen = np.zeros(len(both)), []
    for k in range(folds):
        i = int(np.argmin(costs[:, fold != k].mean(1)))
        shrunk[fold == k] = costs[i, fold == k]
        chosen.append(STRENGTHS[i])
    return {
        "names": list(named(first, centre)),
        "centre": centre.tolist(),
        "spread": np.sqrt(lasting).tolist(),
        "between": np.std(own[0], axis=0).tolist(),
        "pooled": usual.tolist(),
        "alone": costs[0].tolist(),
        "shrunk": shrunk.tolist(),
        "strengths": chosen,
        "by_strength": costs.mean(1).tolist(),
        "clusters": label.tolist(),
    }


def _lasting(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """``(P,)`` variance of what both halves of a pair have in common; at least 0.

    The middle 90 % of each half's numbers set the limits that others are moved to: a number that
    a half does not determine may lie anywhere.
    """
    found = []
    for one, other in zip(first.T, second.T, strict=True):
        tame = [np.clip(x, *np.quantile(x, [0.05, 0.95])) for x in (one, other)]
        found.append(max(float(np.cov(*tame)[0, 1]), 0.0))
    return np.array(found)
