"""How sure the estimates of a population are.

Those of parameters follow from how clusters of drivers differ (CR2, weighted by the marginal
covariance). They hold where the model of the drivers or of their pushes is wrong. Those of standard
deviations follow from the curvature of the marginal likelihood over their logarithms (Wald).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import norm

from nnode.calibrate.intervals import LEVEL, ClusterInfluence
from nnode.model.term import short_names
from nnode.population.drivers import Population
from nnode.population.likelihood import Products, marginal

#: An estimate is at a bound where its logarithm, or the parameter itself, is nearer to it.
NEAR = 1e-3
#: Difference of logarithms of standard deviations for second derivatives.
DIFFERENCE = 1e-2


def at_bounds(found: Population) -> tuple[np.ndarray, np.ndarray]:
    """``(P,)`` twice: which parameters are at the lower and at the upper end of what is allowed."""
    theta, model = found.estimate.theta, found.model
    return theta <= model.low + NEAR, theta >= model.high - NEAR


def influence(found: Population, cluster: np.ndarray) -> tuple[ClusterInfluence, np.ndarray]:
    """Of clusters of drivers on the parameters that are at no bound, and ``(P,)`` which these are.

    Args:
        cluster: ``(D,)`` which cluster a driver belongs to.
    """
    low, high = at_bounds(found)
    free = ~(low | high)
    member = (np.unique(cluster)[:, None] == cluster).astype(float)
    products = np.tensordot(member, found.marginal.agents, 1)[:, 1:]
    grams = products[:, :, 1:]
    scores = products[:, :, 0] - grams @ found.marginal.change
    return ClusterInfluence(grams[:, free][:, :, free], scores[:, free]), free


def deviation_intervals(found: Population) -> np.ndarray:
    """``(V, 2)`` intervals of 95 % of the standard deviations and times, in the order of
    :attr:`nnode.population.estimate.Variances.row`; NaN at a bound, or where the likelihood is not
    curved."""
    variances, data = found.estimate.variances, found.estimate.data
    logs, low, high = (np.log(one) for one in (variances.row, variances.low, variances.high))
    free = np.flatnonzero((logs > low + NEAR) & (logs < high - NEAR))
    products: dict[tuple[float, ...], Products] = {}

    def loglik(move: np.ndarray) -> float:
        row = logs.copy()
        row[free] += move
        there = variances.filled(np.exp(row))
        key = tuple(there.noise)
        if key not in products:
            products[key] = found.noise.products(data, there.noise)
        return marginal(data, products[key], there.spread, there.start).loglik

    steps, size = DIFFERENCE * np.eye(len(free)), len(free)
    curved = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            both, apart = steps[i] + steps[j], steps[i] - steps[j]
            cross = loglik(both) + loglik(-both) - loglik(apart) - loglik(-apart)
            curved[i, j] = curved[j, i] = -cross / (4 * DIFFERENCE**2)
    half = np.full(len(logs), np.nan)
    if size and np.linalg.eigvalsh(curved).min() > 0:
        half[free] = norm.ppf(0.5 + LEVEL / 2) * np.sqrt(np.diag(np.linalg.inv(curved)))
    return np.exp(logs[:, None] + half[:, None] * np.array([-1.0, 1.0]))


def variations(found: Population) -> dict[str, dict[str, Any]]:
    """Standard deviations of drivers' parameters (%), of pushes and of errors, and the time that
    pushes last, by name: ``estimate``, the interval from ``lower`` to ``upper``, ``unit``,
    ``at_bound`` (``low``, ``high`` or empty), and the median ``shrinkage`` over drivers. NaN where
    the data tell none."""
    variances, order = found.estimate.variances, found.model.lane.order
    short = short_names(found.model.names)
    names = ["push", "push_time", *(short[name] for name in found.random)]
    units = ["m/s" if order == 1 else "m/s²", "s", *["%"] * len(found.random)]
    factor = np.array([1.0, 1.0, *[100.0] * len(found.random)])
    number = len(names)  # the standard deviations of starts come after these
    values, lowest, highest = (
        row[:number] for row in (variances.row, variances.low, variances.high)
    )
    ends = deviation_intervals(found)[:number]
    left = [np.nan, np.nan, *np.median(found.marginal.shrinkage, 0)]
    table: dict[str, dict[str, Any]] = {}
    for k, name in enumerate(names):
        bound = "low" if values[k] <= lowest[k] * (1 + NEAR) else ""
        bound = "high" if values[k] >= highest[k] / (1 + NEAR) else bound
        lower, upper = (float(factor[k] * end) for end in ends[k])
        table[name] = {
            "estimate": float(factor[k] * values[k]),
            "lower": lower,
            "upper": upper,
            "unit": units[k],
            "at_bound": bound,
            "shrinkage": float(left[k]),
        }
    table["measurement"] = {
        "estimate": found.noise.error,
        "lower": np.nan,
        "upper": np.nan,
        "unit": "m",
        "at_bound": "",
        "shrinkage": np.nan,
    }
    return table
