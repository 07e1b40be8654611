"""Export of calibrated parameters to JuPedSim and SUMO, and parameters without a counterpart."""

from __future__ import annotations

import json
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError
from nnode.exchange.jupedsim import (
    Scenes,
    has_parameters,
    jupedsim_parameters,
    points_per_edge,
    scenes_of,
)
from nnode.exchange.sumo import equilibrium_gap, has_type, sumo_type, traffic_of
from nnode.model import Crowd, System, Traffic, make_law
from nnode.model.build import add_effects
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS, law_from
from tests.builders import lane, people

SCENES = Scenes(people=12.0, points=50.0, spacing=0.25, speed=1.3)


def crowd(**options: object) -> Crowd:
    force = make_law("social_force", A=30.0, k=10.0, kappa=5.0, **options)  # type: ignore[arg-type]
    return Crowd([make_law("relaxation", tau=0.7), force])


def test_social_force_for_jupedsim() -> None:
    result = jupedsim_parameters(crowd(r=0.2, B=0.1, mass=2.0), SCENES)
    content = json.loads(result.text)
    assert content["model"] == {"body_force": 10.0, "friction": 5.0}
    agent = content["agent"]
    obstacle = agent.pop("obstacle_scale")
    assert obstacle == pytest.approx(30 * 12 / 50 * points_per_edge(0.2, 0.1, 0.25))
    assert agent == {
        "mass": 24.0,
        "desired_speed": 1.3,
        "reaction_time": 0.7,
        "agent_scale": 30.0,
        "force_distance": 0.1,
        "radius": 0.2,
    }
    assert content["no_counterpart"] == result.missing


def test_parts_without_a_counterpart_are_listed() -> None:
    plain = jupedsim_parameters(crowd(), SCENES).missing
    assert not any("opposing" in line or "effect" in line for line in plain)
    model = crowd(opposing_wall_friction=True)
    add_effects(model, [{"name": "side_preference"}])
    missing = jupedsim_parameters(model, SCENES).missing
    assert len(missing) == len(plain) + 2
    assert any("opposing_wall_friction" in line for line in missing)
    assert any("side_preference" in line for line in missing)


def test_no_wall_force_without_walls() -> None:
    for model, points in ((crowd(walls=False), 50.0), (crowd(), 0.0)):
        result = jupedsim_parameters(model, Scenes(12.0, points, 0.25, 1.3))
        assert json.loads(result.text)["agent"]["obstacle_scale"] == 0
        assert not any("walls" in line for line in result.missing)


@given(r=st.floats(0.1, 0.5), B=st.floats(0.05, 1.0))
@settings(max_examples=30, deadline=None)
def test_points_per_edge_is_a_sum_over_wall_points(r: float, B: float) -> None:
    spacing = 0.02  # fine enough that the sum does not depend on the first point
    y = spacing * np.arange(-4000, 4001)
    d = np.hypot(r, y)
    row = (np.exp((r - d) / B) * r / d).sum()
    assert points_per_edge(r, B, spacing) == pytest.approx(row, rel=1e-3)


def test_scenes_are_means_over_sequences() -> None:
    walls = np.array([[0.0, 0, 4, 0], [4, 2, 0, 2]])

    def walk(n: int, speed: float, walls: np.ndarray | None) -> Sequence:
        x = np.zeros((3, n, 2))
        x[:, :, 0] = speed * 0.1 * np.arange(3)[:, None]
        return people(x, 0.1, walls=walls)

    scenes = scenes_of([walk(2, 1.0, walls), walk(6, 1.5, None)], 0.25)
    assert (scenes.people, scenes.points) == (4.0, 17.0)
    assert scenes.spacing == pytest.approx(0.25)
    assert scenes.speed == pytest.approx(1.5)


def values(model: System, speed: float = 15.0, length: float | None = 4.2) -> dict[str, str]:
    """Attributes of the exported vehicle type."""
    (kind,) = ElementTree.fromstring(sumo_type(model, "lin", speed, length).text).iter("vType")
    return dict(kind.attrib)


def linear(L: float = 7.0) -> Traffic:
    return Traffic([make_law("lin", v0=30.0, L=L)])


