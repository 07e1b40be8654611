"""Drivers without a program that moves them: memories, empty roads, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.app.python.inputs import model_options
from nnode.errors import ConfigError, SimulationError
from nnode.exchange.drivers import DriverInputs, Drivers, drivable, leaders_first
from nnode.model import System, Traffic, build_model, make_law
from nnode.model.laws import FollowTheLeader

DT = 0.1


def model(name: str, *effects: dict[str, Any], leader: str = "measured") -> System:
    return build_model({**model_options(name, leader), "effects": list(effects)}).double()


def observed(
    v: list[float], gap: list[float], lead: list[int] | None = None, **more: Any
) -> DriverInputs:
    """Vehicles whose leaders, where they are others, drive as fast as they do."""
    own, far = np.array(v, float), np.full(len(v), np.inf)
    who = np.full(len(v), -1) if lead is None else np.array(lead)
    values = {
        "v": own,
        "gap": np.array(gap, float),
        "v_1": np.where(who >= 0, own[who], own),
        "length_1": np.full(len(v), 5.0),
        "lead": who,
        "gap_1": far,
        "v_2": own,
        "x": 0 * own,
    }
    return DriverInputs(**{**values, **{k: np.array(value, float) for k, value in more.items()}})


def idm(v: float, net: float, dv: float) -> float:
    """Its formula with the values of ``FIELD``, by hand; Treiber, Hennecke & Helbing 2000."""
    v0, T, s0, a, b = 30.0, 1.2, 2.0, 1.3, 1.7
    wish = s0 + max(v * T + v * dv / (2 * np.sqrt(a * b)), 0.0)
    return a * (1 - (v / v0) ** 4 - (wish / net) ** 2)


def test_one_step_of_idm_is_its_formula() -> None:
    drivers = Drivers(model("idm"), DT, "semi_implicit")
    drivers.enter([()] * 3)
    said = drivers.speeds(
        0.0, observed([12.0, 14.0, 3.0], [25.0, np.inf, 6.0], v_1=[11.0, 0.0, 0.0])
    )
    alone = 14 + DT * 1.3 * (1 - (14 / 30) ** 4)
    np.testing.assert_allclose(said[0], 12 + DT * idm(12.0, 20.0, 1.0), rtol=1e-12)
    np.testing.assert_allclose(said[1], alone, rtol=1e-9)  # an empty road is 1e9 m long
    assert 0 <= said[2] < 3.0


def test_gaps_from_front_to_front_where_no_lengths_were_known() -> None:
    drivers = Drivers(model("idm"), DT, "semi_implicit", lengths=False)
    drivers.enter([()])
    said = drivers.speeds(0.0, observed([12.0], [25.0]))
    np.testing.assert_allclose(said, 12 + DT * idm(12.0, 25.0, 0.0), rtol=1e-12)


def test_nobody_drives_backwards() -> None:
    first, second = Drivers(model("lin"), DT, "euler"), Drivers(model("idm"), DT, "ballistic")
    for drivers in (first, second):
        drivers.enter([()])
        assert drivers.speeds(0.0, observed([0.5], [0.2])) == [0.0]


def test_memories_belong_to_drivers() -> None:
    """With others that come and go, and another leader, somebody's inertia is his own."""
    effect = {"inertia": {"tau_v": 2.0}}
    alone, among = (Drivers(model("idm", effect), DT, "semi_implicit") for _ in range(2))
    alone.enter([()])
    among.enter([(), ()])
    v = 10.0
    for k in range(30):
        gap = 30.0 if k < 15 else 12.0  # another vehicle cuts in
        if k == 10:
            among.keep(np.array([False, True]))
        if k == 20:
            among.enter([(), ()])
        one = alone.speeds(k * DT, observed([v], [gap]))
        here = 1 if k < 10 else 0
        others = [8.0] * (len(among) - 1)
        speeds, gaps = (
            ([8.0, v], [50.0, gap]) if here else ([v, *others], [gap, *[40.0] * len(others)])
        )
        many = among.speeds(k * DT, observed(speeds, gaps))
        assert many[here] == one[0]
        v = float(one[0])
    # and it is one: after 1 s the acceleration is still between those of both gaps
    assert len(among) == 3


def test_a_delay_begins_where_a_driver_is_taken_over() -> None:
    drivers = Drivers(model("idm", {"pure_delay": {"T": 0.3}}), DT, "semi_implicit")
    drivers.enter([()])
    now = [
        float(drivers.speeds(k * DT, observed([12.0], [gap]))[0])
        for k, gap in enumerate([25.0, 60.0, 60.0, 60.0, 60.0])
    ]
    before, after = (12 + DT * idm(12.0, gap - 5, 0.0) for gap in (25.0, 60.0))
    np.testing.assert_allclose(now, [before] * 4 + [after], rtol=1e-12)


def test_who_looks_at_the_speed_ahead_is_computed_after_it() -> None:
    """relative_speed: the speed ahead is what the whole model says in the same step."""
    kappa, v0, L = 0.3, 30.0, 5.0
    drivers = Drivers(model("lin", {"relative_speed": {"kappa": kappa}}), DT, "euler")
    drivers.enter([()] * 4)
    gaps = [20.0, 30.0, 25.0, 40.0]  # 2 follows 0, 0 follows 3, 3 a vehicle of SUMO's, 1 nobody
    lead = [3, -1, 0, -1]
    said = drivers.speeds(
        0.0, observed([9.0] * 4, [20.0, np.inf, 25.0, 40.0], lead, v_1=[9, 9, 9, 7])
    )
    law = [v0 - v0 * L / gap for gap in gaps]
    third = law[3] + kappa * (7 - law[3])
    zeroth = law[0] + kappa * (third - law[0])
    second = law[2] + kappa * (zeroth - law[2])
    free = v0 + kappa * (9 - v0)
    np.testing.assert_allclose(said, [zeroth, free, second, third], rtol=1e-6)


