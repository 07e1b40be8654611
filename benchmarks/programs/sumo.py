"""SUMO: networks, and one platoon behind a leader that accelerates, cruises, brakes and stops."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from xml.sax.saxutils import quoteattr

import numpy as np

#: SUMO's step and the interval of its output, s; length of its vehicles, m; of the road, m.
STEP, LENGTH, ROAD = 0.1, 5.0, 5000.0
#: Followers, and the recorded time, s.
FOLLOWERS, SECONDS = 7, 60.0
#: Speed of the leader, m/s, linear between these times, s: it accelerates, brakes, stops and
#: starts again.
PROFILE = np.array(
    [
        [0, 6, 11, 17, 19, 24, 30, 37, 45, 50, 52, 60],
        [12, 12, 22, 22, 15, 17, 0, 0, 18, 18, 12, 20],
    ],
    dtype=float,
).T
#: The same of a leader that never drives at the followers' v0 and never stops.
SLOWLY = np.array(
    [[0, 6, 11, 17, 20, 28, 34, 40, 45, 52, 60], [8, 8, 14, 14, 6, 5, 12, 12, 4, 13, 10]],
    dtype=float,
).T
#: Decimals of SUMO's output.
DIGITS = 9


def sumo_home() -> Path:
    """SUMO's folder.

    Raises:
        ImportError: SUMO is not installed.
    """
    return Path(str(import_module("sumo").SUMO_HOME))


def call(*arguments: object) -> None:
    """Run a program.

    Raises:
        RuntimeError: the program fails; its error output.
    """
    done = subprocess.run([str(a) for a in arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr)


def network(home: Path, folder: Path, nodes: str, edges: str, connections: str = "") -> Path:
    """SUMO's network of nodes, edges and connections, which are XML elements.

    Args:
        connections: without them netconvert chooses; with them junctions have no size.
    """
    options: list[str | Path] = []
    if connections:
        (folder / "a.con.xml").write_text(f"<connections>{connections}</connections>")
        options = ["-x", folder / "a.con.xml", "--no-internal-links", "--junctions.minimal-shape"]
    (folder / "a.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "a.edg.xml").write_text(f"<edges>{edges}</edges>")
    found = folder / "a.net.xml"
    program = home / "bin" / "netconvert"
    call(program, "-n", folder / "a.nod.xml", "-e", folder / "a.edg.xml", "-o", found, *options)
    return found


def run(
    home: Path,
    folder: Path,
    output: str,
    attributes: str,
    steps: int,
    control: Callable[[ModuleType, int], None],
    *options: object,
) -> Path:
    """Simulate the network and the routes of a folder; returns the floating car data.

    Args:
        output: name of the file with the floating car data, which has these ``attributes``.
        steps: after the first one, in which the vehicles enter the road.
        control: is called before each step with TraCI and the number of the step.
        options: further options of SUMO.
    """
    sys.path.append(str(home / "tools"))
    try:
        traci = import_module("traci")
    finally:
        sys.path.remove(str(home / "tools"))
    files = [
        "-n",
        folder / "a.net.xml",
        "-r",
        folder / "a.rou.xml",
        "--fcd-output",
        folder / output,
    ]
    quiet = ["--step-length", STEP, "--no-step-log", "--no-warnings"]
    command = [home / "bin" / "sumo", *files, "--fcd-output.attributes", attributes, *quiet]
    traci.start([str(part) for part in (*command, *options)], stdout=subprocess.DEVNULL)
    try:
        traci.simulationStep()
        for step in range(steps):
            control(traci, step)
            traci.simulationStep()
    finally:
        traci.close()
    return folder / output


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

    def lead(traci: ModuleType, step: int) -> None:
        if not step:
            traci.vehicle.setSpeedMode("c0", 0)
        traci.vehicle.setSpeed("c0", float(np.interp((step + 1) * STEP, *profile.T)))

    options = ["--precision", DIGITS, *(["--step-method.ballistic"] if ballistic else [])]
    steps = round(seconds / STEP)
    return run(home, folder, "fcd.xml.gz", "id,type,speed,pos,lane", steps, lead, *options)


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
