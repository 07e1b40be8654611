"""Confidence intervals of a population's estimates.

The intervals of parameters are cluster-robust (CR2, weighted by the marginal covariance): they are
valid even if the model of drivers or pushes is wrong. The intervals of standard deviations are Wald
intervals from the curvature of the marginal likelihood over their logarithms.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import ndtri

from nnode.calibrate.intervals import LEVEL, ClusterInfluence, at_bounds
from nnode.model.term import short_names
from nnode.population.drivers import Population
from nnode.population.likelihood import NOISE, Products, PushNoise, marginal

#: An estimate is at a bound if its logarithm, or the parameter itself, is closer to it than this.
NEAR = 1e-3
#: Difference of logarithms of standard deviations for second derivatives.
DIFFERENCE = 1e-2


def bounds_reached(population: Population) -> np.ndarray:
    """``(P,)`` the bounds at which parameters are, see
    :func:`nnode.calibrate.intervals.at_bounds`."""
    model = population.model
    return at_bounds(population.estimate.theta, model.low, model.high, NEAR)


def influence(population: Population, cluster: np.ndarray) -> tuple[ClusterInfluence, np.ndarray]:
    """The influence of clusters of drivers on the free parameters, and ``(P,)`` which are free.

    Args:
        cluster: ``(D,)`` the driver's cluster.
    """
    free = bounds_reached(population) == ""
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
    free = np.flatnonzero(at_bounds(logs, low, high, NEAR) == "")
    theta, model = population.estimate.theta, population.model
    products: dict[tuple[float, ...], Products] = {}

    def loglik(move: np.ndarray) -> float:
        row = logs.copy()
        row[free] += move
        shifted = variances.filled(np.exp(row))
        key = tuple(shifted.noise)
        if key not in products:
            products[key] = PushNoise().products(data, shifted.noise)
        return marginal(
            data,
            products[key],
            shifted.spread,
            shifted.start,
            low=model.low - theta,
            high=model.high - theta,
        ).loglik

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
        half[free] = ndtri(0.5 + LEVEL / 2) * np.sqrt(np.diag(np.linalg.inv(curvature)))
    return np.exp(logs[:, None] + half[:, None] * np.array([-1.0, 1.0]))


def variations(population: Population) -> dict[str, dict[str, Any]]:
    """The parameters of the noise by the names of :data:`~nnode.population.likelihood.NOISE`, and
    the standard deviations of drivers' parameters, %.

    Returns:
        By name the ``estimate``, the interval from ``lower`` to ``upper``, the ``unit``,
        ``at_bound`` (``low``, ``high`` or empty), and the median ``shrinkage`` over drivers; NaN if
        they are not estimated.
    """
    variances, order = population.estimate.variances, population.model.lane.order
    short = short_names(population.model.names)
    noise, drivers = NOISE[: len(variances.noise)], [short[name] for name in population.random]
    units = ["m/s" if order == 1 else "m/s²", "s", "m", "m", "s"][: len(noise)]
    shrinkage = [np.nan] * len(noise) + list(np.median(population.marginal.shrinkage, 0))
    ends = deviation_intervals(population)
    logs, low, high = (np.log(values) for values in (variances.row, variances.low, variances.high))
    bounds = np.where(low < high, at_bounds(logs, low, high, NEAR), "")
    table: dict[str, dict[str, Any]] = {}
    # the standard deviations of starts come after these
    for k, name in enumerate([*noise, *drivers]):
        value, factor = variances.row[k], 1.0 if k < len(noise) else 100.0
        table[name] = {
            "estimate": float(factor * value),
            "lower": float(factor * ends[k, 0]),
            "upper": float(factor * ends[k, 1]),
            "unit": units[k] if k < len(noise) else "%",
            "at_bound": str(bounds[k]),
            "shrinkage": float(shrinkage[k]),
        }
    return table
