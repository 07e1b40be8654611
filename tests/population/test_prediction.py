"""Prediction from the first seconds of a driver's path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from nnode.population.drivers import initial_variances
from nnode.population.estimate import fit_deviations
from nnode.population.followers import Followers
from nnode.population.likelihood import PushNoise, marginal
from nnode.population.prediction import predict
from tests.diagnosis.platoons import lin
from tests.population.test_drivers import ERROR, platoon_paths

NOISE = {"push": 0.2, "push_time": 4.0, "measurement": ERROR}
VARIANCES = NOISE | {"v0": 0.15}


@pytest.mark.parametrize("seconds", [2.0, 10.0])
def test_predicted_drivers_beat_the_typical_driver_and_bands_cover(seconds: float) -> None:
    paths = platoon_paths(0.15, 11)
    late = paths.dt * np.arange(paths.x.shape[1]) > 10.0
    prediction = predict(lin().double(), paths, VARIANCES, seconds)
    typical = predict(lin().double(), paths, NOISE, seconds).mean
    error = (prediction.mean - paths.x)[:, late]
    assert (error**2).mean() < 0.25 * ((typical - paths.x)[:, late] ** 2).mean()
    deviation = np.sqrt(prediction.deviation**2 + ERROR**2)[:, late]
    # 32 drivers with autocorrelated errors
    assert 0.85 < (np.abs(error) < norm.ppf(0.975) * deviation).mean() <= 1.0


@pytest.mark.parametrize("seconds", [2.0, 8.0])
def test_density_of_the_next_sample_is_the_likelihood_ratio(seconds: float) -> None:
    paths = platoon_paths(0.15, 12)
    paths = replace(paths, agent=np.arange(len(paths.agent)))
    prediction = predict(lin().double(), paths, VARIANCES, seconds)
    following = int(prediction.given.sum())
    deviation = np.sqrt(prediction.deviation[:, following] ** 2 + ERROR**2)
    density = norm.logpdf(paths.x[:, following], prediction.mean[:, following], deviation)
    given = replace(
        paths.starting_from(prediction.given), observed=paths.observed & prediction.given
    )
    model, noise = Followers(lin().double(), given).with_random(["lin.v0"]), PushNoise()
    variances = replace(
        initial_variances(model),
        noise=np.array(list(NOISE.values())),
        spread=np.array([0.15]),
    )
    data = fit_deviations(model, noise, model.start, variances).data
    unchanged = np.zeros(data.fixed.shape[-1])
    extended = replace(data, observed=data.observed.copy())
    extended.observed[:, following] = paths.observed[:, following]
    likelihoods = [
        marginal(
            samples,
            noise.products(samples, variances.noise),
            variances.spread,
            variances.start,
            low=unchanged,
            high=unchanged,
        ).each
        for samples in (data, extended)
    ]
    np.testing.assert_allclose(density, likelihoods[1] - likelihoods[0], rtol=1e-6, atol=1e-6)
