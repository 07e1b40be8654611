"""Deviations of measured from simulated motion, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from nnode.app.python.inputs import model_options
from nnode.data.sequence import Sequence
from nnode.diagnosis.report.deviation import (
    deviation,
    in_walking_frame,
    nearest,
    simulate,
    smooth_velocity,
)
from nnode.model import Crowd, Traffic, make_law
from nnode.model.build import add_effects, build_model


def lin(leader: str = "measured") -> Traffic:
    return Traffic([make_law("lin", v0=20.0, L=8.0)], leader=leader)


def platoon(speed: float, leader: float, n: int = 41) -> Sequence:
    """A car 40 m behind another one at constant speeds."""
    time = 100 + 0.2 * np.arange(n)
    x = np.stack([speed * (time - 100), 40 + leader * (time - 100)], 1)
    return Sequence(name="r/1", recording="r", time=time, x=x[..., None])


def test_deviation_of_law_in_equilibrium() -> None:
    # W = 20 (1 - 8/40) = 16 m/s at a gap of 40 m, but the measured speed is 18 m/s
    result = deviation(lin(), [platoon(18.0, 18.0)])
    # the simulated car falls back and accelerates
    gap = solve_ivp(lambda t, g: 18 - 20 * (1 - 8 / g), (0, 2), [40.0], rtol=1e-10)
    assert len(result.time) == result.position.size == 7  # of the follower
    assert result.value[:, 0] == pytest.approx((gap.y[0, -1] - 40) / 2, rel=1e-5)
    assert result.neighbour[:, 0] == pytest.approx(40.0)
    assert result.neighbour[:, 1] == pytest.approx(0.0, abs=1e-9)
    assert 100 < result.time.min() < result.time.max() < 108


def test_deviation_of_simulated_leader() -> None:
    result = deviation(lin("constant"), [platoon(16.0, 17.0)])
    leaders = np.isnan(result.neighbour[:, 0])
    assert leaders.sum() == 7
    assert result.value[leaders, 0] == pytest.approx(17.0 - 20.0)
    assert result.neighbour[~leaders, 1] == pytest.approx(1.0)


def test_deviation_with_individual_parameters() -> None:
    system = lin()
    add_effects(system, [{"name": "driver_heterogeneity", "people": {"r/1": [0.125, 0.0]}}])
    # the measured speed is 1.125 times 16 m/s
    result = deviation(system, [platoon(18.0, 18.0)])
    assert result.value[:, 0] == pytest.approx(0.0, abs=1e-9)


def person(acceleration: tuple[float, float], n: int = 31) -> Sequence:
    """A person who walks to the right with a constant acceleration."""
    time = 0.1 * np.arange(n)
    start = np.array([1.0, 0.0])
    x = start * time[:, None] + 0.5 * np.array(acceleration) * time[:, None] ** 2
    goal = np.array([[1e6, 0.0]])
    return Sequence(name="r/1", recording="r", time=time, x=x[:, None], destination=goal)


def test_deviation_in_crowd_is_missing_acceleration() -> None:
    # with a long tau, the relaxation is negligible
    result = deviation(Crowd([make_law("relaxation", tau=1e9)]), [person((0.2, -0.3))])
    assert result.value == pytest.approx(np.tile([0.2, -0.3], (len(result.time), 1)), abs=1e-6)
    assert np.isnan(result.neighbour).all()  # there are no neighbours


def test_velocity_of_parabola_is_exact() -> None:
    sequence = person((0.2, -0.3))
    expected = np.array([1.0, 0.0]) + sequence.time[:, None] * np.array([0.2, -0.3])
    assert smooth_velocity(sequence)[:, 0] == pytest.approx(expected)


def test_nearest_person_in_walking_frame() -> None:
    x = np.array([[0.0, 0.0], [0.0, 1.0], [5.0, 0.0]])
    v = np.array([[0.0, 2.0], [-1.0, 0.0], [0.0, 0.0]])
    offset = nearest(x, v)
    assert offset[0] == pytest.approx([1.0, 0.0])  # straight ahead
    assert offset[1] == pytest.approx([0.0, 1.0])  # on the left
    assert np.isnan(offset[2]).all()  # a person who stands has no frame
    assert np.isnan(nearest(x[:1], v[:1])).all()


def test_walking_frame_keeps_lengths() -> None:
    rng = np.random.default_rng(0)
    vectors, v = rng.standard_normal((2, 20, 2))
    turned = in_walking_frame(vectors, v)
    assert np.linalg.norm(turned, axis=1) == pytest.approx(np.linalg.norm(vectors, axis=1))
    assert in_walking_frame(v, v)[:, 1] == pytest.approx(0.0, abs=1e-12)


def test_diverging_simulation_affects_no_other() -> None:
    system = lin()
    good = platoon(16.0, 16.0)
    x = good.x.copy()
    x[0, 0] = x[0, 1]  # the law has a pole at a gap of zero
    bad = replace(good, name="r/2", x=x)
    first, second = simulate(system, [good, bad])
    assert first is not None
    assert first[:, 0, 0] == pytest.approx(good.x[:, 0, 0])
    assert second is None
    result = deviation(system, [bad])
    assert np.isfinite(result.value).all()


@pytest.mark.parametrize("law", ["gipps", "krauss", "newell"])
def test_deviation_of_discrete_laws(law: str) -> None:
    system = build_model(model_options(law, leader="measured"), 0, torch.float64)
    result = deviation(system, [platoon(16.0, 16.0)])
    assert len(result.time) == 7
    if law == "newell":  # the position is that of the leader T before, less d
        values = {name.rpartition(".")[2]: p.item() for name, p in system.named_parameters()}
        expected = (values["d"] + 16.0 * values["T"] - 40.0) / 2
        assert result.value[:, 0] == pytest.approx(expected)
    else:  # the motion differs from the equilibrium by a comfortable acceleration of 2 m/s²
        assert np.abs(result.value).max() < 4.0
