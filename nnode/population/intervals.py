"""Confidence intervals of a population's estimates.

The intervals of parameters are cluster-robust (CR2, weighted by the marginal covariance): they are
valid even if the model of drivers or pushes is wrong. The intervals of standard deviations are Wald
intervals from the curvature of the marginal likelihood over their logarithms.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import norm

from nnode.calibrate.intervals import LEVEL, ClusterInfluence
from nnode.model.term import short_names
from nnode.population.drivers import Population
from nnode.population.likelihood import Products, marginal

#: An estimate is at a bound if its logarithm, or the parameter itself, is closer to it than this.
NEAR = 1e-3
#: Difference of logarithms of standard deviations for second derivatives.
DIFFERENCE = 1e-2


def at_bounds(population: Population) -> tuple[np.ndarray, np.ndarray]:
    """``(P,)`` twice: which parameters are at their lower and at their upper bound."""
    theta, model = population.estimate.theta, population.model
    return theta <= model.low + NEAR, theta >= model.high - NEAR


def influence(population: Population, cluster: np.ndarray) -> tuple[ClusterInfluence, np.ndarray]:
    """The influence of clusters of drivers on the free parameters, and ``(P,)`` which are free.

    Args:
        cluster: ``(D,)`` the driver's cluster.
    """
    low, high = at_bounds(population)
    free = ~(low | high)
    member = (np.unique(cluster)[:, None] == cluster).astype(float)
    products = np.tensordot(member, population.marginal.agents, 1)[:, 1:]
    grams = products[:, :, 1:]
    scores = products[:, :, 0] - grams @ population.marginal.change
    return ClusterInfluence(grams[:, free][:, :, free], scores[:, free]), free


def deviation_intervals(population: Population) -> np.ndarray:
    """``(V, 2)`` intervals of 95 % of the standard deviations and times, in the order of
    :attr:`nnode.population.estimate.Variances.row`; NaN at a bound, or if the likelihood is not
    concave."""
    variances, data = population.estimate.variances, population.estimate.data
    logs, low, high = (np.log(values) for values in (variances.row, variances.low, variances.high))
    free = np.flatnonzero((logs > low + NEAR) & (logs < high - NEAR))
    products: dict[tuple[float, ...], Products] = {}

    def loglik(move: np.ndarray) -> float:
        row = logs.copy()
        row[free] += move
        shifted = variances.filled(np.exp(row))
        key = tuple(shifted.noise)
        if key not in products:
            products[key] = population.noise.products(data, shifted.noise)
        return marginal(data, products[key], shifted.spread, shifted.start).loglik

    steps, size = DIFFERENCE * np.eye(len(free)), len(free)
    curvature = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            sum_step, difference_step = steps[i] + steps[j], steps[i] - steps[j]
            cross = (
                loglik(sum_step)
                + loglik(-sum_step)
                - loglik(difference_step)
                - loglik(-difference_step)
            )
            curvature[i, j] = curvature[j, i] = -cross / (4 * DIFFERENCE**2)
    half = np.full(len(logs), np.nan)
    if size and np.linalg.eigvalsh(curvature).min() > 0:
        half[free] = norm.ppf(0.5 + LEVEL / 2) * np.sqrt(np.diag(np.linalg.inv(curvature)))
    return np.exp(logs[:, None] + half[:, None] * np.array([-1.0, 1.0]))


def variations(population: Population) -> dict[str, dict[str, Any]]:
    """Standard deviations of drivers' parameters (%), of pushes and of errors, and the correlation
    time of pushes, by name: ``estimate``, the interval from ``lower`` to ``upper``, ``unit``,
    ``at_bound`` (``low``, ``high`` or empty), and the median ``shrinkage`` over drivers. NaN if
    they are not estimated."""
    variances, order = population.estimate.variances, population.model.lane.order
    short = short_names(population.model.names)
    names = ["push", "push_time", *(short[name] for name in population.random)]
    units = ["m/s" if order == 1 else "m/s²", "s", *["%"] * len(population.random)]
    factor = np.array([1.0, 1.0, *[100.0] * len(population.random)])
    number = len(names)  # the standard deviations of starts come after these
    values, lowest, highest = (
        row[:number] for row in (variances.row, variances.low, variances.high)
    )
    ends = deviation_intervals(population)[:number]
    shrinkage = [np.nan, np.nan, *np.median(population.marginal.shrinkage, 0)]
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
            "shrinkage": float(shrinkage[k]),
        }
    table["measurement"] = {
        "estimate": population.noise.error,
        "lower": np.nan,
        "upper": np.nan,
        "unit": "m",
        "at_bound": "",
        "shrinkage": np.nan,
    }
    return table
