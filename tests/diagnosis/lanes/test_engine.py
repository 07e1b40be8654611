"""The residuals of platoons, their derivatives, and what they tell of hidden effects."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import group_sums
from nnode.data.paths import noise_variance, smooth, velocity
from nnode.data.sequence import Sequence
from nnode.diagnosis.curves import curves, significant_curves
from nnode.diagnosis.lanes.engine import FORGET, LARGE, TrafficEngine, huber_residuals
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.diagnosis.search import converged_fit, search
from nnode.diagnosis.statistics.paired import heldout
from nnode.model import System
from nnode.model.effects import CATALOGUE
from tests.diagnosis.platoons import LENGTH, V0, delayed, lin, platoons, relative_speed

ROW = ParameterVector(lin()).row


@pytest.fixture(scope="module")
def plain() -> list[Sequence]:
    return platoons(driver=0.2)


@pytest.fixture(scope="module")
def reacting() -> list[Sequence]:
    return platoons(relative_speed(0.4), driver=0.2)


def test_noise_is_recognised_and_smoothed_away() -> None:
    t = 0.2 * np.arange(120)[:, None]
    true = 15 * t + 3 * np.sin(0.4 * t + np.arange(4))
    noisy = true + np.random.default_rng(0).normal(0, 0.1, true.shape)
    assert noise_variance(noisy) == pytest.approx(0.01, rel=0.2)
    assert np.sqrt(((smooth(noisy) - true) ** 2).mean()) < 0.05
    speed = 15 + 1.2 * np.cos(0.4 * t + np.arange(4))
    assert np.abs(velocity(true, 0.2) - speed).max() < 0.02


def test_a_right_model_leaves_only_noise(plain: list[Sequence]) -> None:
    engine = TrafficEngine(platoons(noise=0.0))
    errors = engine.squares(lin(), ROW)
    assert np.sqrt(errors.means().max()) < 2e-3
    # nothing that a vehicle did before it forgot its start is compared
    assert len(errors.value) == len(engine.sequence) < sum(s.x[1:, 1:].size for s in plain)


def test_windows_share_out_what_is_compared() -> None:
    long = platoons(number=2, seconds=40.0)
    engine = TrafficEngine(long)
    whole = TrafficEngine(long, np.inf)
    assert len(engine.batch) > len(whole.batch) == 2
    # boundary samples belong to the window before; whole sequences are compared from their start
    samples, vehicles = long[0].x.shape[0], long[0].x.shape[1]
    forgotten = int(FORGET / long[0].dt + 1e-9)
    assert len(whole.sequence) == 2 * (samples - 1) * (vehicles - 1)
    assert len(engine.sequence) == 2 * (samples - 1 - forgotten) * (vehicles - 1)
    assert set(engine.cluster[engine.sequence == 1]).isdisjoint(
        engine.cluster[engine.sequence == 0]
    )


def test_large_residuals_are_drawn_in() -> None:
    r = torch.tensor([0.5, -LARGE, 10 * LARGE], dtype=torch.float64)
    found = huber_residuals(r)
    assert found[:2].tolist() == r[:2].tolist()
    # the square is Huber's loss
    assert float(found[2] ** 2) == pytest.approx(2 * LARGE * 10 * LARGE - LARGE**2)


def test_a_delay_is_simulated_precisely() -> None:
    """Data with a true delay, whose history was kept, against the filter that stands for it."""
    sequences = delayed(0.6)
    engine = TrafficEngine(sequences)
    right = lin({"name": "reaction_delay", "T": 0.6})
    error = engine.squares(right, ParameterVector(right).row).means().mean()
    assert np.sqrt(error) < 0.03
    assert error < 0.05 * engine.squares(lin(), ROW).means().mean()


@pytest.mark.thorough
@pytest.mark.parametrize("data", ["reacting", "plain"])
def test_an_effect_is_named_and_measured_where_it_is_hidden(
    data: str, request: pytest.FixtureRequest
) -> None:
    engine = TrafficEngine(request.getfixturevalue(data))
    base = converged_fit(engine, lin())
    result = search(engine, base, CATALOGUE.of("traffic"))
    if data == "plain":
        assert not result.steps
        assert not significant_curves(engine, base, curves(engine, base, engine.variables()), 0.01)
        assert base.row == pytest.approx([V0, LENGTH], rel=0.05)
        return
    assert [step.chosen.name for step in result.steps] == ["relative_speed"]
    i = result.fit.names.index("terms.1.kappa")
    low, high = result.fit.intervals(engine.cluster)[i]
    assert result.fit.row[i] == pytest.approx(0.4, abs=0.05)
    assert low < 0.4 < high


def test_curves_find_the_variable_of_an_effect() -> None:
    def slow(x: np.ndarray, law: np.ndarray, lead: np.ndarray) -> np.ndarray:
        return law * np.where((x[:, :-1] > 250) & (x[:, :-1] < 330), 0.9, 1.0)

    engine = TrafficEngine(platoons(slow, driver=0.1))
    fit = converged_fit(engine, lin())
    best = curves(engine, fit, engine.variables())[0]
    assert best.variable.name == "position"
    assert best.gain.low > 0


def test_heldout_cost_is_that_of_a_refit(reacting: list[Sequence]) -> None:
    engine = TrafficEngine(reacting)
    fit = converged_fit(engine, lin())
    losses = heldout(fit, engine.cluster)
    rest = TrafficEngine(reacting[1:])
    rest.filter = engine.filter
    again = refine(rest, lin(), tolerance=1e-8)
    one = TrafficEngine(reacting[:1])
    one.filter = engine.filter
    value = one.residuals(lin(), torch.from_numpy(again.row)[None])[0]
    assert losses[0] == pytest.approx(float(value @ value), rel=0.02)


def test_what_one_sequence_knows_alone_is_not_judged_by_the_others() -> None:
    rng = np.random.default_rng(0)
    sequence = np.repeat(np.arange(4), 50)
    jacobian = rng.normal(size=(200, 2))
    one, other = jacobian[sequence == 2].T
    jacobian[:, 1] *= 1e-7
    jacobian[sequence == 2, 1] = other - one * (one @ other) / (one @ one)
    residual = rng.normal(size=200)
    fit = Fit(System([]), ["a", "b"], np.zeros(2), residual, jacobian, np.ones(2, dtype=bool))
    losses = heldout(fit, sequence)
    assert losses[2] == pytest.approx(group_sums(residual**2, sequence)[2], rel=0.1)
    fit.jacobian = jacobian[:, :1]
    fit.free = np.ones(1, dtype=bool)
    np.testing.assert_allclose(losses, heldout(fit, sequence), rtol=1e-3)
