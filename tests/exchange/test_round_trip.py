"""Round trips: a program simulates, parameters are calibrated and exported, and the program then
simulates the same paths; each test derives its tolerance."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from benchmarks.programs import jupedsim as by_jupedsim
from benchmarks.programs import sumo as by_sumo
from benchmarks.programs.sumo import SLOWLY
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.sequence import Sequence, collate
from nnode.exchange.jupedsim import jupedsim_parameters, scenes_of
from nnode.exchange.sumo import SAME, sumo_type
from nnode.model import Crowd, System, Traffic, make_law
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS, law_from
from nnode.simulation import FusedSolver
from tests.builders import straight
from tests.exchange.test_recovery import recovered

#: A short step of JuPedSim (s).
DT = 1e-4


def with_estimates(law: Any, name: str) -> Any:
    """A law in float64 with the parameters that were recovered in a case."""
    with torch.no_grad():
        for parameter, value in recovered(name).parameters["found"].items():
            getattr(law, str(parameter)).fill_(value)
    return law.double()


def vehicles(path: Path) -> Sequence:
    (sequence,) = read_sumo(path, SumoOptions(path=str(path), dt=by_sumo.STEP))
    return sequence


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "case", "values", "profile"),
    [
        (
            "idm",
            "idm_euler",
            {"v0": 28.0, "T": 1.1, "s0": 2.3, "a": 1.4, "b": 2.0},
            by_sumo.PROFILE,
        ),
        ("krauss", "krauss_moving", {"v0": 21.0, "T": 1.1, "s0": 2.3, "a": 1.9, "b": 3.5}, SLOWLY),
    ],
)
def test_sumo_car_following(
    sumo: Path, tmp_path: Path, law: str, case: str, values: dict[str, float], profile: np.ndarray
) -> None:
    names = {"v0": "maxSpeed", "T": "tau", "s0": "minGap", "a": "accel", "b": "decel"}
    true = {names[p]: value for p, value in values.items()}
    true |= {} if law == "idm" else {"sigma": 0.0}
    first = vehicles(by_sumo.platoon(sumo, tmp_path / "a", SAME[law], true, profile=profile))
    system = Traffic(
        [with_estimates(law_from(law, CAR_FOLLOWING_LAWS[law]), case)], leader="measured"
    )
    text = sumo_type(system, "own", 15.0, by_sumo.LENGTH).text
    (kind,) = ElementTree.fromstring(text).iter("vType")
    written = dict(kind.attrib)
    follow, length = written.pop("carFollowModel"), float(written.pop("length"))
    assert (follow, length) == (SAME[law], by_sumo.LENGTH)
    exported = {k: float(v) for k, v in written.items() if k in {*names.values(), "sigma"}}
    second = vehicles(by_sumo.platoon(sumo, tmp_path / "b", follow, exported, profile=profile))
    # estimates are exact to 1e-9 and written with twelve digits: 1 µm in 60 s
    assert np.abs(first.x - second.x).max() < 1e-6


def people(
    jupedsim: ModuleType, folder: Path, content: dict[str, Any], **scene: Any
) -> list[Sequence]:
    """JuPedSim's simulations of an exported file, with preferred velocities."""
    model, agent = (getattr(jupedsim, content["classes"][part]) for part in ("model", "agent"))
    sequences = []
    folder.mkdir()
    for seed in range(2):
        sequence = by_jupedsim.groups(
            jupedsim,
            folder / f"{seed}.sqlite",
            model(**content["model"]),
            agent,
            content["agent"],
            seed=seed,
            **scene,
        )
        assert sequence.destination is not None
        preferred = np.sign(sequence.destination[:, :1]) * np.array([[1.3, 0.0]])
        sequences.append(replace(sequence, preferred=preferred))
    return sequences


