"""Platoons whose followers SUMO drives, in scenes from a seed, and the right answer for each.

Every platoon has a road of its own. Its leader is given its speed at every step; SUMO does the
rest. The right answers were written down before anything was run: see
:class:`~benchmarks.discovery.worlds.Answer`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from benchmarks.discovery.worlds import NOTHING, Answer
from benchmarks.programs.sumo import STEP, network, run, sumo_home
from benchmarks.synthetic_cases.laws import accelerations

#: Roads, vehicles on each with the leader, seconds before and of the recording.
ROADS, CARS, WARM, SECONDS = 40, 5, 20.0, 30.0
#: Samples are so many steps apart. Errors of measured places, m.
EVERY, ERROR = 2, (0.02, 0.2)
#: Length of a road, of its stretch in the middle (m), and of vehicles.
ROAD, STRETCH, LENGTH, TRUCK = 2400.0, (900.0, 1100.0), 5.0, 12.0
#: A limit that binds nobody, m/s, and those that bind; leaders drive at 4 to 18 m/s.
FREE, LIMIT = 45.0, (8.0, 11.0)

Draw = Callable[[np.random.Generator], dict[str, float]]


def _idm(rng: np.random.Generator) -> dict[str, float]:
    return {
        "accel": rng.uniform(0.8, 2),
        "decel": rng.uniform(1.2, 2.5),
        "tau": rng.uniform(0.9, 1.6),
        "minGap": rng.uniform(1.5, 2.5),
        "maxSpeed": rng.uniform(24, 34),
    }


def _krauss(rng: np.random.Generator) -> dict[str, float]:
    return {**_idm(rng), "decel": rng.uniform(2, 4.5), "sigma": 0.0}


@dataclass(frozen=True)
class Scene:
    """What SUMO simulates.

    Attributes:
        follow: its name of the car-following model.
        draw: attributes of the vehicles' type.
        answer: what is right to say.
        stretch: in the stretch there is a limit.
        period: the limit falls for some seconds, everywhere.
        more: attributes that are drawn besides: of all, or of each vehicle.
        trucks: share of vehicles that are longer and keep a longer time gap.
        limit: the speed that is allowed on all roads, of which drivers take a factor, m/s.
        deviation: standard deviation of that factor.
        red: a light at the stretch's beginning turns red for some seconds; leaders drive on.
        drop: a second lane ends with the stretch, and a car that nobody recorded comes over
            between the second and the third vehicle.
    """

    follow: str
    draw: Draw
    answer: Answer = NOTHING
    stretch: bool = False
    period: bool = False
    more: dict[str, tuple[float, float]] = field(default_factory=dict)
    each: dict[str, tuple[float, float]] = field(default_factory=dict)
    trucks: float = 0.0
    limit: tuple[float, float] = (FREE, FREE)
    deviation: float = 0.0
    red: bool = False
    drop: bool = False


_LATE = ("reaction_delay", "inertia")
_SOON = Answer(right=_LATE, unknown=True)
_ELSEWHERE = Answer(allowed=("speed_zone", "speed_period"), unknown=True)
_UNSEEN = Answer(allowed=("speed_zone",), unknown=True)
IDM, KRAUSS = partial(Scene, "IDM", _idm), partial(Scene, "Krauss", _krauss)


def _says(law: str, *right: str) -> Answer:
    return Answer(first=(law,), right=right)


SCENES: dict[str, Scene] = {
    "idm": IDM(_says("idm")),
    "krauss": KRAUSS(_says("krauss")),
    "eidm": Scene("EIDM", _idm, Answer(unknown=True)),
    "idm_stretch": IDM(_says("idm", "speed_zone"), stretch=True),
    "krauss_stretch": KRAUSS(_says("krauss", "speed_zone"), stretch=True),
    "idm_period": IDM(_says("idm", "speed_period"), period=True),
    "krauss_period": KRAUSS(_says("krauss", "speed_period"), period=True),
    "idm_late": IDM(_SOON, more={"actionStepLength": (0.8, 1.5)}),
    "krauss_late": KRAUSS(_SOON, more={"actionStepLength": (0.8, 1.5)}),
    "idm_trucks": IDM(_says("idm", "vehicle_class"), trucks=0.4),
    # drivers who differ are part of the model, and no effect
    "idm_drivers": IDM(_says("idm"), each={"tau": (0.7, 2.2)}),
    "krauss_dawdling": KRAUSS(more={"sigma": (0.3, 0.7)}),
    "krauss_factors": KRAUSS(limit=(17.0, 20.0), deviation=0.15),
    # a stop at one place and time, and cars that nobody measured, are in no catalogue
    "idm_light": IDM(_ELSEWHERE, red=True),
    "krauss_light": KRAUSS(_ELSEWHERE, red=True),
    "idm_lane_drop": IDM(_UNSEEN, drop=True),
    "krauss_lane_drop": KRAUSS(_UNSEEN, drop=True),
}


def recorded(name: str, seed: int) -> tuple[pd.DataFrame, None]:
    """The table of a scene: sequence, time, agent, x, length, kind; there are no walls.

    Raises:
        ImportError: SUMO is not installed.
    """
    scene = SCENES[name]
    rng = np.random.default_rng(list(hashlib.sha256(f"{name} {seed}".encode()).digest()))
    values = {**scene.draw(rng), **{k: rng.uniform(*v) for k, v in scene.more.items()}}
    with TemporaryDirectory() as folder:
        path = _simulated(sumo_home(), Path(folder), scene, values, rng)
        table = _read(path)
    table["x"] += rng.uniform(*ERROR) * rng.standard_normal(len(table))
    return table, None


def _simulated(
    home: Path, folder: Path, scene: Scene, values: dict[str, float], rng: np.random.Generator
) -> Path:
    """Write the roads and the traffic, and run SUMO; returns its output."""
    _write(home, folder, scene, values, rng)
    number = int(rng.integers(1 << 30))
    steps = round((WARM + SECONDS) / STEP)
    speeds = np.stack([_speeds(rng, steps) for _ in range(ROADS)])
    begin = WARM + rng.uniform(0.2, 0.5) * SECONDS
    slow = rng.uniform(*LIMIT)

    def control(traci: ModuleType, step: int) -> None:
        for k in range(ROADS):
            if not step:
                traci.vehicle.setSpeedMode(f"{k}-0", 0)
            traci.vehicle.setSpeed(f"{k}-0", float(speeds[k, step]))
        for name in traci.vehicle.getIDList() if scene.drop and not step else []:
            if not name.startswith("unseen"):
                traci.vehicle.setLaneChangeMode(name, 0)
        if scene.period and step in (round(begin / STEP), round((begin + 8) / STEP)):
            limit = slow if step == round(begin / STEP) else FREE
            for name in traci.edge.getIDList():
                traci.edge.setMaxSpeed(name, limit)
        for name in traci.trafficlight.getIDList() if scene.red else []:
            red = begin <= step * STEP < begin + 8
            traci.trafficlight.setRedYellowGreenState(name, "r" if red else "G")

    options = ["--precision", 6, "--seed", number, "--collision.action", "none"]
    return run(home, folder, "fcd.xml", "id,type,x,y", steps, control, *options)


def _write(
    home: Path, folder: Path, scene: Scene, values: dict[str, float], rng: np.random.Generator
) -> None:
    """Write the roads and the traffic."""
    ends = {"a": 0.0, "b": STRETCH[0], "c": STRETCH[1], "d": ROAD}
    allowed = rng.uniform(*scene.limit)
    limit = rng.uniform(*LIMIT) if scene.stretch else allowed
    nodes, edges, cars, goes_on = [], [], [], []
    for k in range(ROADS):
        for n, x in ends.items():
            light = ' type="traffic_light"' if scene.red and n == "b" else ""
            nodes.append(f'<node id="{n}{k}" x="{x:g}" y="{50 * k}" radius="0"{light}/>')
        for one, two in ("ab", "bc", "cd"):
            speed = limit if one == "b" else allowed
            lanes = 2 if scene.drop and one != "c" else 1
            edges.append(
                f'<edge id="{one}{k}" from="{one}{k}" to="{two}{k}" numLanes="{lanes}" '
                f'speed="{speed}"/>'
            )
            for lane in range(lanes if one == "a" else 1 if one == "b" else 0):
                goes_on.append(
                    f'<connection from="{one}{k}" to="{two}{k}" fromLane="{lane}" toLane="{lane}"/>'
                )
        x = rng.uniform(320.0, 720.0) + 200.0 * scene.drop
        for i in range(CARS):
            truck = i > 0 and scene.trucks > 0 and rng.random() < scene.trucks
            own = {**values, **{key: rng.uniform(*ends) for key, ends in scene.each.items()}}
            if truck:
                own["tau"] += 0.8
            length = TRUCK if truck else LENGTH
            text = " ".join(f'{key}="{value:.9g}"' for key, value in own.items())
            kind = "lead" if not i else "truck" if truck else "car"
            # those behind reckon with how hard the leader can brake: as hard as they
            model = (
                f'carFollowModel="{scene.follow}" {text}' if i else f'decel="{own["decel"]:.9g}"'
            )
            beside = [(f"unseen-{k}", 1)] if scene.drop and i == 2 else []
            for name, lane in ((f"{k}-{i}", 0), *beside):
                cars.append(
                    f'<vType id="{kind}.{name}" length="{length}" speedFactor="1" '
                    f'speedDev="{scene.deviation:g}" {model}/><vehicle id="{name}" '
                    f'type="{kind}.{name}" depart="0" departPos="{x + 9 * lane:.3f}" '
                    f'departSpeed="12" departLane="{lane}" insertionChecks="none">'
                    f'<route edges="a{k} b{k} c{k}"/></vehicle>'
                )
            x -= length + 2.5 + 12 * rng.uniform(1.0, 1.8)
    (folder / "a.rou.xml").write_text(f"<routes>{''.join(cars)}</routes>")
    network(home, folder, "".join(nodes), "".join(edges), "".join(goes_on))


def _speeds(rng: np.random.Generator, steps: int) -> np.ndarray:
    """``(K,)`` m/s of a leader."""
    found = [12.0]
    for rate in accelerations(rng, steps, STEP)[: steps - 1]:
        found.append(float(np.clip(found[-1] + STEP * rate, 4.0, 18.0)))
    return np.array(found)


def _read(path: Path) -> pd.DataFrame:
    rows = []
    for _, step in ElementTree.iterparse(path):
        if step.tag != "timestep":
            continue
        at = round(float(step.attrib["time"]), 3)
        if at >= WARM and round(at / STEP) % EVERY == 0:
            rows += [
                (v.get("id"), v.get("type"), at, float(v.get("x", "nan")))
                for v in step
                if not v.get("id", "").startswith("unseen")
            ]
        step.clear()
    table = pd.DataFrame(rows, columns=["agent", "type", "time", "x"])
    kind = table.pop("type").str.partition(".")[0]
    table["kind"] = kind.where(kind == "truck", "car")
    table["length"] = np.where(table["kind"] == "truck", TRUCK, LENGTH)
    table.insert(0, "sequence", "s" + table["agent"].str.partition("-")[0].str.zfill(3))
    return table
