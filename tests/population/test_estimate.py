"""Searches for estimates that cannot converge step by step."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

import nnode
from benchmarks.drivers import platoons
from nnode.app.python.inputs import model_options
from nnode.errors import SimulationError
from nnode.model.build import build_model
from nnode.population.drivers import LONGEST, initial_variances
from nnode.population.estimate import STEPS, Variances, estimate
from nnode.population.followers import Followers, paths_of
from nnode.population.likelihood import Linearised, PushNoise, WhiteNoise

DRIVERS, SAMPLES = 8, 5
VARIANCES = Variances(
    noise=np.ones(1),
    spread=np.zeros(0),
    start=np.zeros(0),
    low=np.full(1, 0.1),
    high=np.full(1, 10.0),
)


class Kink:
    """The response 1 + |theta| of all samples, which are 0: steps jump across the kink at 0."""

    def __init__(self) -> None:
        self.tried: list[float] = []

    def __call__(self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        self.tried.append(float(theta[0]))
        shape = DRIVERS, SAMPLES
        errors = 0.1 * np.random.default_rng(1).standard_normal(shape)
        return Linearised(
            residual=errors - 1 - abs(theta[0]),
            fixed=np.full((*shape, 1), np.sign(theta[0])),
            random=np.zeros(0, dtype=int),
            start=np.zeros((*shape, 0)),
            observed=np.ones(shape, dtype=bool),
            agent=np.arange(DRIVERS),
        )


def test_a_search_around_a_kink_ends_with_its_most_likely_iterate() -> None:
    model = Kink()
    result = estimate(model, WhiteNoise(), np.array([0.7]), VARIANCES)
    assert abs(result.theta[0]) == min(abs(theta) for theta in model.tried)
    assert not result.converged


@pytest.mark.thorough
def test_further_steps_never_make_an_estimate_less_likely() -> None:
    sequences = nnode.sequences(platoons("idm", "speed_zone", 0.15, 3, 4, 4, 0.0))
    # far from the zone that slows the vehicles, steps raise the pushes in place of the likelihood
    zone = {"name": "speed_zone", "alpha": 0.8, "a": 200.0, "b": 380.0}
    system = build_model(model_options("idm", "measured", effects=[zone])).double()
    model = Followers(system, paths_of(list(sequences), 0.2)).with_random(["idm.T"])

    def loglik(steps: int) -> float:
        result = estimate(
            model,
            PushNoise(),
            model.start,
            initial_variances(model),
            low=model.low,
            high=model.high,
            longest=LONGEST,
            steps=steps,
        )
        assert result.steps < STEPS
        return result.marginal.unchanged

    assert loglik(STEPS) >= loglik(5)


class Overflow(Kink):
    """The same, whose simulations reach numbers that cannot be squared where theta is negative."""

    def __call__(self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        data = super().__call__(theta, agents, start)
        return replace(data, residual=data.residual * 1e200) if theta[0] < 0 else data


def test_trial_parameters_that_blow_up_are_refused_without_a_warning() -> None:
    model = Overflow()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = estimate(model, WhiteNoise(), np.array([0.7]), VARIANCES)
    assert min(model.tried) < 0 < result.theta[0]


@pytest.mark.parametrize("limit", [0.0, 0.5])
def test_steps_to_an_unstable_linear_response_are_not_taken(limit: float) -> None:
    """The samples are 1 - theta, and small changes grow without bound where theta > ``limit``."""

    def response(theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        shape = DRIVERS, SAMPLES
        growth = 1e200 if theta[0] > limit else 1.0
        return replace(
            Kink()(np.ones(1), agents, start),
            residual=np.full(shape, 1 - theta[0]),
            step=np.full((DRIVERS, SAMPLES - 1, 1, 1), growth),
            forced=np.ones((DRIVERS, SAMPLES - 1, 1, 2)),
        )

    noise = np.array([0.1, 1.0, 0.1])
    variances = replace(VARIANCES, noise=noise, low=noise, high=noise)
    if limit == 0.0:
        with pytest.raises(SimulationError, match="linear response"):
            estimate(response, PushNoise(), np.array([0.1]), variances)
        return
    result = estimate(response, PushNoise(), np.array([0.1]), variances)
    assert result.theta[0] == 0.1
    assert not result.converged
