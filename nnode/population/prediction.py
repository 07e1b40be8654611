"""Prediction of followers from the first seconds of their paths, with bands.

With the law's parameters and all variances given, the deviations b of a driver and h of his start
are those that are most likely for the known samples. Linearised there, the positions

    x = f(theta, b, h) + Z (b* - b) + H (h* - h) + d

are jointly normal (see :mod:`nnode.population.likelihood`), with the covariance

    V = Z Omega Z' + H S H' + sigma^2 R C R' + sigma_e^2 R_e C_e R_e'

of true positions, where R is the linear response to pushes at the sampling times, and to the rest
of their means between them, and C their correlation; R_e and C_e are those of the errors of
leaders' paths. The prediction is the normal distribution of x given the known samples, to whose
covariance that of their errors is added. Vehicles ahead move as measured.

Source: Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, section 2.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from nnode.model.system import System
from nnode.population.drivers import full_names, initial_variances
from nnode.population.estimate import fit_deviations
from nnode.population.followers import Followers, Paths
from nnode.population.likelihood import NOISE, Linearised, PushNoise


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted positions of F followers at K samples.

    Attributes:
        mean: ``(F, K)`` m.
        deviation: ``(F, K)`` standard deviation of the true position, m.
        given: ``(K,)`` True for the samples that the prediction uses.
    """

    mean: np.ndarray
    deviation: np.ndarray
    given: np.ndarray


def predict(
    system: System, paths: Paths, variances: Mapping[str, float], seconds: float
) -> Prediction:
    """Predict followers from the first seconds of their paths.

    Each follower is a driver of his own, also if he appears in several sequences.

    Args:
        system: the calibrated law, with the parameters of the typical driver.
        paths: the followers.
        variances: parameters of the noise by the names of
            :data:`~nnode.population.likelihood.NOISE`, and by the short names of the parameters
            that differ between drivers the standard deviations of their logarithms.
        seconds: length of the known beginning; at least two samples are used.
    """
    times = paths.dt * np.arange(paths.x.shape[1])
    given = (times <= seconds + 1e-9) | (np.arange(len(times)) < 2)
    names = [name for name in variances if name not in NOISE]
    past = replace(
        paths.starting_from(given),
        observed=paths.observed & given,
        agent=np.arange(len(paths.agent)),
    )
    alike = Followers(system, past)
    model = alike.with_random(full_names(names, alike.may_differ))
    initial = initial_variances(model)
    fixed = replace(
        initial,
        noise=np.array([variances[name] for name in NOISE if name in variances]),
        spread=np.array([variances[name] for name in names]),
    )
    modes = fit_deviations(model, PushNoise(), model.start, fixed)
    data = modes.data
    mean, deviation = np.empty_like(data.residual), np.empty_like(data.residual)
    white, *lasting = fixed.noise[2:]
    errors = white**2 * np.eye(len(times))
    if lasting:
        errors += lasting[0] ** 2 * np.exp(-np.abs(times[:, None] - times) / lasting[1])
    for f in range(len(mean)):
        covariance = _covariance(data, f, fixed.noise, fixed.spread, fixed.start)
        at = past.observed[f]
        inner = (covariance + errors)[np.ix_(at, at)]
        gain = np.linalg.solve(inner, covariance[at]).T
        mean[f] = paths.x[f] - data.residual[f] + gain @ data.residual[f, at]
        variance = np.diag(covariance) - np.einsum("ij,ji->i", gain, covariance[at])
        deviation[f] = np.sqrt(np.maximum(variance, 0.0))
    return Prediction(mean=mean, deviation=deviation, given=given)


def _covariance(
    data: Linearised, f: int, noise: np.ndarray, spread: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """``(K, K)`` covariance of the true positions of a follower, m²."""
    assert data.step is not None
    assert data.forced is not None
    samples = len(data.residual[f])
    time = data.dt * np.arange(samples)
    columns = np.concatenate([data.by_deviation[f] * spread, data.start[f] * start], -1)
    covariance: np.ndarray = columns @ columns.T
    for p, process in enumerate(data.processes(*noise[:2])):
        # to the process at the samples, and to the rest of its means between them
        response = np.zeros((samples, data.step.shape[-1], 2 * samples - 1))
        for k in range(samples - 1):
            response[k + 1] = data.step[f, k] @ response[k]
            response[k + 1, :, k : k + 2] += process.share * data.forced[f, k, :, p, None]
            response[k + 1, :, samples + k] = 2 * process.rest * data.forced[f, k, :, p]
        positions, rest = np.split(process.sigma * response[:, 0], [samples], 1)
        correlation = np.exp(-np.abs(time[:, None] - time) / process.time)
        covariance += positions @ correlation @ positions.T + rest @ rest.T
    return covariance
