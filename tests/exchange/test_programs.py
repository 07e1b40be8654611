"""Files and forces agree with JuPedSim, PedPy and SUMO themselves."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from benchmarks.programs.sumo import call, network
from nnode.data.options import Faults
from nnode.data.prepare import prepare
from nnode.data.readers.jupedsim import WalkwayOptions, read_walkway, walls_of
from nnode.data.readers.sumo import SumoOptions
from nnode.data.sequence import Sequence, collate
from nnode.exchange.jupedsim import jupedsim_parameters, scenes_of
from nnode.exchange.sumo import equilibrium_gap, sumo_type
from nnode.exchange.trajectories import write_pedpy
from nnode.model import Crowd, Traffic, make_law
from nnode.model.term import State
from tests.builders import people

ROOM = [(0, 0), (12, 0), (12, 4), (0, 4)]
PILLAR = [(5.5, 1.8), (6.5, 1.8), (6.5, 2.2), (5.5, 2.2)]


@pytest.fixture(scope="module")
def recording(jupedsim: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four people walk past a pillar for 5 s in a simulation by JuPedSim."""
    import shapely

    path = tmp_path_factory.mktemp("jupedsim") / "walk.sqlite"
    writer = jupedsim.SqliteTrajectoryWriter(output_file=path, every_nth_frame=4)
    room = shapely.Polygon(ROOM, holes=[PILLAR])
    simulation = jupedsim.Simulation(
        model=jupedsim.SocialForceModel(), geometry=room, dt=0.01, trajectory_writer=writer
    )
    target = simulation.add_exit_stage([(11.5, 0.2), (11.9, 0.2), (11.9, 3.8), (11.5, 3.8)])
    journey = simulation.add_journey(jupedsim.JourneyDescription([target]))
    for i in range(4):
        simulation.add_agent(
            jupedsim.SocialForceModelAgentParameters(
                position=(1, 0.6 + 0.9 * i), journey_id=journey, stage_id=target, radius=0.2
            )
        )
    for _ in range(500):
        simulation.iterate()
    writer.close()
    return path


def test_jupedsim_trajectories_are_read(recording: Path, tmp_path: Path) -> None:
    options = WalkwayOptions(path=str(recording), faults=Faults.error)
    store = prepare(options, tmp_path / "out")
    assert (len(store), store.manifest["dt"], store[0].n_agents) == (5, 0.04, 4)
    start = store[0].x[0]
    np.testing.assert_allclose(
        start[np.argsort(start[:, 1])], [[1, 0.6 + 0.9 * i] for i in range(4)]
    )
    walls = store[0].walls
    assert walls is not None
    assert {tuple(w[:2]) for w in walls} == {(float(x), float(y)) for x, y in ROOM + PILLAR}
    centre = np.array([6.0, 1.0])  # left of the nearest edges of room and pillar
    for x1, y1, x2, y2 in walls:
        if y1 == y2 and y1 in (0, 1.8):
            assert (x2 - x1) * (centre[1] - y1) > 0


def test_pedpy_reads_the_same_trajectories(recording: Path) -> None:
    pedpy = pytest.importorskip("pedpy")
    area = pedpy.load_walkable_area_from_jupedsim_sqlite(trajectory_file=recording)
    trajectory = pedpy.load_trajectory_from_jupedsim_sqlite(trajectory_file=recording)
    s = read_walkway(recording, WalkwayOptions(path=str(recording), t_seq=5.0))[0]
    assert walls_of(area.polygon.wkt, "").shape == s.walls.shape
    assert trajectory.frame_rate == pytest.approx(1 / s.dt)
    for n, agent in enumerate(s.agents):
        rows = trajectory.data[trajectory.data["id"] == int(agent)].sort_values("frame")
        np.testing.assert_allclose(s.x[:, n], rows[["x", "y"]].to_numpy()[: s.n_samples])


def test_pedpy_reads_exported_text(tmp_path: Path) -> None:
    pedpy = pytest.importorskip("pedpy")
    time = 0.04 * np.arange(10, 36)
    x = np.stack([np.stack([1.3 * time, 0 * time + n], -1) for n in range(3)], 1)
    s = Sequence(name="a/000", recording="a", time=time, x=x, agents=("4", "9", "11"))
    (path,) = write_pedpy(tmp_path, [s])
    trajectory = pedpy.load_trajectory(trajectory_file=path)
    assert trajectory.frame_rate == 25
    assert sorted(set(trajectory.data["id"])) == [4, 9, 11]
    assert trajectory.data["frame"].min() == 10
    speed = pedpy.compute_individual_speed(traj_data=trajectory, frame_step=1)
    np.testing.assert_allclose(speed["speed"], 1.3, atol=1e-4)