def test_an_order_for_everybody_even_in_a_ring() -> None:
    groups = leaders_first(np.array([1, 2, -1, 2, 5, 6, 4]))
    assert sorted(np.concatenate(groups)) == list(range(7))
    assert [g.tolist() for g in groups[:3]] == [[2], [1, 3], [0]]
    assert [g.tolist() for g in groups[3:]] == [[4], [6], [5]]


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["lin", "idm", "ovm", "fvdm", "gipps", "krauss"])
def test_laws_with_a_speed_on_an_empty_road(name: str) -> None:
    drivers = Drivers(model(name), DT, "semi_implicit")
    drivers.enter([()])
    v = 10.0
    for k in range(3000):
        v = float(drivers.speeds(k * DT, observed([v], [np.inf]))[0])
    assert v == pytest.approx(30.0, rel=2e-3)  # v0; gipps' approaches it slowly


@pytest.mark.parametrize("name", ["log", "helly", "newell", "n4", "a2"])
def test_laws_without_one_need_a_distance_that_is_far(name: str) -> None:
    with pytest.raises(ConfigError, match=r"has no speed on an empty road.*far=100"):
        Drivers(model(name), DT, "semi_implicit")
    Drivers(model(name), DT, "semi_implicit", far=100.0)


def test_so_do_effects_that_remember_gaps() -> None:
    with pytest.raises(ConfigError, match=r"lin with reaction_delay has no speed"):
        Drivers(model("lin", {"reaction_delay": {"T": 0.5}}), DT, "euler")


def test_what_is_far_away_is_nobody() -> None:
    drivers = Drivers(model("helly"), DT, "semi_implicit", far=80.0)
    drivers.enter([()] * 3)
    said = drivers.speeds(
        0.0,
        observed([9.0] * 3, [np.inf, 81.0, 80.0], v_1=[9.0, 2.0, 9.0], length_1=[0.0, 5.0, 0.0]),
    )
    assert said[0] == said[1] == said[2]
    for far in (0.0, -1.0, 2e6):
        with pytest.raises(ConfigError, match=r"far=.* must be a distance"):
            Drivers(model("helly"), DT, "semi_implicit", far=far)


def test_drivers_who_differ_are_drawn_from_the_fitted_distribution() -> None:
    sigma, n = 0.12, 4000
    effect = {"name": "driver_heterogeneity", "sigma": sigma, "people": {"a": [0.1, -0.1]}}

    def speeds(seed: int) -> np.ndarray:
        drivers = Drivers(model("lin", effect), DT, "euler", seed=seed)
        drivers.enter([()] * n)
        return drivers.speeds(0.0, observed([9.0] * n, [20.0] * n))

    pace = speeds(1) / (30.0 * (1 - 5 / 20)) - 1
    assert abs(pace.mean()) < 4 * sigma / np.sqrt(n)
    assert pace.std() == pytest.approx(sigma, rel=4 / np.sqrt(2 * n))
    np.testing.assert_array_equal(speeds(1), speeds(1))
    assert (speeds(1) != speeds(2)).any()


def test_without_a_spread_it_is_that_of_the_drivers_who_were_seen() -> None:
    effect = {"name": "driver_heterogeneity", "people": {"a": [0.3, -0.3], "b": [0.3, -0.3]}}
    drivers = Drivers(model("lin", effect), DT, "euler")
    drivers.enter([()] * 4000)
    said = drivers.speeds(0.0, observed([9.0] * 4000, [20.0] * 4000)) / 22.5 - 1
    assert said.std() == pytest.approx(0.3, rel=0.05)
    assert said.min() >= -0.9  # nobody's pace is turned round


def test_a_class_acts_on_its_own() -> None:
    effect = {"vehicle_class": {"kind": "truck", "phi": 0.5}}
    drivers = Drivers(model("lin", effect), DT, "euler")
    drivers.enter([{"own", "truck"}, {"own", "passenger"}])
    slow, fast = drivers.speeds(0.0, observed([9.0] * 2, [20.0] * 2))
    assert slow == pytest.approx(fast / 2)


def test_numbers_that_are_none() -> None:
    parameters = {"v0": "30 m/s", "L": "6 m"}
    law = {"parameters": parameters, "rate": {"x": "v0*sqrt((gap - L)/L)"}}
    options = model_options({"term": "formula", "name": "own", "law": law}, "measured")
    drivers = Drivers(build_model(options).double(), DT, "euler", far=100.0)
    drivers.enter([()])
    with np.errstate(invalid="ignore"), pytest.raises(SimulationError, match=r"gap of 5\.5 m"):
        drivers.speeds(3.0, observed([9.0], [5.5]))


class Coded(FollowTheLeader):
    """A law that is Python code."""

    name = "coded"

    def speed(self, gap: Tensor) -> Tensor:
        return torch.tanh(gap)


def test_what_cannot_drive_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"one of people.*JuPedSim"):
        drivable(build_model(model_options("sf", "measured")))
    with pytest.raises(ConfigError, match="Python code"):
        drivable(Traffic([Coded(20.0)]))
    with pytest.raises(ConfigError, match=r"leader_length needs longer.*SUMO cannot tell"):
        drivable(model("lin", {"leader_length": {"beta": 0.3}}))
    drivable(model("lin", {"leader_speed": {"weight": 0.5}}, leader="constant"))
    drivable(Traffic([make_law("lin")]))
