"""Drivers without SUMO: speeds, memory, empty roads, and refused models."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike
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
    v: ArrayLike, gap: ArrayLike, lead: list[int] | None = None, **more: Any
) -> DriverInputs:
    """Vehicles; leaders outside of the list have the speed of their followers."""
    speed, nobody = np.array(v, float), np.full(len(v), np.inf)
    leader = np.full(len(v), -1) if lead is None else np.array(lead)
    values = {
        "v": speed,
        "gap": np.array(gap, float),
        "v_1": np.where(leader >= 0, speed[leader], speed),
        "length_1": np.full(len(v), 5.0),
        "lead": leader,
        "gap_1": nobody,
        "v_2": speed,
        "x": 0 * speed,
    }
    return DriverInputs(**{**values, **{k: np.array(value, float) for k, value in more.items()}})


def idm(v: float, net: float, dv: float) -> float:
    """The IDM of Treiber, Hennecke & Helbing 2000 with the package's default parameters."""
    v0, T, s0, a, b = 30.0, 1.2, 2.0, 1.3, 1.7
    desired_gap = s0 + max(v * T + v * dv / (2 * np.sqrt(a * b)), 0.0)
    return a * (1 - (v / v0) ** 4 - (desired_gap / net) ** 2)


def drivers_of(system: System, number: int, method: str = "euler", **options: Any) -> Drivers:
    """Drivers who have entered."""
    drivers = Drivers(system, DT, method, **options)
    drivers.enter([()] * number)
    return drivers


def test_one_step_of_idm() -> None:
    drivers = drivers_of(model("idm"), 3, "semi_implicit")
    vehicles = observed([12.0, 14.0, 3.0], [25.0, np.inf, 6.0], v_1=[11.0, 0.0, 0.0])
    speeds = drivers.speeds(0.0, vehicles)
    free = 14 + DT * 1.3 * (1 - (14 / 30) ** 4)
    np.testing.assert_allclose(speeds[0], 12 + DT * idm(12.0, 20.0, 1.0), rtol=1e-12)
    np.testing.assert_allclose(speeds[1], free, rtol=1e-9)  # an empty road is 1e9 m long
    assert 0 <= speeds[2] < 3.0


def test_gaps_without_lengths_are_front_to_front() -> None:
    drivers = drivers_of(model("idm"), 1, "semi_implicit", lengths=False)
    speeds = drivers.speeds(0.0, observed([12.0], [25.0]))
    np.testing.assert_allclose(speeds, 12 + DT * idm(12.0, 25.0, 0.0), rtol=1e-12)


def test_speeds_are_not_negative() -> None:
    for name, method in (("lin", "euler"), ("idm", "ballistic")):
        drivers = drivers_of(model(name), 1, method)
        assert drivers.speeds(0.0, observed([0.5], [0.2])) == [0.0]


def test_memory_belongs_to_a_driver() -> None:
    """Other drivers who come and go do not change a driver's inertia."""
    inertia = {"inertia": {"tau_v": 2.0}}
    alone = drivers_of(model("idm", inertia), 1, "semi_implicit")
    among_others = drivers_of(model("idm", inertia), 2, "semi_implicit")
    v = 10.0
    for k in range(30):
        gap = 30.0 if k < 15 else 12.0  # another vehicle cuts in
        if k == 10:
            among_others.keep(np.array([False, True]))
        if k == 20:
            among_others.enter([(), ()])
        index, n = int(k < 10), len(among_others)
        speeds, gaps = np.full(n, 8.0), np.full(n, 50.0 if k < 10 else 40.0)
        speeds[index], gaps[index] = v, gap
        expected = alone.speeds(k * DT, observed([v], [gap]))[0]
        assert among_others.speeds(k * DT, observed(speeds, gaps))[index] == expected
        v = float(expected)
    assert len(among_others) == 3


def test_delay_starts_when_a_driver_enters() -> None:
    drivers = drivers_of(model("idm", {"pure_delay": {"T": 0.3}}), 1, "semi_implicit")
    speeds = [
        float(drivers.speeds(k * DT, observed([12.0], [gap]))[0])
        for k, gap in enumerate([25.0, 60.0, 60.0, 60.0, 60.0])
    ]
    before, after = (12 + DT * idm(12.0, gap - 5, 0.0) for gap in (25.0, 60.0))
    np.testing.assert_allclose(speeds, [before] * 4 + [after], rtol=1e-12)


def test_leaders_are_computed_before_followers() -> None:
    """The effect relative_speed uses the leader's speed in the same step."""
    kappa, v0, L = 0.3, 30.0, 5.0
    drivers = drivers_of(model("lin", {"relative_speed": {"kappa": kappa}}), 4)
    gaps = [20.0, 30.0, 25.0, 40.0]  # 2 follows 0, 0 follows 3, 3 a vehicle of SUMO, 1 nobody
    lead = [3, -1, 0, -1]
    vehicles = observed([9.0] * 4, [20.0, np.inf, 25.0, 40.0], lead, v_1=[9, 9, 9, 7])
    speeds = drivers.speeds(0.0, vehicles)
    law = [v0 - v0 * L / gap for gap in gaps]
    third = law[3] + kappa * (7 - law[3])
    zeroth = law[0] + kappa * (third - law[0])
    second = law[2] + kappa * (zeroth - law[2])
    free = v0 + kappa * (9 - v0)
    np.testing.assert_allclose(speeds, [zeroth, free, second, third], rtol=1e-6)


