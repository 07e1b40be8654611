"""There and back: another program simulates, the toolkit calibrates, and the program simulates what
was exported; the same paths, to the tolerance that each test derives."""

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
from tests.exchange.test_recovery import recovered

#: A short step of JuPedSim, s.
DT = 1e-4


def of_the_field(law: Any, name: str) -> Any:
    """A law with the parameters that a search has found, in float64."""
    with torch.no_grad():
        for parameter, value in recovered(name).parameters["found"].items():
            getattr(law, str(parameter)).fill_(value)
    return law.double()


def vehicles(path: Path) -> Sequence:
    (found,) = read_sumo(path, SumoOptions(path=str(path), dt=by_sumo.STEP))
    return found


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
def test_sumo_s_vehicles(
    sumo: Path, tmp_path: Path, law: str, case: str, values: dict[str, float], profile: np.ndarray
) -> None:
    names = {"v0": "maxSpeed", "T": "tau", "s0": "minGap", "a": "accel", "b": "decel"}
    typed = {names[p]: value for p, value in values.items()}
    typed |= {} if law == "idm" else {"sigma": 0.0}
    first = vehicles(by_sumo.platoon(sumo, tmp_path / "a", SAME[law], typed, profile=profile))
    system = Traffic(
        [of_the_field(law_from(law, CAR_FOLLOWING_LAWS[law]), case)], leader="measured"
    )
    text = sumo_type(system, "own", 15.0, by_sumo.LENGTH).text
    (kind,) = ElementTree.fromstring(text).iter("vType")
    written = dict(kind.attrib)
    follow, length = written.pop("carFollowModel"), float(written.pop("length"))
    assert (follow, length) == (SAME[law], by_sumo.LENGTH)
    repeated = {k: float(v) for k, v in written.items() if k in {*names.values(), "sigma"}}
    second = vehicles(by_sumo.platoon(sumo, tmp_path / "b", follow, repeated, profile=profile))
    # parameters are found to 1e-9 and written with twelve digits: a micrometre in 60 s
    assert np.abs(first.x - second.x).max() < 1e-6


def people(
    jupedsim: ModuleType, folder: Path, content: dict[str, Any], **scene: Any
) -> list[Sequence]:
    """What JuPedSim makes of an exported file, with everybody's preferred velocity."""
    model, agent = (getattr(jupedsim, content["classes"][part]) for part in ("model", "agent"))
    found = []
    folder.mkdir()
    for seed in range(2):
        walked = by_jupedsim.groups(
            jupedsim,
            folder / f"{seed}.sqlite",
            model(**content["model"]),
            agent,
            content["agent"],
            seed=seed,
            **scene,
        )
        assert walked.destination is not None
        way = np.sign(walked.destination[:, :1]) * np.array([[1.3, 0.0]])
        found.append(replace(walked, preferred=way))
    return found


def content(model: str, arguments: dict[str, float], **agent: float) -> dict[str, Any]:
    return {
        "classes": {"model": model, "agent": f"{model}AgentParameters"},
        "model": arguments,
        "agent": {"desired_speed": 1.3, **agent},
    }


def exported(system: System, walked: list[Sequence]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(jupedsim_parameters(system, scenes_of(walked, 0.25)).text)
    return found


@pytest.mark.slow
def test_jupedsim_s_collision_free_people(jupedsim: ModuleType, tmp_path: Path) -> None:
    arguments = {"strength_neighbor_repulsion": 8.0, "range_neighbor_repulsion": 0.1}
    typed = content("CollisionFreeSpeedModel", arguments, time_gap=1.0, radius=0.2)
    first = people(jupedsim, tmp_path / "a", typed)
    system = Crowd([of_the_field(law_from("cfsm", PEDESTRIAN_LAWS["cfsm"]), "collision_free")])
    second = people(jupedsim, tmp_path / "b", exported(system, first))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a.x, b.x, atol=1e-6)


@pytest.mark.slow
def test_jupedsim_s_social_force(jupedsim: ModuleType, tmp_path: Path) -> None:
    # JuPedSim places people with the new velocity, Euler's steps here with the old one: what is
    # found is off in proportion to the step, 8 mm in 8 s at 1 ms
    dt = 0.001
    typed = content(
        "SocialForceModel",
        {"body_force": 0.0, "friction": 0.0},
        mass=80.0,
        reaction_time=0.5,
        agent_scale=160.0,
        force_distance=0.3,
        radius=0.3,
    )
    first = people(jupedsim, tmp_path / "a", typed, dt=dt)
    force = make_law(
        "social_force", A=24.0, k=0.0, kappa=0.0, r=0.3, B=0.3
    )  # 8 people: 16 is what was typed in
    system = Crowd(
        [make_law("relaxation", tau=0.5, preferred=True), force], desired="exit"
    ).double()
    for name in ("k", "kappa"):
        getattr(force, name).requires_grad_(False)
    parts = [part for whole in first for part in by_jupedsim.pieces(whole, seconds=1.0)]
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
    """JuPedSim's agents in a rectangular room after a step of DT."""
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
    """``(N, ...)`` rates of the people's states at the start."""
    batch = collate([s])
    rate = system(torch.tensor(0.0), system.initial(batch), system.scene(batch)).detach()[0]
    return np.asarray(rate)


