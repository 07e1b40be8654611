"""People in a corridor, simulated by JuPedSim."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from types import ModuleType

import numpy as np
import shapely

#: Length and width of the corridor, m.
LONG, WIDE = 12.0, 4.0
#: Of every person: desired speed, m/s, the time to reach it, s, and radius, m.
SPEED, REACTION, RADIUS = 1.3, 0.5, 0.2
#: A crowd starts every AGAIN s, when the one before has left; JuPedSim's steps are STEP s, every
#: EVERY-th is written.
AGAIN, STEP, EVERY = 12.0, 0.01, 10


def crowds(
    jupedsim: ModuleType, path: Path, *, number: int = 18, people: int = 6, seed: int = 0
) -> Path:
    """A database of crowds that start from rest, and walk to the right end of a corridor.

    They have JuPedSim's social force with its own defaults but for the constants above.
    """
    rng = np.random.default_rng(seed)
    writer = jupedsim.SqliteTrajectoryWriter(output_file=path, every_nth_frame=EVERY)
    simulation = jupedsim.Simulation(
        model=jupedsim.SocialForceModel(),
        geometry=shapely.box(0, 0, LONG, WIDE),
        dt=STEP,
        trajectory_writer=writer,
    )
    stage = simulation.add_exit_stage(
        [(LONG - 0.5, 0), (LONG, 0), (LONG, WIDE), (LONG - 0.5, WIDE)]
    )
    journey = simulation.add_journey(jupedsim.JourneyDescription([stage]))
    for crowd in range(number):
        for place in _places(people, rng):
            simulation.add_agent(
                jupedsim.SocialForceModelAgentParameters(
                    position=tuple(place),
                    journey_id=journey,
                    stage_id=stage,
                    desired_speed=SPEED,
                    reaction_time=REACTION,
                    radius=RADIUS,
                )
            )
        # the next ones are there in the frame at which their first sequence begins
        early = 0 if crowd else EVERY
        for _ in range(round(AGAIN / STEP) - early):
            simulation.iterate()
    writer.close()
    return path


def measured(path: Path, error: float, seed: int = 0) -> Path:
    """The database with a normal error of ``error`` m in each coordinate, as a camera has."""
    rng = np.random.default_rng(seed)
    with closing(sqlite3.connect(path)) as base:
        rows = base.execute("SELECT rowid, pos_x, pos_y FROM trajectory_data").fetchall()
        off = error * rng.standard_normal((len(rows), 2))
        base.executemany(
            "UPDATE trajectory_data SET pos_x = ?, pos_y = ? WHERE rowid = ?",
            [
                (x + dx, y + dy, row)
                for (row, x, y), (dx, dy) in zip(rows, off.tolist(), strict=True)
            ],
        )
        base.commit()
    return path


def _places(people: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Starts in the left part, at least 0.8 m apart."""
    result: list[np.ndarray] = []
    while len(result) < people:
        place = np.array([rng.uniform(1, 6), rng.uniform(0.5, WIDE - 0.5)])
        if all(np.linalg.norm(place - other) > 0.8 for other in result):
            result.append(place)
    return result
