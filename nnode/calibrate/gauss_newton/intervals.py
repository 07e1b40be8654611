"""How sure calibrated parameters are, by how clusters of sequences differ."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import t as students_t

from nnode.calibrate.gauss_newton.method import TangentCost, sandwich

#: Level of intervals.
LEVEL = 0.95
#: An interval that is wider than this share of the admissible set does not identify a parameter,
#: and so does one as wide as the value itself where the set is open.
VAGUE = 0.5


def at_bounds(cost: TangentCost, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(P,)`` twice: which parameters are at the lower and at the upper end of what is allowed."""
    near = 1e-6 * (1 + np.abs(row))
    return row <= cost.low + near, row >= cost.high - near


def intervals(cost: TangentCost, row: np.ndarray, cluster: np.ndarray) -> dict[str, Any]:
    """What calibrated parameters of a lane are, and what the data say of them.

    Intervals are Student's with one degree of freedom less than there are clusters, on the
    covariance of :func:`~nnode.calibrate.gauss_newton.method.sandwich`. A parameter at a bound has
    none: it is where the admissible set ends, and the others' hold for it being there.

    Args:
        row: ``(P,)`` at the minimum.
        cluster: ``(B,)`` which cluster a sequence belongs to.

    Returns:
        ``parameters``: address to ``value``, ``low``, ``high``, ``at_bound`` and ``identified``,
        None where there is one cluster, and the cost depends on the parameter;
        ``correlation``: address to address to correlation; ``clusters``: their number. Weights of
        networks are not listed.
    """
    low, high = at_bounds(cost, row)
    free = ~(low | high)
    weights = np.full(len(cost.batch), 1 / len(cost.batch))
    curved = cost(row)
    covariance = sandwich(curved, weights, cluster, free)
    spread = np.sqrt(np.diag(covariance))
    number = len(np.unique(cluster))
    # with one cluster nothing tells how sure the others are
    lost = ~free | np.isinf(np.diag(sandwich(curved, weights, np.arange(len(weights)), free)))
    factor = float(students_t.ppf(0.5 + LEVEL / 2, max(number - 1, 1)))
    listed = [i for i, name in enumerate(cost.names) if cost.physical(name)]
    parameters: dict[str, Any] = {}
    for i in listed:
        wide = factor * spread[i]
        known = bool(free[i] and np.isfinite(wide))
        whole = cost.high[i] - cost.low[i]
        scale = VAGUE * whole if np.isfinite(whole) else abs(row[i])
        parameters[cost.names[i].replace("__", ".")] = {
            "value": float(row[i]),
            "low": float(max(row[i] - wide, cost.low[i])) if known else None,
            "high": float(min(row[i] + wide, cost.high[i])) if known else None,
            "at_bound": "low" if low[i] else "high" if high[i] else None,
            "identified": bool(known and 2 * wide < scale) if number > 1 or lost[i] else None,
        }
    apart = np.outer(spread, spread)
    apart = np.where((apart > 0) & np.isfinite(apart), apart, np.nan)
    table = covariance / apart
    correlation = {
        cost.names[i].replace("__", "."): {
            cost.names[j].replace("__", "."): _number(table[i, j]) for j in listed
        }
        for i in listed
    }
    return {"parameters": parameters, "correlation": correlation, "clusters": number}


def _number(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