def content(model: str, arguments: dict[str, float], **agent: float) -> dict[str, Any]:
    """Parameters in the form of an exported file."""
    return {
        "classes": {"model": model, "agent": f"{model}AgentParameters"},
        "model": arguments,
        "agent": {"desired_speed": 1.3, **agent},
    }


def exported(system: System, sequences: list[Sequence]) -> dict[str, Any]:
    return dict(json.loads(jupedsim_parameters(system, scenes_of(sequences, 0.25)).text))


@pytest.mark.slow
def test_jupedsim_collision_free_speed(jupedsim: ModuleType, tmp_path: Path) -> None:
    arguments = {"strength_neighbor_repulsion": 8.0, "range_neighbor_repulsion": 0.1}
    true = content("CollisionFreeSpeedModel", arguments, time_gap=1.0, radius=0.2)
    first = people(jupedsim, tmp_path / "a", true)
    system = Crowd([with_estimates(law_from("cfsm", PEDESTRIAN_LAWS["cfsm"]), "collision_free")])
    second = people(jupedsim, tmp_path / "b", exported(system, first))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a.x, b.x, atol=1e-6)


@pytest.mark.slow
def test_jupedsim_social_force(jupedsim: ModuleType, tmp_path: Path) -> None:
    # JuPedSim steps with the new velocity, Euler's method here with the old one. The error is
    # proportional to the step: 8 mm in 8 s at 1 ms.
    dt = 0.001
    true = content(
        "SocialForceModel",
        {"body_force": 0.0, "friction": 0.0},
        mass=80.0,
        reaction_time=0.5,
        agent_scale=160.0,
        force_distance=0.3,
        radius=0.3,
    )
    first = people(jupedsim, tmp_path / "a", true, dt=dt)
    # the true value of A for 8 people is 16
    force = make_law("social_force", A=24.0, k=0.0, kappa=0.0, r=0.3, B=0.3)
    system = Crowd(
        [make_law("relaxation", tau=0.5, preferred=True), force], desired="exit"
    ).double()
    for name in ("k", "kappa"):
        getattr(force, name).requires_grad_(False)
    parts = [part for sequence in first for part in by_jupedsim.pieces(sequence, seconds=1.0)]
    end = pooled(ResidualProblem(system, collate(parts), FusedSolver(dt=dt)), steps=30)
    assert end.row == pytest.approx(16.0, rel=2e-3)
    with torch.no_grad():
        force.A.fill_(end.row[0])
    second = people(jupedsim, tmp_path / "b", exported(system, first), dt=dt)
    for a, b in zip(first, second, strict=True):
        assert np.abs(a.x - b.x).max() < 0.01


def after_a_step(
    jupedsim: ModuleType,
    written: dict[str, Any],
    room: tuple[float, float, float, float],
    persons: list[dict[str, Any]],
    targets: np.ndarray,
) -> list[Any]:
    """JuPedSim's agents in a rectangular room after one step of `DT`."""
    import shapely

    model, person = (getattr(jupedsim, written["classes"][part]) for part in ("model", "agent"))
    simulation = jupedsim.Simulation(
        model=model(**written["model"]), geometry=shapely.box(*room), dt=DT
    )
    stage = simulation.add_direct_steering_stage()
    journey = simulation.add_journey(jupedsim.JourneyDescription([stage]))
    ids = []
    for values, target in zip(persons, targets, strict=True):
        agent = person(journey_id=journey, stage_id=stage, **written["agent"], **values)
        ids.append(simulation.add_agent(agent))
        simulation.agent(ids[-1]).target = tuple(target)
    simulation.iterate()
    return [simulation.agent(i) for i in ids]


def first_rate(system: System, s: Sequence) -> np.ndarray:
    """``(N, ...)`` initial rates of people's states."""
    batch = collate([s])
    rate = system(torch.tensor(0.0), system.initial(batch), system.scene(batch)).detach()[0]
    return np.asarray(rate)


