"""Confidence intervals of a population's estimates.

The intervals of parameters are cluster-robust (CR2, weighted by the marginal covariance): they are
valid even if the model of drivers or pushes is wrong. The intervals of standard deviations are Wald
intervals from the curvature of the marginal likelihood over their logarithms. If a standard
deviation may be 0, its logarithm has no normal distribution, and the interval is that of the
likelihood ratio, from 0 on.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import gammaincinv, ndtri

from nnode.calibrate.intervals import LEVEL, ClusterInfluence, at_bounds
from nnode.model.term import short_names
from nnode.population.drivers import Population
from nnode.population.estimate import Variances
from nnode.population.followers import NEAR
from nnode.population.likelihood import (
    UNITS,
    Linearised,
    Noise,
    Products,
    PushNoise,
    marginal,
)

#: Difference of logarithms of standard deviations for second derivatives.
DIFFERENCE = 1e-2
#: Difference of log-likelihoods at the ends of an interval: half of the quantile of chi squared.
DROP = float(gammaincinv(0.5, LEVEL))


def influence(population: Population, cluster: np.ndarray) -> tuple[ClusterInfluence, np.ndarray]:
    """The influence of clusters of drivers on the free parameters, and ``(P,)`` which are free.

    Args:
        cluster: ``(D,)`` the driver's cluster.
    """
    free = population.model.bounds_reached(population.estimate.theta) == ""
    member = (np.unique(cluster)[:, None] == cluster).astype(float)
    products = np.tensordot(member, population.marginal.agents, 1)[:, 1:]
    grams = products[:, :, 1:]
    scores = products[:, :, 0] - grams @ population.marginal.change
    return ClusterInfluence(grams[:, free][:, :, free], scores[:, free]), free


def deviation_intervals(population: Population) -> np.ndarray:
    """``(V, 2)`` intervals of 95 % of the standard deviations and times, in the order of
    :attr:`nnode.population.estimate.Variances.row`, see :func:`variance_intervals`.

    The likelihood is that of the estimates before the correction of their bias, and the intervals
    are corrected by the same factors."""
    corrected, model = population.estimate.variances, population.model
    bias, theta = population.variance_bias, population.estimate.theta
    ends = variance_intervals(
        population.estimate.data,
        PushNoise(),
        corrected.filled(corrected.row * bias),
        model.low - theta,
        model.high - theta,
        population.variance_error,
    )
    return ends / bias[:, None]


def variance_intervals(
    data: Linearised,
    noise: Noise,
    variances: Variances,
    lowest: np.ndarray,
    highest: np.ndarray,
    error: np.ndarray | float = 0.0,
) -> np.ndarray:
    """``(V, 2)`` intervals of 95 % of standard deviations and times; NaN at a bound, if the
    likelihood is not concave, or of the time of a process whose standard deviation may be 0. The
    likelihood hardly depends on such a process, which is therefore fixed for the intervals of the
    others. NaN also where a time may be at its bound, of the time and of the standard deviation of
    this process: pushes that last longer than the record shows cannot be distinguished from
    differences between agents, and of pushes shorter than a sampling interval only the product of
    variance and time is known.

    Args:
        data, noise: of the likelihood. variances: the most likely ones.
        lowest, highest: ``(P,)`` bounds of the change of the parameters.
        error: ``(V,)`` standard errors of logarithms that are added.
    """
    logs, low, high = (np.log(values) for values in (variances.row, variances.low, variances.high))
    products: dict[tuple[float, ...], Products] = {}

    def loglik(places: Any, values: Any) -> float:
        row = logs.copy()
        row[places] = values
        shifted = variances.filled(np.exp(row))
        key = tuple(shifted.noise)
        if key not in products:
            products[key] = noise.products(data, shifted.noise)
        return marginal(
            data, products[key], shifted.spread, shifted.start, low=lowest, high=highest
        ).loglik

    names, peak = noise.names[: len(variances.noise)], loglik(slice(None), logs)
    bounded = at_bounds(logs, low, high, NEAR) != ""
    ends, free = np.full((len(logs), 2), np.nan), ~bounded
    n_deviations = len(names) + len(variances.spread)
    for k in map(int, np.flatnonzero((low < high)[:n_deviations])):
        name = names[k] if k < len(names) else ""
        if name.endswith("_time") or peak - loglik(k, low[k]) >= DROP:
            continue

        def difference(value: float, k: int = k) -> float:
            return peak - loglik(k, value) - DROP

        upper = brentq(difference, logs[k], high[k]) if difference(high[k]) > 0 else high[k]
        ends[k], free[k] = (0.0, np.exp(upper)), False
        if f"{name}_time" in names:
            free[names.index(f"{name}_time")] = False
    places = np.flatnonzero(free)
    steps, size = DIFFERENCE * np.eye(len(places)), len(places)
    curvature = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            sum_step, difference_step = steps[i] + steps[j], steps[i] - steps[j]
            cross = sum(
                sign * loglik(places, logs[places] + move)
                for sign, step in ((1, sum_step), (-1, difference_step))
                for move in (step, -step)
            )
            curvature[i, j] = curvature[j, i] = -cross / (4 * DIFFERENCE**2)
    if size and np.linalg.eigvalsh(curvature).min() > 0:
        added = np.broadcast_to(error, logs.shape)[places]
        deviation = np.sqrt(np.diag(np.linalg.inv(curvature)) + added**2)
        half = ndtri(0.5 + LEVEL / 2) * deviation
        ends[places] = np.exp(logs[places, None] + half[:, None] * np.array([-1.0, 1.0]))
    beyond = (ends[:, 0] < variances.low) | (ends[:, 1] > variances.high)
    ends[np.intersect1d(places, _of_times(names, bounded | beyond))] = np.nan
    return ends


def _of_times(names: tuple[str, ...], chosen: np.ndarray) -> np.ndarray:
    """Places of the chosen times, and of the standard deviations of their processes."""
    times = [k for k, name in enumerate(names) if name.endswith("_time") and chosen[k]]
    processes = [names.index(names[k].removesuffix("_time")) for k in times]
    return np.array(times + processes, dtype=int)


def variations(population: Population) -> dict[str, dict[str, Any]]:
    """The parameters of the noise by the names of :data:`~nnode.population.likelihood.NOISE`, and
    the standard deviations of drivers' parameters, %; see :func:`variation_rows`."""
    short = short_names(population.model.names)
    return variation_rows(
        population.estimate.variances,
        PushNoise(),
        [short[name] for name in population.random],
        deviation_intervals(population),
        population.marginal.shrinkage,
        "m/s" if population.model.lane.order == 1 else "m/s²",
    )