def test_leaders_first_with_a_ring() -> None:
    groups = leaders_first(np.array([1, 2, -1, 2, 5, 6, 4]))
    assert sorted(np.concatenate(groups)) == list(range(7))
    assert [g.tolist() for g in groups[:3]] == [[2], [1, 3], [0]]
    assert [g.tolist() for g in groups[3:]] == [[4], [6], [5]]


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["lin", "idm", "ovm", "fvdm", "gipps", "krauss"])
def test_speed_on_an_empty_road(name: str) -> None:
    drivers = drivers_of(model(name), 1, "semi_implicit")
    v = 10.0
    for k in range(3000):
        v = float(drivers.speeds(k * DT, observed([v], [np.inf]))[0])
    assert v == pytest.approx(30.0, rel=2e-3)  # Gipps' law approaches v0 slowly


@pytest.mark.parametrize("name", ["log", "helly", "newell", "n4", "a2"])
def test_laws_without_free_speed_need_a_distance(name: str) -> None:
    with pytest.raises(ConfigError, match=r"has no speed on an empty road.*far=100"):
        Drivers(model(name), DT, "semi_implicit")
    Drivers(model(name), DT, "semi_implicit", far=100.0)


def test_memory_of_gaps_needs_a_distance() -> None:
    with pytest.raises(ConfigError, match=r"lin with reaction_delay has no speed"):
        Drivers(model("lin", {"reaction_delay": {"T": 0.5}}), DT, "euler")


def test_distant_leaders_are_ignored() -> None:
    drivers = drivers_of(model("helly"), 3, "semi_implicit", far=80.0)
    leaders = {"v_1": [9.0, 2.0, 9.0], "length_1": [0.0, 5.0, 0.0]}
    speeds = drivers.speeds(0.0, observed([9.0] * 3, [np.inf, 81.0, 80.0], **leaders))
    assert speeds[0] == speeds[1] == speeds[2]
    for far in (0.0, -1.0, 2e6):
        with pytest.raises(ConfigError, match=r"far=.* must be a distance"):
            Drivers(model("helly"), DT, "semi_implicit", far=far)


def test_paces_have_the_fitted_distribution() -> None:
    sigma, n = 0.12, 4000
    effect = {"name": "driver_heterogeneity", "sigma": sigma, "people": {"a": [0.1, -0.1]}}

    def speeds(seed: int) -> np.ndarray:
        drivers = drivers_of(model("lin", effect), n, seed=seed)
        return drivers.speeds(0.0, observed([9.0] * n, [20.0] * n))

    pace = speeds(1) / (30.0 * (1 - 5 / 20)) - 1
    assert abs(pace.mean()) < 4 * sigma / np.sqrt(n)
    assert pace.std() == pytest.approx(sigma, rel=4 / np.sqrt(2 * n))
    np.testing.assert_array_equal(speeds(1), speeds(1))
    assert (speeds(1) != speeds(2)).any()


def test_paces_have_the_spread_of_observed_drivers() -> None:
    effect = {"name": "driver_heterogeneity", "people": {"a": [0.3, -0.3], "b": [0.3, -0.3]}}
    drivers = drivers_of(model("lin", effect), 4000)
    pace = drivers.speeds(0.0, observed([9.0] * 4000, [20.0] * 4000)) / 22.5 - 1
    assert pace.std() == pytest.approx(0.3, rel=0.05)
    assert pace.min() >= -0.9  # speeds stay positive


def test_vehicle_class_applies_to_its_members() -> None:
    effect = {"vehicle_class": {"kind": "truck", "phi": 0.5}}
    drivers = drivers_of(model("lin", effect), 0)
    drivers.enter([{"own", "truck"}, {"own", "passenger"}])
    slow, fast = drivers.speeds(0.0, observed([9.0] * 2, [20.0] * 2))
    assert slow == pytest.approx(fast / 2)


def test_speed_that_is_not_a_number_is_an_error() -> None:
    parameters = {"v0": "30 m/s", "L": "6 m"}
    law = {"parameters": parameters, "rate": {"x": "v0*sqrt((gap - L)/L)"}}
    options = model_options({"term": "formula", "name": "own", "law": law}, "measured")
    drivers = drivers_of(build_model(options).double(), 1, far=100.0)
    with np.errstate(invalid="ignore"), pytest.raises(SimulationError, match=r"gap of 5\.5 m"):
        drivers.speeds(3.0, observed([9.0], [5.5]))


class Coded(FollowTheLeader):
    """A law in Python code."""

    name = "coded"

    def speed(self, gap: Tensor) -> Tensor:
        return torch.tanh(gap)


def test_models_that_cannot_drive_are_refused() -> None:
    length = model("lin", {"leader_length": {"beta": 0.3}})
    for system, message in (
        (model("sf"), r"one of people.*JuPedSim"),
        (Traffic([Coded(20.0)]), "Python code"),
        (length, r"leader_length needs longer.*SUMO cannot tell"),
    ):
        with pytest.raises(ConfigError, match=message):
            drivable(system)
    drivable(model("lin", {"leader_speed": {"weight": 0.5}}, leader="constant"))
    drivable(Traffic([make_law("lin")]))
