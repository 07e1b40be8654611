"""Deviations of the measurement from a model, against closed forms."""

from __future__ import annotations

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


def platoon(speed: float, leader: float, n: int = 41) -> Sequence:
    """A car 40 m behind another one, both at constant speeds."""
    time = 100 + 0.2 * np.arange(n)
    x = np.stack([speed * (time - 100), 40 + leader * (time - 100)], 1)
    return Sequence(name="r/1", recording="r", time=time, x=x[..., None])


def test_the_deviation_of_a_law_in_equilibrium_is_its_error() -> None:
    # W = 20 (1 - 8/40) = 16 m/s, and the gap of 40 m stays: measured are 18 m/s
    system = Traffic([make_law("lin", v0=20.0, L=8.0)], leader="measured")
    found = deviation(system, [platoon(18.0, 18.0)])
    # simulated, the car falls back and speeds up again
    gap = solve_ivp(lambda t, g: 18 - 20 * (1 - 8 / g), (0, 2), [40.0], rtol=1e-10)
    assert len(found.time) == found.position.size == 7  # of the follower alone
    assert found.value[:, 0] == pytest.approx((gap.y[0, -1] - 40) / 2, rel=1e-5)
    assert found.neighbour[:, 0] == pytest.approx(40.0)
    assert found.neighbour[:, 1] == pytest.approx(0.0, abs=1e-9)
    assert 100 < found.time.min() < found.time.max() < 108


def test_a_leader_that_is_simulated_counts() -> None:
    system = Traffic([make_law("lin", v0=20.0, L=8.0)], leader="constant")
    found = deviation(system, [platoon(16.0, 17.0)])
    leaders = np.isnan(found.neighbour[:, 0])
    assert leaders.sum() == 7
    assert found.value[leaders, 0] == pytest.approx(17.0 - 20.0)
    assert found.neighbour[~leaders, 1] == pytest.approx(1.0)


def test_numbers_of_agents_act_in_every_piece() -> None:
    system = Traffic([make_law("lin", v0=20.0, L=8.0)], leader="measured")
    add_effects(system, [{"name": "driver_heterogeneity", "people": {"r/1": [0.125, 0.0]}}])
    # 1.125 times 16 m/s is what was measured
    found = deviation(system, [platoon(18.0, 18.0)])
    assert found.value[:, 0] == pytest.approx(0.0, abs=1e-9)


def person(acceleration: tuple[float, float], n: int = 31) -> Sequence:
    """Somebody who walks to the right and is accelerated."""
    time = 0.1 * np.arange(n)
    start = np.array([1.0, 0.0])
    x = start * time[:, None] + 0.5 * np.array(acceleration) * time[:, None] ** 2
    goal = np.array([[1e6, 0.0]])
    return Sequence(name="r/1", recording="r", time=time, x=x[:, None], destination=goal)


def test_a_push_that_the_model_lacks_is_found_in_a_crowd() -> None:
    # tau is so long that the relaxation does nothing; what is left is the push itself
    found = deviation(Crowd([make_law("relaxation", tau=1e9)]), [person((0.2, -0.3))])
    assert found.value == pytest.approx(np.tile([0.2, -0.3], (len(found.time), 1)), abs=1e-6)
    assert np.isnan(found.neighbour).all()  # nobody else is there


def test_velocities_are_exact_for_parabolas() -> None:
    sequence = person((0.2, -0.3))
    expected = np.array([1.0, 0.0]) + sequence.time[:, None] * np.array([0.2, -0.3])
    assert smooth_velocity(sequence)[:, 0] == pytest.approx(expected)


def test_the_nearest_person_is_seen_in_one_s_own_way() -> None:
    x = np.array([[0.0, 0.0], [0.0, 1.0], [5.0, 0.0]])
    v = np.array([[0.0, 2.0], [-1.0, 0.0], [0.0, 0.0]])
    found = nearest(x, v)
    assert found[0] == pytest.approx([1.0, 0.0])  # walks towards him
    assert found[1] == pytest.approx([0.0, 1.0])  # walks to the left of the picture: on the left
    assert np.isnan(found[2]).all()  # stands still
    assert np.isnan(nearest(x[:1], v[:1])).all()


def test_own_frame_keeps_lengths() -> None:
    rng = np.random.default_rng(0)
    vectors, v = rng.standard_normal((2, 20, 2))
    turned = in_walking_frame(vectors, v)
    assert np.linalg.norm(turned, axis=1) == pytest.approx(np.linalg.norm(vectors, axis=1))
    assert in_walking_frame(v, v)[:, 1] == pytest.approx(0.0, abs=1e-12)


def test_a_simulation_that_blows_up_spoils_no_other() -> None:
    system = Traffic([make_law("lin", v0=20.0, L=8.0)], leader="measured")
    good, bad = platoon(16.0, 16.0), platoon(16.0, 16.0)
    x = bad.x.copy()
    x[0, 0] = x[0, 1]  # no gap at the start: the law has a pole there
    bad = Sequence(name="r/2", recording="r", time=bad.time, x=x)
    first, second = simulate(system, [good, bad])
    assert first is not None
    assert first[:, 0, 0] == pytest.approx(good.x[:, 0, 0])
    assert second is None
    found = deviation(system, [bad])
    assert np.isfinite(found.value).all()


@pytest.mark.parametrize("law", ["gipps", "krauss", "newell"])
def test_laws_that_name_the_length_of_a_step_are_drawn(law: str) -> None:
    system = build_model(model_options(law, leader="measured"), 0, torch.float64)
    found = deviation(system, [platoon(16.0, 16.0)])
    assert len(found.time) == 7
    if law == "newell":  # at once where the leader was T before, less d: 22 m behind it, not 40 m
        own = {name.rpartition(".")[2]: p.item() for name, p in system.named_parameters()}
        wanted = (own["d"] + 16.0 * own["T"] - 40.0) / 2
        assert found.value[:, 0] == pytest.approx(wanted)
    else:  # no more than a comfortable acceleration of 2 m/s² away from a steady drive
        assert np.abs(found.value).max() < 4.0