def variation_rows(
    variances: Variances,
    noise: Noise,
    random: list[str],
    ends: np.ndarray,
    shrinkage: np.ndarray,
    push: str,
) -> dict[str, dict[str, Any]]:
    """The variances over time and between agents, as rows of a table.

    Args:
        random: names of what differs between agents, in % if it has no unit in :data:`UNITS`.
        ends: of the intervals. shrinkage: ``(D, Q)`` of the agents. push: the unit of pushes.

    Returns:
        By name the ``estimate``, the interval from ``lower`` to ``upper``, the ``unit``,
        ``at_bound`` (``low``, ``high`` or empty), and the median ``shrinkage`` over agents; NaN if
        they are not estimated.
    """
    names = noise.names[: len(variances.noise)]
    medians = [np.nan] * len(names) + list(np.median(shrinkage, 0))
    logs, low, high = (np.log(values) for values in (variances.row, variances.low, variances.high))
    bounds = np.where(low < high, at_bounds(logs, low, high, NEAR), "")
    table: dict[str, dict[str, Any]] = {}
    # the standard deviations of starts come after these
    units = {**UNITS, "push": push}
    for k, name in enumerate([*names, *random]):
        factor, unit = (1.0, units[name]) if name in units else (100.0, "%")
        table[name] = {
            "estimate": float(factor * variances.row[k]),
            "lower": float(factor * ends[k, 0]),
            "upper": float(factor * ends[k, 1]),
            "unit": unit,
            "at_bound": str(bounds[k]),
            "shrinkage": float(medians[k]),
        }
    return table