def test_jupedsim_s_centrifugal_people_who_walk_at_each_other(jupedsim: ModuleType) -> None:
    """Head-on the distance of bodies is the same in both, and so are accelerations: where bodies
    are farther apart than JuPedSim's interpolation begins, and centres nearer than the law fades.
    """
    system = Crowd([law_from("gcfm", PEDESTRIAN_LAWS["gcfm"])])
    speed, x = 0.2, np.array([[0.0, 0.0], [1.4, 0.0]])
    v, way = (np.array([[value, 0.0], [-value, 0.0]]) for value in (speed, 1.3))
    s = Sequence(
        name="a",
        recording="a",
        time=np.arange(2.0),
        x=np.stack([x, x + v]),
        v=np.stack([v, v]),
        destination=x + 100 * way,
        preferred=way,
    )
    persons = [
        {
            "position": tuple(place),
            "speed": speed,
            "orientation": tuple(np.sign(aim)),
            "desired_direction": tuple(np.sign(aim)),
        }
        for place, aim in zip(x, way, strict=True)
    ]
    room = (-500, -500, 500, 500)
    agents = after_a_step(jupedsim, exported(system, [s]), room, persons, x + 200 * way)
    theirs = np.array([agent.model.speed - speed for agent in agents]) / DT
    ours = first_rate(system, s)[:, 2] * np.sign(way[:, 0])
    assert (ours < 1.3 / 0.5 - speed / 0.5 - 0.05).all()  # each pushes the other
    np.testing.assert_allclose(theirs, ours, rtol=1e-3)


def in_a_room(
    jupedsim: ModuleType, name: str, place: list[float], speed: float
) -> tuple[np.ndarray, np.ndarray]:
    """(2,) velocities after a short step to the right, of one person in a room: JuPedSim's, and
    those of the law that was exported to it."""
    goal = np.array([[4.99, place[1]]])
    room = np.array([[-5.0, -2, 5, -2], [5, -2, 5, 2], [5, 2, -5, 2], [-5, 2, -5, -2]])
    x, v = np.array([place]), np.array([[speed, 0.0]])
    s = Sequence(
        name="a",
        recording="a",
        time=np.arange(2.0),
        x=np.stack([x, x + v]),
        v=np.stack([v, v]),
        destination=goal,
        preferred=np.array([[1.3, 0.0]]),
        walls=room,
    )
    system = Crowd([law_from(name, PEDESTRIAN_LAWS[name])], desired="exit")
    moving = {"speed": speed, "orientation": (1.0, 0.0), "desired_direction": (1.0, 0.0)}
    person = {"position": tuple(place), **(moving if name == "gcfm" else {})}
    (agent,) = after_a_step(jupedsim, exported(system, [s]), (-5, -2, 5, 2), [person], goal)
    theirs = (np.array(agent.position) - x[0]) / DT
    rate = first_rate(system, s)[0, -2:]
    return theirs, rate if system.order == 1 else v[0] + DT * rate


@pytest.mark.parametrize("place", [[0.0, -1.82], [1.0, 1.84], [-4.83, -1.81], [0.0, 0.0]])
def test_jupedsim_s_collision_free_people_near_walls(
    jupedsim: ModuleType, place: list[float]
) -> None:
    theirs, ours = in_a_room(jupedsim, "cfsm", place, 0.0)
    np.testing.assert_allclose(theirs, ours, atol=1e-6)
    assert (abs(theirs[1]) > 0.1) == (place != [0.0, 0.0])


@pytest.mark.parametrize(("apart", "speed"), [(1.4, 0.5), (1.2, 0.4), (1.1, 0.2), (3.0, 0.8)])
def test_jupedsim_s_centrifugal_people_who_walk_at_a_wall(
    jupedsim: ModuleType, apart: float, speed: float
) -> None:
    """Where bodies are so far from it that JuPedSim neither interpolates nor pushes with its
    greatest force (within 0.4 m and a radius), and centres nearer than the law fades."""
    theirs, ours = in_a_room(jupedsim, "gcfm", [5.0 - apart, 0.3], speed)
    free = speed + DT * (1.3 - speed) / 0.5
    assert (ours[0] < free - 1e-6) == (apart < 2)
    np.testing.assert_allclose(theirs[0] - speed, ours[0] - speed, rtol=1e-3)
