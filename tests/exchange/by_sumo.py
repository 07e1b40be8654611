"""Platoons on separate roads, simulated by SUMO."""

from __future__ import annotations

import gzip
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np

from benchmarks.programs.sumo import call, network

#: SUMO's passenger car: length and gap at rest (m), time gap (s), comfortable deceleration (m/s²).
LENGTH, MIN_GAP, TAU, DECEL = 5.0, 2.5, 1.0, 4.5
#: Bounds of leaders' random speeds (m/s), and the time between changes (s).
SLOW, FAST, PERIOD = 10.0, 18.0, 5.0
#: Length of a road (m) and SUMO's step (s).
ROAD, STEP = 3000.0, 0.2


def platoons(
    home: Path,
    folder: Path,
    *,
    number: int = 24,
    cars: int = 5,
    seconds: float = 30.0,
    spread: float = 0.0,
    seed: int = 0,
    steer: Callable[[ModuleType], None] | None = None,
) -> Path:
    """SUMO's floating car data of platoons with its default law, that of Krauss with noise.

    Leaders follow variable speed signs. Followers may drive at twice the speed limit.

    Args:
        home: the folder of SUMO.
        folder: receives the files.
        spread: range of the platoons' starting positions, m.
        steer: is called before every step with SUMO's Python interface.
    """
    rng = np.random.default_rng(seed)
    road = _roads(home, folder, number)
    signs, vehicles = [], []
    for k in range(number):
        speeds = rng.uniform(SLOW, FAST, int(seconds / PERIOD) + 1)
        steps = "".join(
            f'<step time="{PERIOD * i:g}" speed="{v:.2f}"/>' for i, v in enumerate(speeds)
        )
        signs.append(f'<variableSpeedSign id="s{k}" lanes="e{k}_0">{steps}</variableSpeedSign>')
        x = 50.0 + 40.0 * cars + rng.uniform(0, spread)
        for i in range(cars):
            vehicles.append(
                f'<vehicle id="p{k}-{i}" type="{"own" if i else "lead"}" route="r{k}" depart="0" '
                f'departPos="{x:.2f}" departSpeed="{speeds[0]:.2f}"/>'
            )
            x -= LENGTH + MIN_GAP + speeds[0] * rng.uniform(1.0, 2.0)
    routes = "".join(f'<route id="r{k}" edges="e{k}"/>' for k in range(number))
    types = (
        '<vType id="lead" speedDev="0" sigma="0"/>'
        f'<vType id="own" speedDev="0" speedFactor="2" length="{LENGTH}" minGap="{MIN_GAP}" '
        f'tau="{TAU}" decel="{DECEL}"/>'
    )
    (folder / "a.add.xml").write_text(f"<additional>{types}{''.join(signs)}</additional>")
    (folder / "a.rou.xml").write_text(f"<routes>{routes}{''.join(vehicles)}</routes>")
    command = [
        home / "bin" / "sumo",
        *("-n", road, "-a", folder / "a.add.xml", "-r", folder / "a.rou.xml"),
        *("--step-length", STEP, "--seed", seed, "--no-step-log"),
        *("--fcd-output", folder / "fcd.xml.gz"),
        *("--fcd-output.attributes", "id,type,pos,lane"),
    ]
    if steer is None:
        call(*command, "--end", seconds + STEP)
    else:
        _steered(home, [str(part) for part in command], round(seconds / STEP) + 1, steer)
    return folder / "fcd.xml.gz"


def configured(
    folder: Path, *, step: float = 0.1, end: float | None = None, ballistic: bool = False
) -> Path:
    """SUMO's configuration for ``a.net.xml`` and ``a.rou.xml`` in a folder."""
    limit = "" if end is None else f'<end value="{end}"/>'
    path = folder / "a.sumocfg"
    path.write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/>'
        f'</input><time><step-length value="{step}"/>{limit}</time>'
        f'<processing><step-method.ballistic value="{str(ballistic).lower()}"/></processing>'
        '<report><no-warnings value="true"/></report></configuration>'
    )
    return path


def measured(path: Path, error: float, seed: int = 0) -> Path:
    """The trajectories with normal errors of ``error`` m in positions."""
    rng = np.random.default_rng(seed)
    text = re.sub(
        r' pos="([^"]+)"',
        lambda m: f' pos="{float(m[1]) + error * rng.standard_normal():.3f}"',
        gzip.decompress(path.read_bytes()).decode(),
    )
    result = path.with_name("measured.xml.gz")
    result.write_bytes(gzip.compress(text.encode()))
    return result


def _roads(home: Path, folder: Path, number: int) -> Path:
    """Parallel straight roads of one lane."""
    nodes = "".join(
        f'<node id="a{k}" x="0" y="{50 * k}"/><node id="b{k}" x="{ROAD:g}" y="{50 * k}"/>'
        for k in range(number)
    )
    edges = "".join(
        f'<edge id="e{k}" from="a{k}" to="b{k}" numLanes="1" speed="50"/>' for k in range(number)
    )
    return network(home, folder, nodes, edges)


def _steered(
    home: Path, command: list[str], steps: int, steer: Callable[[ModuleType], None]
) -> None:
    """Run SUMO step by step."""
    sys.path.append(str(home / "tools"))
    try:
        import traci
    finally:
        sys.path.remove(str(home / "tools"))
    traci.start(command)
    try:
        for _ in range(steps):
            steer(traci)
            traci.simulationStep()
    finally:
        traci.close()
