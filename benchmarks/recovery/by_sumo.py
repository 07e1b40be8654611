"""One platoon by SUMO behind a leader that accelerates, cruises, brakes and stops."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

#: SUMO's step and the interval of its output, s; length of its vehicles, m; of the road, m.
STEP, LENGTH, ROAD = 0.1, 5.0, 5000.0
#: Followers, and how long they are watched, s.
FOLLOWERS, SECONDS = 7, 60.0
#: Speed of the leader, m/s, linear between these times, s: it speeds up and slows down, stops
#: and starts again.
PROFILE = np.array(
    [
        (0, 12),
        (6, 12),
        (11, 22),
        (17, 22),
        (19, 15),
        (24, 17),
        (30, 0),
        (37, 0),
        (45, 18),
        (50, 18),
        (52, 12),
        (60, 20),
    ],
    dtype=float,
)
#: Decimals of SUMO's output.
DIGITS = 9


def platoon(
    home: Path,
    folder: Path,
    follow: str,
    values: Mapping[str, float],
    *,
    ballistic: bool = False,
    profile: np.ndarray = PROFILE,
    seconds: float = SECONDS,
    gap: float = 16.0,
) -> Path:
    """SUMO's floating car data of a platoon without noise.

    Args:
        home: SUMO's folder.
        folder: receives its files.
        follow: SUMO's name of the car-following model.
        values: attributes of the vehicles' type: ``accel``, ``decel``, ``tau``, ``minGap``, ...
        ballistic: SUMO's step places with the mean of both speeds, else with the new one.
        profile: ``(P, 2)`` times, s, and speeds of the leader, m/s.
        gap: between bumpers at the start, m; it grows by a metre from vehicle to vehicle.
    """
    write_scene(home, folder, follow, values, speed=float(profile[0, 1]), gap=gap)
    command = [
        home / "bin" / "sumo",
        "-n",
        folder / "a.net.xml",
        "-r",
        folder / "a.rou.xml",
        "--step-length",
        STEP,
        "--precision",
        DIGITS,
        "--no-step-log",
        "--no-warnings",
        "--fcd-output",
        folder / "fcd.xml.gz",
        "--fcd-output.attributes",
        "id,type,speed,pos,lane",
        *(["--step-method.ballistic"] if ballistic else []),
    ]
    _led([str(part) for part in command], home, profile, round(seconds / STEP))
    return folder / "fcd.xml.gz"


def write_scene(
    home: Path,
    folder: Path,
    follow: str,
    values: Mapping[str, float],
    *,
    speed: float = float(PROFILE[0, 1]),
    gap: float = 16.0,
) -> None:
    """A road, ``a.net.xml``, and a leader ``c0`` with followers of type ``own``, ``a.rou.xml``.

    Args:
        speed: of everybody at the start, m/s.
    """
    folder.mkdir(parents=True, exist_ok=True)
    attributes = " ".join(f"{k}={quoteattr(f'{v:.17g}')}" for k, v in values.items())
    cars, place = [], 400.0
    for i in range(FOLLOWERS + 1):
        cars.append(
            f'<vehicle id="c{i}" type="{"own" if i else "lead"}" route="r" depart="0" '
            f'departPos="{place:g}" departSpeed="{speed:g}" insertionChecks="none"/>'
        )
        place -= LENGTH + gap + i
    (folder / "a.rou.xml").write_text(
        f'<routes><vType id="lead" length="{LENGTH}" maxSpeed="60" speedDev="0" sigma="0" '
        f'apparentDecel="{values["decel"]:.17g}"/>'
        f'<vType id="own" carFollowModel="{follow}" length="{LENGTH}" speedFactor="1" speedDev="0" '
        f'{attributes}/><route id="r" edges="e"/>{"".join(cars)}</routes>'
    )
    nodes = f'<node id="a" x="0" y="0"/><node id="b" x="{ROAD:g}" y="0"/>'
    network(home, folder, nodes, '<edge id="e" from="a" to="b" numLanes="1" speed="60"/>')


def network(home: Path, folder: Path, nodes: str, edges: str) -> Path:
    """SUMO's network of nodes and edges, XML elements both."""
    (folder / "a.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "a.edg.xml").write_text(f"<edges>{edges}</edges>")
    call(
        home / "bin" / "netconvert",
        "-n",
        folder / "a.nod.xml",
        "-e",
        folder / "a.edg.xml",
        "-o",
        folder / "a.net.xml",
    )
    return folder / "a.net.xml"


def _led(command: list[str], home: Path, profile: np.ndarray, steps: int) -> None:
    """Run SUMO, the leader at the speed that the profile says at the end of each step."""
    sys.path.append(str(home / "tools"))
    try:
        traci = import_module("traci")
    finally:
        sys.path.remove(str(home / "tools"))
    traci.start(command, stdout=subprocess.DEVNULL)
    try:
        traci.simulationStep()  # they enter the road
        traci.vehicle.setSpeedMode("c0", 0)
        for k in range(1, steps + 1):
            traci.vehicle.setSpeed("c0", float(np.interp(k * STEP, *profile.T)))
            traci.simulationStep()
    finally:
        traci.close()


def call(*arguments: object) -> None:
    """Run a program.

    Raises:
        RuntimeError: it fails; what it said.
    """
    done = subprocess.run([str(a) for a in arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr)
