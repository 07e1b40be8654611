"""People in a corridor, simulated by JuPedSim."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from types import ModuleType

import numpy as np
import shapely

#: Length and width of the corridor (m).
LENGTH, WIDTH = 12.0, 4.0
#: Desired speed (m/s), reaction time (s) and radius (m) of every person.
SPEED, REACTION, RADIUS = 1.3, 0.5, 0.2
#: Time between crowds (s), in which a crowd leaves; step (s); number of steps per sample.
PERIOD, STEP, EVERY = 12.0, 0.01, 10


def crowds(
    jupedsim: ModuleType, path: Path, *, number: int = 18, people: int = 6, seed: int = 0
) -> Path:
    """A database of crowds that start from rest and walk to the right end of a corridor.

    The model is JuPedSim's social force with its defaults and the constants above.
    """
    rng = np.random.default_rng(seed)
    writer = jupedsim.SqliteTrajectoryWriter(output_file=path, every_nth_frame=EVERY)
    simulation = jupedsim.Simulation(
        model=jupedsim.SocialForceModel(),
        geometry=shapely.box(0, 0, LENGTH, WIDTH),
        dt=STEP,
        trajectory_writer=writer,
    )
    stage = simulation.add_exit_stage(
        [(LENGTH - 0.5, 0), (LENGTH, 0), (LENGTH, WIDTH), (LENGTH - 0.5, WIDTH)]
    )
    journey = simulation.add_journey(jupedsim.JourneyDescription([stage]))
    for crowd in range(number):
        for position in _positions(people, rng):
            simulation.add_agent(
                jupedsim.SocialForceModelAgentParameters(
                    position=tuple(position),
                    journey_id=journey,
                    stage_id=stage,
                    desired_speed=SPEED,
                    reaction_time=REACTION,
                    radius=RADIUS,
                )
            )
        # the next crowd is present in the first frame of its first sequence
        early = 0 if crowd else EVERY
        for _ in range(round(PERIOD / STEP) - early):
            simulation.iterate()
    writer.close()
    return path


def measured(path: Path, error: float, seed: int = 0) -> Path:
    """Add normal errors of ``error`` m to each coordinate in the database."""
    rng = np.random.default_rng(seed)
    with closing(sqlite3.connect(path)) as base:
        rows = base.execute("SELECT rowid, pos_x, pos_y FROM trajectory_data").fetchall()
        errors = error * rng.standard_normal((len(rows), 2))
        base.executemany(
            "UPDATE trajectory_data SET pos_x = ?, pos_y = ? WHERE rowid = ?",
            [
                (x + dx, y + dy, i)
                for (i, x, y), (dx, dy) in zip(rows, errors.tolist(), strict=True)
            ],
        )
        base.commit()
    return path


def _positions(people: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Starting points in the left part, at least 0.8 m apart."""
    result: list[np.ndarray] = []
    while len(result) < people:
        position = np.array([rng.uniform(1, 6), rng.uniform(0.5, WIDTH - 0.5)])
        if all(np.linalg.norm(position - other) > 0.8 for other in result):
            result.append(position)
    return result
