"""JuPedSim: people with targets, and two groups that walk through each other in open space."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nnode.data.readers.jupedsim import WalkwayOptions, read_walkway
from nnode.data.sequence import Sequence

#: JuPedSim's step and the sampling interval of its output, s; recorded time, s.
STEP, SAMPLE, SECONDS = 0.01, 0.1, 8.0
#: Distance of the goals from the middle of a square room, m; its walls are half as far again.
GOAL = 40.0
#: People of a group; two groups walk towards each other.
GROUP = 4


def walked(
    jupedsim: ModuleType,
    path: Path,
    model: Any,
    person: Callable[..., Any],
    people: Iterable[Mapping[str, Any]],
    goals: np.ndarray,
    room: Any,
    seconds: float,
    *,
    dt: float = STEP,
    every: int = 1,
) -> tuple[Sequence, list[int]]:
    """The paths of people, read from JuPedSim's file.

    Args:
        path: the file to write.
        model: one of JuPedSim's models.
        person: makes the parameters of an agent of this model.
        people: arguments of ``person``, besides the journey.
        goals: ``(N, 2)`` targets, m.
        room: the walkable area.
        seconds: simulated time, s.
        dt: JuPedSim's step, s.
        every: number of steps from one written frame to the next.

    Returns:
        The sequence, and for each of its agents the number in ``people``.
    """
    writer = jupedsim.SqliteTrajectoryWriter(output_file=path, every_nth_frame=every)
    simulation = jupedsim.Simulation(model=model, geometry=room, dt=dt, trajectory_writer=writer)
    stage = simulation.add_direct_steering_stage()
    journey = simulation.add_journey(jupedsim.JourneyDescription([stage]))
    number: dict[str, int] = {}
    for values, goal in zip(people, goals, strict=True):
        agent = simulation.add_agent(person(journey_id=journey, stage_id=stage, **values))
        simulation.agent(agent).target = tuple(goal)
        number[str(agent)] = len(number)
    for _ in range(round(seconds / dt) + 1):
        simulation.iterate()
    writer.close()
    found = read_walkway(path, WalkwayOptions(path=str(path), t_seq=seconds))[0]
    return found, [number[agent] for agent in found.agents]


def facing(side: float, speed: float) -> dict[str, Any]:
    """What oriented agents are given besides: they walk along x towards ``side`` (1 or -1)."""
    direction = (float(side), 0.0)
    return {"speed": speed, "orientation": direction, "desired_direction": direction}


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
    """Two groups of people who start from rest, with their goals.

    Args:
        path, model, person, dt: as in :func:`walked`.
        values: arguments of ``person``, besides place and journey.
        seed: of the places.
        before: positions are those of one step earlier, see :mod:`benchmarks.programs.laws`.
        apart: least distance of two people at the start, m.
        speed: of everybody at the start, m/s, towards the goal; only ``oriented`` agents have one.
        oriented: agents are given their direction as well.
        goal: distance of the goals from the middle, m.
    """
    import shapely

    start, goals = places(np.random.default_rng(seed), apart, goal)
    people = [
        {**values, "position": tuple(place)} | (facing(np.sign(aim[0]), speed) if oriented else {})
        for place, aim in zip(start, goals, strict=True)
    ]
    room = shapely.box(-1.5 * goal, -1.5 * goal, 1.5 * goal, 1.5 * goal)
    found, order = walked(jupedsim, path, model, person, people, goals, room, SECONDS, dt=dt)
    frames = round(SAMPLE / dt) * np.arange(round(SECONDS / SAMPLE) + 1)
    x = found.x[np.maximum(frames - 1, 0) if before else frames]
    # a step moves people with the new velocity
    v = (found.x[frames] - found.x[np.maximum(frames - 1, 0)]) / dt
    v[0] = speed * np.sign(goals[order]) * np.array([1.0, 0.0])
    if before:
        x[0] -= dt * v[0]
    return replace(found, time=found.time[frames], x=x, v=v, walls=None, destination=goals[order])


def places(rng: np.random.Generator, apart: float, far: float) -> tuple[np.ndarray, np.ndarray]:
    """``(2 GROUP, 2)`` starts, the groups 6 m apart, and goals far behind the other group, m."""
    found: list[np.ndarray] = []
    while len(found) < 2 * GROUP:
        side = -1.0 if len(found) < GROUP else 1.0
        place = np.array([side * rng.uniform(2.5, 5.0), rng.uniform(-1.2, 1.2)])
        if all(np.linalg.norm(place - other) > apart for other in found):
            found.append(place)
    start = np.array(found)
    return start, np.stack([-np.sign(start[:, 0]) * far, start[:, 1]], 1)


def pieces(whole: Sequence, seconds: float) -> list[Sequence]:
    """Consecutive sequences of this duration, s, each from its own start."""
    n = round(seconds / SAMPLE)
    assert whole.v is not None
    return [
        replace(whole, name=f"{whole.name}-{k}", time=whole.time[p], x=whole.x[p], v=whole.v[p])
        for k in range(0, whole.n_samples - n, n)
        for p in [slice(k, k + n + 1)]
    ]