def test_linear_law_as_a_vehicle_type() -> None:
    result = values(linear())
    assert result["id"] == "lin"
    assert (float(result["length"]), float(result["minGap"])) == (4.2, pytest.approx(2.8))
    assert float(result["maxSpeed"]) == 30
    # the gap at 15 m/s is twice the gap at rest
    assert float(result["tau"]) == pytest.approx(7 / 15, rel=1e-5)
    assert "actionStepLength" not in result
    # a gap at rest that is shorter than a car
    result = values(linear(L=3.5), length=None)
    assert (float(result["length"]), float(result["minGap"])) == (3.5, 0)


def test_logarithmic_law_has_no_maximum_speed() -> None:
    model = Traffic([make_law("log", v0=10.0, L=6.0)])
    assert "maxSpeed" not in values(model)
    assert any("v0 = 10" in line for line in sumo_type(model, "log", 15.0, None).missing)
    assert float(values(model)["tau"]) == pytest.approx(6 * (np.exp(1.5) - 1) / 15, rel=1e-5)


def field(name: str) -> System:
    """A published law under a user's name."""
    law = law_from("mine", CAR_FOLLOWING_LAWS.get(name) or PEDESTRIAN_LAWS[name])
    return Traffic([law], leader="measured") if name in CAR_FOLLOWING_LAWS else Crowd([law])


@pytest.mark.parametrize(("law", "follow"), [("idm", "IDM"), ("krauss", "KraussOrig1")])
def test_laws_of_sumo(law: str, follow: str) -> None:
    system = field(law)
    assert has_type(system)
    result = values(system, length=4.5)
    expected = {name.rpartition(".")[2]: float(v) for name, (v, _) in system.physical().items()}
    assert (result["id"], result["carFollowModel"]) == ("lin", follow)
    names = {"v0": "maxSpeed", "T": "tau", "a": "accel", "b": "decel", "s0": "minGap"}
    for name, sumo_name in names.items():
        assert float(result[sumo_name]) == pytest.approx(expected[name], rel=1e-11)
    assert float(result["length"]) == 4.5
    # without lengths the gap at rest includes the vehicle
    result = values(system, length=None)
    assert float(result["length"]) + float(result["minGap"]) == pytest.approx(expected["s0"])


def test_intervals_are_written_as_comments() -> None:
    expected = {"mine.T": {"value": 1.2, "low": 1.125, "high": 1.25}, "mine.a": {"low": None}}
    text = sumo_type(field("idm"), "x", 15.0, 4.5, expected).text
    assert "<!-- T = 1.2 s, 95 % [1.125, 1.25] -->" in text
    assert "<!-- a = 1.3 m/s², no interval -->" in text
    content = json.loads(
        jupedsim_parameters(field("cfsm"), SCENES, {"mine.l": {"low": 0.2, "high": 0.4}}).text
    )
    assert "l = 0.3 m, 95 % [0.2, 0.4]" in content["notes"]


def test_changed_law_is_not_exported_as_idm() -> None:
    rate = CAR_FOLLOWING_LAWS["idm"]["rate"]["v"].replace("(v/v0)**4", "(v/v0)**2")
    system = Traffic(
        [law_from("idm", {**CAR_FOLLOWING_LAWS["idm"], "rate": {"v": rate}})], leader="measured"
    )
    assert not has_type(system)
    with_network = law_from("idm", CAR_FOLLOWING_LAWS["idm"], network=4)
    assert not has_type(Traffic([with_network], leader="measured"))
    with pytest.raises(ConfigError, match=r"neither idm nor krauss.*nnode drive"):
        sumo_type(system, "x", 15.0, None)