def test_jupedsim_centrifugal_force_between_people(jupedsim: ModuleType) -> None:
    """Accelerations agree head-on, where both programs have the same distance of bodies.

    Bodies are outside JuPedSim's interpolation range and within the range of the law.
    """
    system = Crowd([law_from("gcfm", PEDESTRIAN_LAWS["gcfm"])])
    speed, x = 0.2, np.array([[0.0, 0.0], [1.4, 0.0]])
    v, preferred = (np.array([[value, 0.0], [-value, 0.0]]) for value in (speed, 1.3))
    s = straight(x, v, 2, 1.0, destination=x + 100 * preferred, preferred=preferred)
    persons = [
        {
            "position": tuple(position),
            "speed": speed,
            "orientation": tuple(np.sign(direction)),
            "desired_direction": tuple(np.sign(direction)),
        }
        for position, direction in zip(x, preferred, strict=True)
    ]
    room = (-500, -500, 500, 500)
    agents = after_a_step(jupedsim, exported(system, [s]), room, persons, x + 200 * preferred)
    simulated = np.array([agent.model.speed - speed for agent in agents]) / DT
    expected = first_rate(system, s)[:, 2] * np.sign(preferred[:, 0])
    assert (expected < 1.3 / 0.5 - speed / 0.5 - 0.05).all()  # the force slows both people
    np.testing.assert_allclose(simulated, expected, rtol=1e-3)


def in_a_room(
    jupedsim: ModuleType, name: str, position: list[float], speed: float
) -> tuple[np.ndarray, np.ndarray]:
    """``(2,)`` velocities of one person in a room after a short step to the right.

    The first is JuPedSim's, the second that of the exported law.
    """
    destination = np.array([[4.99, position[1]]])
    room = np.array([[-5.0, -2, 5, -2], [5, -2, 5, 2], [5, 2, -5, 2], [-5, 2, -5, -2]])
    x, v = np.array([position]), np.array([[speed, 0.0]])
    preferred = np.array([[1.3, 0.0]])
    s = straight(x, v, 2, 1.0, destination=destination, preferred=preferred, walls=room)
    system = Crowd([law_from(name, PEDESTRIAN_LAWS[name])], desired="exit")
    moving = {"speed": speed, "orientation": (1.0, 0.0), "desired_direction": (1.0, 0.0)}
    person = {"position": tuple(position), **(moving if name == "gcfm" else {})}
    (agent,) = after_a_step(jupedsim, exported(system, [s]), (-5, -2, 5, 2), [person], destination)
    simulated = (np.array(agent.position) - x[0]) / DT
    rate = first_rate(system, s)[0, -2:]
    return simulated, rate if system.order == 1 else v[0] + DT * rate


@pytest.mark.parametrize("position", [[0.0, -1.82], [1.0, 1.84], [-4.83, -1.81], [0.0, 0.0]])
def test_jupedsim_collision_free_speed_near_walls(
    jupedsim: ModuleType, position: list[float]
) -> None:
    simulated, expected = in_a_room(jupedsim, "cfsm", position, 0.0)
    np.testing.assert_allclose(simulated, expected, atol=1e-6)
    assert (abs(simulated[1]) > 0.1) == (position != [0.0, 0.0])


@pytest.mark.parametrize(("distance", "speed"), [(1.4, 0.5), (1.2, 0.4), (1.1, 0.2), (3.0, 0.8)])
def test_jupedsim_centrifugal_force_of_a_wall(
    jupedsim: ModuleType, distance: float, speed: float
) -> None:
    """The distances are above 0.4 m and a radius, where JuPedSim does not bound the force."""
    simulated, expected = in_a_room(jupedsim, "gcfm", [5.0 - distance, 0.3], speed)
    free = speed + DT * (1.3 - speed) / 0.5
    assert (expected[0] < free - 1e-6) == (distance < 2)
    np.testing.assert_allclose(simulated[0] - speed, expected[0] - speed, rtol=1e-3)