def accelerations(jupedsim: ModuleType, content: dict, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """JuPedSim's interaction accelerations: of people with a desired speed of zero."""
    import shapely

    dt = 1e-4
    simulation = jupedsim.Simulation(
        model=jupedsim.SocialForceModel(**content["model"]),
        geometry=shapely.Polygon(ROOM),
        dt=dt,
    )
    target = simulation.add_waypoint_stage((11, 3.5), 0.1)
    journey = simulation.add_journey(jupedsim.JourneyDescription([target]))
    agent = {**content["agent"], "desired_speed": 1e-12}
    ids = [
        simulation.add_agent(
            jupedsim.SocialForceModelAgentParameters(
                position=tuple(position),
                velocity=tuple(velocity),
                journey_id=journey,
                stage_id=target,
                **agent,
            )
        )
        for position, velocity in zip(x, v, strict=True)
    ]
    simulation.iterate()
    result = np.array([simulation.agent(i).model.velocity for i in ids])
    return (result - v) / dt + v / agent["reaction_time"]


def two_samples(x: np.ndarray, displacement: np.ndarray, **more: Any) -> Sequence:
    return people(np.stack([x, x + displacement]), 1.0, **more)


def forces(model: Crowd, x: np.ndarray, v: np.ndarray, walls: np.ndarray | None) -> np.ndarray:
    """Interaction accelerations of the model."""
    batch = collate([two_samples(x, v, walls=walls, v=np.stack([v, v]))])
    state = State(torch.tensor(0.0), batch.x[0], batch.v[0], model.scene(batch))
    force = model.find_law("social_force")
    assert force is not None
    return force(state)[0].detach().numpy()


def test_social_force_between_people_agrees_with_jupedsim(jupedsim: ModuleType) -> None:
    force = make_law("social_force", A=20.0, k=30.0, kappa=40.0, B=0.3, mass=1.5)
    model = Crowd([make_law("relaxation", tau=0.5), force])
    # two people touch; all are far from walls
    x = np.array([[5.0, 2.0], [5.4, 2.1], [5.5, 1.4], [4.6, 2.5]])
    v = np.array([[1.0, 0.2], [-0.8, 0.1], [0.3, 0.9], [0.0, -1.0]])
    content = json.loads(jupedsim_parameters(model, scenes_of([two_samples(x, v)], 0.25)).text)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        simulated = accelerations(jupedsim, content, x, v)
    np.testing.assert_allclose(simulated, forces(model, x, v, None), rtol=1e-3, atol=1e-3)


def test_social_force_of_a_wall_agrees_with_jupedsim(jupedsim: ModuleType) -> None:
    force = make_law("social_force", A=20.0, k=0.0, kappa=0.0, B=0.2)
    model = Crowd([make_law("relaxation", tau=0.5), force], wall_spacing=0.02)
    walls = np.hstack([ROOM, np.roll(ROOM, -1, axis=0)]).astype(float)
    x, v = np.array([[6.0, 0.25]]), np.zeros((1, 2))
    scenes = scenes_of([two_samples(x, v, walls=walls)], 0.02)
    content = json.loads(jupedsim_parameters(model, scenes).text)
    simulated, expected = accelerations(jupedsim, content, x, v), forces(model, x, v, walls)
    assert simulated[0, 0] == pytest.approx(expected[0, 0], abs=1e-6)
    assert simulated[0, 1] == pytest.approx(expected[0, 1], rel=0.01)


@pytest.fixture(scope="module")
def road(sumo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SUMO network of a straight road of 3 km."""
    folder = tmp_path_factory.mktemp("sumo")
    nodes = '<node id="a" x="0" y="0"/><node id="b" x="3000" y="0"/>'
    edge = '<edge id="e" from="a" to="b" numLanes="1" speed="50"/>'
    return network(sumo, folder, nodes, edge)


def platoon(sumo: Path, road: Path, folder: Path, types: Path, seconds: int) -> Path:
    """SUMO's trajectories of four vehicles of type ``own`` behind one of type ``lead``."""
    cars = "".join(
        f'<vehicle id="c{i}" type="{"own" if i else "lead"}" route="r" depart="0" '
        f'departPos="{300 - 40 * i}" departSpeed="10"/>'
        for i in range(5)
    )
    (folder / "a.rou.xml").write_text(f'<routes><route id="r" edges="e"/>{cars}</routes>')
    call(
        sumo / "bin" / "sumo",
        *("-n", road, "-a", types, "-r", folder / "a.rou.xml"),
        *("--step-length", 0.2, "--end", seconds),
        *("--fcd-output", folder / "fcd.xml.gz"),
        *("--fcd-output.attributes", "id,type,speed,pos,lane"),
    )
    return folder / "fcd.xml.gz"


@pytest.fixture
def types(tmp_path: Path) -> Path:
    (tmp_path / "types.add.xml").write_text(
        '<additional><vType id="lead" maxSpeed="12" speedDev="0" sigma="0"/>'
        '<vType id="own" length="4.5" speedDev="0"/></additional>'
    )
    return tmp_path / "types.add.xml"


def test_sumo_trajectories_are_read(sumo: Path, road: Path, types: Path, tmp_path: Path) -> None:
    path = platoon(sumo, road, tmp_path, types, 31)
    store = prepare(SumoOptions(path=str(path), window=10.0, faults=Faults.error), tmp_path / "out")
    assert len(store) == 3
    assert store[0].agents == ("c4", "c3", "c2", "c1", "c0")
    assert store[0].kind == ("own",) * 4 + ("lead",)
    assert store[2].v is not None
    np.testing.assert_allclose(store[2].v[-1], 12.0, atol=1.0)
    np.testing.assert_allclose(np.diff(store[2].x[:, -1, 0]), 2.4, atol=0.011)


def test_exported_type_keeps_the_equilibrium_gap(sumo: Path, road: Path, tmp_path: Path) -> None:
    model, speed = Traffic([make_law("lin", v0=25.0, L=6.5)]), 12.0
    law = model.find_law("lin")
    assert law is not None
    root = ElementTree.fromstring(sumo_type(model, "own", speed, 4.0).text)
    ElementTree.SubElement(root, "vType", id="lead", length="4", maxSpeed="12", speedDev="0")
    types = tmp_path / "types.add.xml"
    ElementTree.ElementTree(root).write(types)
    path = platoon(sumo, road, tmp_path, types, 121)
    (s,) = prepare(SumoOptions(path=str(path), window=120.0), tmp_path / "out")
    gap = np.diff(s.x[-1, :, 0])
    np.testing.assert_allclose(gap, equilibrium_gap(law, speed), atol=0.1)
