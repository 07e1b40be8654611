"""Platoons whose followers SUMO drives, in the scenes of ``scenes.yaml``.

Every platoon has a road of its own. Its leader is given its speed at every step; SUMO does the
rest.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from benchmarks.discovery.scenes import SCENES, drawn, generator
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
#: Attributes of the vehicles' type, and those that Krauss' has instead.
DRIVER = {
    "accel": (0.8, 2),
    "decel": (1.2, 2.5),
    "tau": (0.9, 1.6),
    "minGap": (1.5, 2.5),
    "maxSpeed": (24, 34),
}
KRAUSS = {"decel": (2, 4.5), "sigma": 0.0}
#: Names of vehicles that nobody recorded begin with this.
UNSEEN = "unseen"

Scene = dict[str, Any]


def recorded(name: str, seed: int) -> tuple[pd.DataFrame, None]:
    """The table of a scene: sequence, time, agent, x, length, kind; there are no walls.

    Raises:
        ImportError: SUMO is not installed.
    """
    scene, rng = SCENES["sumo"][name], generator(name, seed)
    values = drawn(rng, DRIVER)
    values |= drawn(rng, KRAUSS) if scene["follow"] == "Krauss" else {}
    values |= drawn(rng, scene.get("more", {}))
    with TemporaryDirectory() as folder:
        _write(Path(folder), scene, values, rng)
        table = _read(_simulated(Path(folder), scene, rng))
    table["x"] += rng.uniform(*ERROR) * rng.standard_normal(len(table))
    return table, None


def _simulated(folder: Path, scene: Scene, rng: np.random.Generator) -> Path:
    """Run SUMO in a folder; returns its output."""
    number = int(rng.integers(1 << 30))
    steps = round((WARM + SECONDS) / STEP)
    speeds = np.stack([_speeds(rng, steps) for _ in range(ROADS)])
    begin = WARM + rng.uniform(0.2, 0.5) * SECONDS
    slow = rng.uniform(*LIMIT)
    control = partial(_control, scene, speeds, begin, slow)
    options = ["--precision", 6, "--seed", number, "--collision.action", "none"]
    return run(sumo_home(), folder, "fcd.xml", "id,type,x,y", steps, control, *options)


def _control(
    scene: Scene, speeds: np.ndarray, begin: float, slow: float, traci: ModuleType, step: int
) -> None:
    """Drive the leaders, and change limits and lights."""
    for k in range(ROADS):
        if not step:
            traci.vehicle.setSpeedMode(f"{k}-0", 0)
        traci.vehicle.setSpeed(f"{k}-0", float(speeds[k, step]))
    for name in traci.vehicle.getIDList() if "drop" in scene and not step else ():
        if not name.startswith(UNSEEN):
            traci.vehicle.setLaneChangeMode(name, 0)
    limits = {round(begin / STEP): slow, round((begin + 8) / STEP): FREE}
    for name in traci.edge.getIDList() if "period" in scene and step in limits else ():
        traci.edge.setMaxSpeed(name, limits[step])
    color = "r" if begin <= step * STEP < begin + 8 else "G"
    for name in traci.trafficlight.getIDList() if "red" in scene else ():
        traci.trafficlight.setRedYellowGreenState(name, color)


def _write(folder: Path, scene: Scene, values: dict[str, float], rng: np.random.Generator) -> None:
    """Write the roads and the traffic."""
    ends = {"a": 0.0, "b": STRETCH[0], "c": STRETCH[1], "d": ROAD}
    allowed = rng.uniform(*scene.get("limit", (FREE, FREE)))
    limit = rng.uniform(*LIMIT) if "stretch" in scene else allowed
    drop, light = "drop" in scene, ' type="traffic_light"' if "red" in scene else ""
    nodes, edges, cars, connections = "", "", "", ""
    for k in range(ROADS):
        for n, x in ends.items():
            kind = light if n == "b" else ""
            nodes += f'<node id="{n}{k}" x="{x:g}" y="{50 * k}" radius="0"{kind}/>'
        for start, end in ("ab", "bc", "cd"):
            way = f'from="{start}{k}" to="{end}{k}"'
            lanes, speed = 2 if drop and start != "c" else 1, limit if start == "b" else allowed
            edges += f'<edge id="{start}{k}" {way} numLanes="{lanes}" speed="{speed}"/>'
            for lane in range({"a": lanes, "b": 1, "c": 0}[start]):
                connections += f'<connection {way} fromLane="{lane}" toLane="{lane}"/>'
        x = rng.uniform(320.0, 720.0) + 200.0 * drop
        for i in range(CARS):
            kind = "car" if i else "lead"
            if i and "trucks" in scene and rng.random() < scene["trucks"]:
                kind = "truck"
            driver = values | drawn(rng, scene.get("each", {}))
            driver["tau"] += 0.8 * (kind == "truck")
            # those behind reckon with how hard the leader can brake: as hard as they
            shown = driver if i else {"decel": driver["decel"]}
            model = f'carFollowModel="{scene["follow"]}" ' if i else ""
            model += " ".join(f'{key}="{value:.9g}"' for key, value in shown.items())
            length = TRUCK if kind == "truck" else LENGTH
            placed = {f"{k}-{i}": 0} | ({f"{UNSEEN}-{k}": 1} if drop and i == 2 else {})
            for name, lane in placed.items():
                cars += (
                    f'<vType id="{kind}.{name}" length="{length}" speedFactor="1" '
                    f'speedDev="{scene.get("deviation", 0):g}" {model}/><vehicle id="{name}" '
                    f'type="{kind}.{name}" depart="0" departPos="{x + 9 * lane:.3f}" '
                    f'departSpeed="12" departLane="{lane}" insertionChecks="none">'
                    f'<route edges="a{k} b{k} c{k}"/></vehicle>'
                )
            x -= length + 2.5 + 12 * rng.uniform(1.0, 1.8)
    (folder / "a.rou.xml").write_text(f"<routes>{cars}</routes>")
    network(sumo_home(), folder, nodes, edges, connections)


def _speeds(rng: np.random.Generator, steps: int) -> np.ndarray:
    """``(K,)`` m/s of a leader."""
    speeds = [12.0]
    for rate in accelerations(rng, steps, STEP)[: steps - 1]:
        speeds.append(float(np.clip(speeds[-1] + STEP * rate, 4.0, 18.0)))
    return np.array(speeds)


def _read(path: Path) -> pd.DataFrame:
    rows = []
    for _, step in ElementTree.iterparse(path):
        if step.tag != "timestep":
            continue
        time = round(float(step.attrib["time"]), 3)
        if time >= WARM and round(time / STEP) % EVERY == 0:
            rows += [{**v.attrib, "time": time} for v in step if UNSEEN not in v.attrib["id"]]
        step.clear()
    table = pd.DataFrame(rows)
    truck = table["type"].str.startswith("truck")
    return pd.DataFrame(
        {
            "sequence": "s" + table["id"].str.partition("-")[0].str.zfill(3),
            "agent": table["id"],
            "time": table["time"],
            "x": table["x"].astype(float),
            "kind": np.where(truck, "truck", "car"),
            "length": np.where(truck, TRUCK, LENGTH),
        }
    )
