"""The scenes of ``scenes.yaml`` that JuPedSim simulates.

Two groups walk towards each other through a wide room, a corridor, a door or past a pillar.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.discovery.scenes import SCENES, drawn, generator
from benchmarks.programs.jupedsim import SAMPLE, STEP, facing, walked

#: Sequences of a scene, people of a group, seconds before the recording and of the recording.
SEQUENCES, GROUP, WARM, SECONDS = 24, 5, 2.0, 5.0
#: Half the width of the room and of a corridor, and how far the goals are, m.
ROOM, HALF, GOAL = 30.0, 1.6, 60.0
#: Half the width of a door, m.
DOOR = 1.3
#: Errors of measured places, m.
ERROR = (0.005, 0.02)


def recorded(name: str, seed: int) -> tuple[pd.DataFrame, pd.DataFrame | None]:
    """The table of a scene (sequence, time, agent, x, y), and the walls if they are measured.

    Raises:
        ImportError: JuPedSim is not installed.
    """
    import shapely

    jupedsim = import_module("jupedsim")
    scene, rng = SCENES["jupedsim"][name], generator(name, seed)
    kind = scene["kind"]
    values = {
        part: drawn(rng, entry) for part, entry in scene.items() if part in ("person", "model")
    }
    half, end = HALF if "corridor" in scene else ROOM, 1.5 * GOAL
    room = shapely.box(-end, -half, end, half)
    if "pillar" in scene:
        room = room.difference(shapely.Point(0, 0).buffer(scene["pillar"], quad_segs=4))
    if "door" in scene:
        wall = shapely.box(-0.15, -half, 0.15, half)
        room = room.difference(wall.difference(shapely.box(-1.0, -DOOR, 1.0, DOOR)))
    error = rng.uniform(*ERROR)
    rows: list[pd.DataFrame] = []
    with TemporaryDirectory() as folder:
        for number in range(SEQUENCES):
            people = [values["person"] | each for each in _people(rng, scene)]
            goals = [(-np.sign(p["position"][0]) * GOAL, p["position"][1]) for p in people]
            sequence, order = walked(
                jupedsim,
                Path(folder) / f"{number}.sqlite",
                getattr(jupedsim, kind)(**values["model"]),
                getattr(jupedsim, f"{kind}AgentParameters"),
                people,
                np.array(goals),
                room,
                WARM + SECONDS,
                every=round(SAMPLE / STEP),
            )
            first = round(WARM / SAMPLE)
            x = sequence.x[first:, np.argsort(order)]
            k, n = (axis.ravel() for axis in np.indices(x.shape[:2]))
            rows.append(
                pd.DataFrame(
                    {
                        "sequence": f"s{number:03d}",
                        "time": sequence.time[first:].round(3)[k],
                        "agent": [f"s{number:03d}-{i}" for i in n],
                        "x": x[..., 0].ravel(),
                        "y": x[..., 1].ravel(),
                    }
                )
            )
    table = pd.concat(rows, ignore_index=True)
    table[["x", "y"]] += error * rng.standard_normal((len(table), 2))
    if "measured" not in scene:
        return table, None
    walls = [(-end, -half, end, -half), (-end, half, end, half)]
    return table, pd.DataFrame(walls, columns=["x1", "y1", "x2", "y2"])


def _people(rng: np.random.Generator, scene: dict[str, Any]) -> list[dict[str, Any]]:
    """Places and speeds of both groups."""
    people: list[dict[str, Any]] = []
    while len(people) < 2 * GROUP:
        side = -1.0 if len(people) < GROUP else 1.0
        place = np.array([side * rng.uniform(3.0, 9.0), rng.uniform(-1.1, 1.1)])
        if any(np.linalg.norm(place - other["position"]) < 1.2 for other in people):
            continue
        speed = scene.get("speeds", (1.3, 1.3))[int(side > 0)] * rng.uniform(0.95, 1.05)
        person: dict[str, Any] = {"position": tuple(place), "desired_speed": speed}
        people.append(person | (facing(-side, speed) if "Centrifugal" in scene["kind"] else {}))
    return people
