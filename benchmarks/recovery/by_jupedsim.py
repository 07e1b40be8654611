"""Two groups that walk through each other in open space, by JuPedSim."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nnode.data.readers.jupedsim import WalkwayOptions, read_walkway
from nnode.data.sequence import Sequence

#: JuPedSim's step, and that of what it writes, s; how long people are watched, s.
STEP, SAMPLE, SECONDS = 0.01, 0.1, 8.0
#: How far off the middle of a square room goals are, m; its walls are half as far again.
GOAL = 40.0
#: People of a group, two groups walk against each other.
GROUP = 4


def groups(
    jupedsim: ModuleType,
    path: Path,
    model: Any,
    person: Callable[..., Any],
    values: Mapping[str, Any],
    *,
    seed: int,
    dt: float = STEP,
    before: bool = False,
    apart: float = 0.9,
    speed: float = 0.0,
    oriented: bool = False,
    goal: float = GOAL,
) -> Sequence:
    """Everybody's path, read from JuPedSim's file, with the goals that were set and from rest.

    Args:
        path: the file to write.
        model: one of JuPedSim's models.
        person: makes the parameters of an agent of it.
        values: what it is given besides place and journey.
        seed: of the places.
        dt: JuPedSim's step, s.
        before: places are those of one step earlier, see :data:`benchmarks.recovery.laws`.
        apart: least distance of two at the start, m.
        speed: of everybody at the start, m/s, towards his goal; it is only given to agents that
            are ``oriented``: those are told their direction as well.
        goal: distance of the goals from the middle, m.
    """
    import shapely

    every = round(SAMPLE / dt)
    writer = jupedsim.SqliteTrajectoryWriter(output_file=path, every_nth_frame=1)
    simulation = jupedsim.Simulation(
        model=model,
        geometry=shapely.box(-1.5 * goal, -1.5 * goal, 1.5 * goal, 1.5 * goal),
        dt=dt,
        trajectory_writer=writer,
    )
    stage = simulation.add_direct_steering_stage()
    journey = simulation.add_journey(jupedsim.JourneyDescription([stage]))
    start, goals = places(np.random.default_rng(seed), apart, goal)
    number: dict[str, int] = {}
    for place, aim in zip(start, goals, strict=True):
        more = dict(values)
        if oriented:
            way = (float(np.sign(aim[0])), 0.0)
            more |= {"speed": speed, "orientation": way, "desired_direction": way}
        own = simulation.add_agent(
            person(position=tuple(place), journey_id=journey, stage_id=stage, **more)
        )
        simulation.agent(own).target = tuple(aim)
        number[str(own)] = len(number)
    for _ in range(round(SECONDS / dt) + 1):
        simulation.iterate()
    writer.close()
    found = read_walkway(path, WalkwayOptions(path=str(path), t_seq=SECONDS))[0]
    order = [number[agent] for agent in found.agents]
    frames = every * np.arange(round(SECONDS / SAMPLE) + 1)
    x = found.x[np.maximum(frames - 1, 0) if before else frames]
    # a step places with the new velocity
    v = (found.x[frames] - found.x[np.maximum(frames - 1, 0)]) / dt
    v[0] = speed * np.sign(goals[order]) * np.array([1.0, 0.0])
    if before:
        x[0] -= dt * v[0]
    return replace(found, time=found.time[frames], x=x, v=v, walls=None, destination=goals[order])


def places(rng: np.random.Generator, apart: float, far: float) -> tuple[np.ndarray, np.ndarray]:
    """``(2 GROUP, 2)`` starts, the groups 6 m apart, and goals far behind the other group."""
    found: list[np.ndarray] = []
    while len(found) < 2 * GROUP:
        side = -1.0 if len(found) < GROUP else 1.0
        place = np.array([side * rng.uniform(2.5, 5.0), rng.uniform(-1.2, 1.2)])
        if all(np.linalg.norm(place - other) > apart for other in found):
            found.append(place)
    start = np.array(found)
    goal = np.stack([-np.sign(start[:, 0]) * far, start[:, 1]], 1)
    return start, goal


def pieces(whole: Sequence, seconds: float) -> list[Sequence]:
    """Sequences of so many seconds, one behind the other, each from its own start."""
    n = round(seconds / SAMPLE)
    parts = [(k, slice(k, k + n + 1)) for k in range(0, whole.n_samples - n, n)]
    assert whole.v is not None
    return [
        replace(
            whole,
            name=f"{whole.name}-{k}",
            time=whole.time[part],
            x=whole.x[part],
            v=whole.v[part],
        )
        for k, part in parts
    ]