def test_pedestrian_laws_of_jupedsim() -> None:
    scenes = Scenes(people=8.0, points=0.0, spacing=0.25, speed=1.1, pace=1.4)
    content = json.loads(jupedsim_parameters(field("cfsm"), scenes).text)
    assert content["classes"]["model"] == "CollisionFreeSpeedModel"
    assert content["model"] == {
        "strength_neighbor_repulsion": 5.0,
        "range_neighbor_repulsion": 0.1,
        "strength_geometry_repulsion": 5.0,
        "range_geometry_repulsion": 0.02,
    }
    assert content["agent"] == {"desired_speed": 1.4, "time_gap": 1.0, "radius": 0.15}
    content = json.loads(jupedsim_parameters(field("gcfm"), scenes).text)
    assert content["classes"]["agent"] == "GeneralizedCentrifugalForceModelAgentParameters"
    assert content["model"]["strength_neighbor_repulsion"] == pytest.approx(0.2)
    assert content["model"]["strength_geometry_repulsion"] == pytest.approx(0.2)
    assert content["agent"]["a_v"] == pytest.approx(0.53)
    assert any("distance of bodies" in line for line in content["no_counterpart"])
    for name in ("ttc", "esf"):
        assert not has_parameters(field(name))
        with pytest.raises(ConfigError, match="neither cfsm nor gcfm"):
            jupedsim_parameters(field(name), scenes)


def test_effects_in_a_vehicle_type() -> None:
    model = linear()
    effects = [
        {"name": "reaction_delay", "T": 0.8},
        {"name": "free_flow_speed", "v_max": 25.0},
        {"name": "time_gap", "h": 0.2},
        {"name": "relative_speed", "kappa": 0.3},
    ]
    add_effects(model, effects)
    result = values(model)
    assert float(result["actionStepLength"]) == pytest.approx(0.8)
    assert float(result["maxSpeed"]) == 25
    assert float(result["tau"]) == pytest.approx((2 * (7 + 0.2 * 15) - 7) / 15, rel=1e-5)
    missing = sumo_type(model, "lin", 15.0, None).missing
    (line,) = [line for line in missing if line.startswith("effect")]
    assert "relative_speed" in line


@pytest.mark.parametrize("speed", [0.0, 30.0, 35.0])
def test_time_gap_is_missing_without_an_equilibrium(speed: float) -> None:
    assert "tau" not in values(linear(), speed)
    missing = sumo_type(linear(), "lin", speed, None).missing
    assert any(line.startswith("tau") for line in missing)


def test_unsuitable_models_are_refused() -> None:
    for model in (Crowd([make_law("relaxation"), make_law("network_force")]), linear()):
        with pytest.raises(ConfigError, match=r"to=jupedsim: .* no social force"):
            jupedsim_parameters(model, SCENES)
    message = r"to=sumo: .* nor a law with a gap at rest.*nnode drive"
    for model in (crowd(), Traffic([make_law("network_speed", hidden=4)])):
        with pytest.raises(ConfigError, match=message):
            sumo_type(model, "x", 15.0, None)


@given(v0=st.floats(5, 50), L=st.floats(2, 15), share=st.floats(0.01, 0.95), log=st.booleans())
@settings(max_examples=50, deadline=None)
def test_law_gives_the_speed_at_its_equilibrium_gap(
    v0: float, L: float, share: float, log: bool
) -> None:
    law = make_law("log", v0=v0, L=L) if log else make_law("lin", v0=v0, L=L)
    speed = share * v0
    gap = torch.tensor(equilibrium_gap(law, speed), dtype=torch.float64)
    assert float(law.speed(gap).detach()) == pytest.approx(speed, rel=1e-9)


@pytest.mark.parametrize("h", [-0.1, 0.3])
def test_equilibrium_gap_with_a_time_gap(h: float) -> None:
    model = linear()
    add_effects(model, [{"name": "time_gap", "h": h}])
    model.leader = "measured"
    law = model.find_law("lin")
    assert law is not None
    gap = equilibrium_gap(law, 12.0, h)
    x = gap * np.arange(3.0) + 12 * 0.1 * np.arange(3)[:, None]
    batch = collate([lane(x, 0.1)])
    rate = model(torch.tensor(0.0), batch.x[0], model.scene(batch)).detach()[0, :, 0]
    np.testing.assert_allclose(rate[:2], 12.0)


def test_traffic_means_are_medians_over_sequences() -> None:
    def cars(speed: float, length: list[float] | None) -> Sequence:
        x = np.array([0.0, 30.0]) + speed * 0.2 * np.arange(4)[:, None]
        return lane(x, length=None if length is None else np.array(length))

    speed, length = traffic_of([cars(10, [4.0, np.nan]), cars(20, [6.0, 9.0])])
    assert speed == pytest.approx(15.0)
    assert length == 6.0
    assert traffic_of([cars(10, None)])[1] is None
