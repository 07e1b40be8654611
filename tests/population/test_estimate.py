"""Estimation where single steps fail: kinks, overflow and unstable responses."""

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
    """The response 1 + |theta| to samples of 0; search steps jump across the kink at 0."""

    def __init__(self) -> None:
        self.trials: list[float] = []

    def __call__(self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        self.trials.append(float(theta[0]))
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


def test_search_across_a_kink_returns_the_best_iterate() -> None:
    model = Kink()
    result = estimate(model, WhiteNoise(), np.array([0.7]), VARIANCES)
    assert abs(result.theta[0]) == min(abs(theta) for theta in model.trials)
    assert not result.converged


@pytest.mark.thorough
def test_more_steps_do_not_lower_the_likelihood() -> None:
    sequences = nnode.sequences(platoons("idm", "speed_zone", 0.15, 3, 4, 4, 0.0))
    # the zone starts far from the true one: steps raise the pushes, not the likelihood
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
    """A :class:`Kink` whose residuals overflow when squared where theta is negative."""

    def __call__(self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        data = super().__call__(theta, agents, start)
        return replace(data, residual=data.residual * 1e200) if theta[0] < 0 else data


def test_overflowing_trials_are_rejected_without_warning() -> None:
    model = Overflow()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = estimate(model, WhiteNoise(), np.array([0.7]), VARIANCES)
    assert min(model.trials) < 0 < result.theta[0]


@pytest.mark.parametrize("limit", [0.0, 0.5])
def test_steps_to_an_unstable_linear_response_are_rejected(limit: float) -> None:
    """The residual is 1 - theta, and small changes grow without bound where theta > ``limit``."""

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
