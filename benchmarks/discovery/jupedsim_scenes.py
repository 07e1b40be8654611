"""Scenes that JuPedSim simulates from a seed, and the right answer for each.

Two groups walk towards each other through a wide room, a corridor, a door or past a pillar. The
right answers were written down before anything was run. Where nothing is hidden but another law,
the right answer is to name nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.discovery.worlds import Answer
from benchmarks.programs.jupedsim import SAMPLE, STEP, facing, walked

#: Sequences of a scene, people of a group, seconds before the recording and of the recording.
SEQUENCES, GROUP, WARM, SECONDS = 24, 5, 2.0, 5.0
#: Half the width of the room and of a corridor, and how far the goals are, m.
ROOM, HALF, GOAL = 30.0, 1.6, 60.0
#: Half the width of a door, m.
DOOR = 1.3
#: Errors of measured places, m.
ERROR = (0.005, 0.02)

Draw = Callable[[np.random.Generator], tuple[str, dict[str, float], dict[str, float]]]


def _social(rng: np.random.Generator) -> tuple[str, dict[str, float], dict[str, float]]:
    person = {
        "mass": 80.0,
        "radius": 0.25,
        "reaction_time": rng.uniform(0.4, 0.7),
        "agent_scale": rng.uniform(80, 240),
        "force_distance": rng.uniform(0.2, 0.4),
        "obstacle_scale": rng.uniform(150, 400),
    }
    # no bodies: contacts are rare and stiff
    return "SocialForceModel", {"body_force": 0.0, "friction": 0.0}, person


def _centrifugal(rng: np.random.Generator) -> tuple[str, dict[str, float], dict[str, float]]:
    person = {"mass": 1.0, "tau": rng.uniform(0.4, 0.7), "a_v": rng.uniform(0.3, 0.8)}
    return (
        "GeneralizedCentrifugalForceModel",
        {"strength_neighbor_repulsion": rng.uniform(0.2, 0.5)},
        person,
    )


def _free(rng: np.random.Generator) -> tuple[str, dict[str, float], dict[str, float]]:
    model = {
        "strength_neighbor_repulsion": rng.uniform(4, 8),
        "range_neighbor_repulsion": rng.uniform(0.1, 0.3),
    }
    return "CollisionFreeSpeedModel", model, {"time_gap": rng.uniform(0.8, 1.3), "radius": 0.2}


def _foreseeing(rng: np.random.Generator) -> tuple[str, dict[str, float], dict[str, float]]:
    person = {
        "time_gap": rng.uniform(0.8, 1.2),
        "anticipation_time": rng.uniform(0.6, 1.4),
        "reaction_time": rng.uniform(0.2, 0.4),
    }
    return "AnticipationVelocityModel", {}, person


@dataclass(frozen=True)
class Scene:
    """What JuPedSim simulates.

    Attributes:
        draw: its model, the model's parameters and those of a person.
        answer: what is right to say.
        corridor: walls near the groups; ``known``: they are measured, and the model has none.
        pillar: radius of a pillar in the middle, which nobody measured, m.
        door: both groups go through one in a wall across the room, which nobody measured.
        speeds: of the two groups, desired, m/s.
    """

    draw: Draw
    answer: Answer
    corridor: bool = False
    known: bool = False
    pillar: float = 0.0
    door: bool = False
    speeds: tuple[float, float] = (1.3, 1.3)


#: ``sf`` does not calibrate the range of its force.
_RANGE = ("pair_repulsion",)
#: Laws whose force turns with the view as well.
_VIEW = ("field_of_view", *_RANGE)
_OTHER, _SEEN = Answer(allowed=_RANGE), Answer(allowed=_VIEW)
_FORESEEN = Answer(allowed=(*_VIEW, "anticipation"))
SCENES: dict[str, Scene] = {
    "sf": Scene(_social, _OTHER),
    "gcfm": Scene(_centrifugal, _FORESEEN),
    "cfsm": Scene(_free, _SEEN),
    "avm": Scene(_foreseeing, _FORESEEN),
    "sf_walls": Scene(
        _social, replace(_OTHER, right=("wall_repulsion",)), corridor=True, known=True
    ),
    "sf_walls_withheld": Scene(_social, _OTHER, corridor=True),
    "cfsm_walls_withheld": Scene(_free, _SEEN, corridor=True),
    "sf_pillar": Scene(_social, replace(_OTHER, right=("obstacle",)), pillar=0.4),
    "sf_speeds": Scene(_social, _OTHER, speeds=(1.0, 1.6)),
    "gcfm_pillar": Scene(_centrifugal, replace(_FORESEEN, right=("obstacle",)), pillar=0.4),
    # its two ends push like small obstacles; who meets nobody there does not show them
    "sf_door": Scene(_social, replace(_OTHER, allowed=(*_RANGE, "obstacle")), door=True),
    "cfsm_door": Scene(_free, replace(_SEEN, allowed=(*_VIEW, "obstacle")), door=True),
}


def recorded(name: str, seed: int) -> tuple[pd.DataFrame, pd.DataFrame | None]:
    """The table of a scene (sequence, time, agent, x, y), and the walls if they are known.

    Raises:
        ImportError: JuPedSim is not installed.
    """
    import shapely

    jupedsim = import_module("jupedsim")
    scene = SCENES[name]
    rng = np.random.default_rng(list(hashlib.sha256(f"{name} {seed}".encode()).digest()))
    kind, values, person = scene.draw(rng)
    half = HALF if scene.corridor else ROOM
    room = shapely.box(-1.5 * GOAL, -half, 1.5 * GOAL, half)
    if scene.pillar:
        room = room.difference(shapely.Point(0, 0).buffer(scene.pillar, quad_segs=4))
    if scene.door:
        wall = shapely.box(-0.15, -half, 0.15, half)
        room = room.difference(wall.difference(shapely.box(-1.0, -DOOR, 1.0, DOOR)))
    error = rng.uniform(*ERROR)
    rows: list[pd.DataFrame] = []
    with TemporaryDirectory() as folder:
        for number in range(SEQUENCES):
            people = [{**person, **each} for each in _people(rng, scene, kind)]
            goals = np.array(
                [(-np.sign(p["position"][0]) * GOAL, p["position"][1]) for p in people]
            )
            sequence, order = walked(
                jupedsim,
                Path(folder) / f"{number}.sqlite",
                getattr(jupedsim, kind)(**values),
                getattr(jupedsim, f"{kind}AgentParameters"),
                people,
                goals,
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
    end = 1.5 * GOAL
    walls = pd.DataFrame(
        [(-end, -half, end, -half), (-end, half, end, half)], columns=["x1", "y1", "x2", "y2"]
    )
    return table, walls if scene.known else None


def _people(rng: np.random.Generator, scene: Scene, kind: str) -> list[dict[str, Any]]:
    """Places and speeds of both groups."""
    found: list[dict[str, Any]] = []
    while len(found) < 2 * GROUP:
        side = -1.0 if len(found) < GROUP else 1.0
        at = np.array([side * rng.uniform(3.0, 9.0), rng.uniform(-1.1, 1.1)])
        if any(np.linalg.norm(at - other["position"]) < 1.2 for other in found):
            continue
        speed = scene.speeds[int(side > 0)] * rng.uniform(0.95, 1.05)
        values: dict[str, Any] = {"position": tuple(at), "desired_speed": speed}
        found.append(values | (facing(-side, speed) if "Centrifugal" in kind else {}))
    return found
