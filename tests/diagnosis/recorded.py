"""Made-up measurements with a known cause, simulated without the package's models and solvers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

#: What the lane's law is, and the zone in which everyone drives slower.
V0, L, ALPHA, ZONE = 27.0, 6.0, 0.65, (400.0, 600.0)

#: Strength of the repulsion between people, N.
PUSH = 60.0

#: What pushes everyone in the corridor, m/s².
WIND = (0.0, 0.35)

WALLS = np.array([[-6.0, 0.0, 6.0, 0.0], [6.0, 4.0, -6.0, 4.0]])


def lane(
    path: Path, *, sequences: int = 20, seconds: float = 30.0, cars: int = 8, seed: int = 0
) -> Path:
    """A tidy table of platoons behind a leader of varying speed that pass a slow zone."""
    rng = np.random.default_rng(seed)
    dt, h = 0.2, 0.02
    parts = []
    for number in range(sequences):
        phase, depth = rng.uniform(0, 6.28), rng.uniform(1, 4)
        x = rng.uniform(0, 500) + np.concatenate([[0], np.cumsum(rng.uniform(16, 32, cars - 1))])
        kept = []
        steps = round(seconds / dt)
        per = round(dt / h)
        for k in range(steps * per + 1):
            if k % per == 0:
                kept.append(x.copy())
            t = k * h
            speed = V0 * (1 - L / np.diff(x))
            inside = (x[:-1] > ZONE[0]) & (x[:-1] < ZONE[1])
            lead = 18 + depth * np.sin(0.4 * t + phase)
            x = x + h * np.append(np.where(inside, ALPHA, 1.0) * speed, lead)
        found = np.array(kept) + 0.05 * rng.standard_normal((steps + 1, cars))
        time = 40.0 * number + dt * np.arange(steps + 1)
        parts.append(
            pd.DataFrame(
                {
                    "sequence": number,
                    "time": np.repeat(time, cars).round(6),
                    "agent": np.tile([f"v{number}-{i}" for i in range(cars)], len(time)),
                    "x": found.ravel(),
                }
            )
        )
    return _write(path, parts)


def corridor(
    path: Path, *, sequences: int = 20, seconds: float = 6.0, people: int = 16, seed: int = 0
) -> tuple[Path, Path]:
    """A tidy table of people walking both ways in a wind across, and the walls' table."""
    rng = np.random.default_rng(seed)
    dt, h = 0.1, 0.02
    parts = []
    for number in range(sequences):
        way = np.where(np.arange(people) % 2, 1.0, -1.0)
        x = _places(way, rng)
        speed = rng.uniform(0.9, 1.5, people)
        v = np.stack([way * speed, np.zeros(people)], 1)
        goal = np.stack([40 * way, x[:, 1]], 1)
        kept = []
        steps = round(seconds / dt)
        for k in range(steps * 5 + 1):
            if k % 5 == 0:
                kept.append(x.copy())
            to = goal - x
            wish = to / np.linalg.norm(to, axis=1)[:, None] * np.linalg.norm(v, axis=1)[:, None]
            away = x[:, None] - x[None]
            d = np.linalg.norm(away, axis=2) + np.eye(people) * 1e3
            push = (PUSH * np.exp((0.5 - d) / 0.3) / d)[..., None] * away
            a = (wish - v) / 0.5 + push.sum(1) / people + np.array(WIND)
            x, v = x + h * v, v + h * a
        found = np.array(kept) + 0.01 * rng.standard_normal((steps + 1, people, 2))
        time = 10.0 * number + dt * np.arange(steps + 1)
        parts.append(
            pd.DataFrame(
                {
                    "sequence": number,
                    "time": np.repeat(time, people).round(6),
                    "agent": np.tile([f"p{number}-{i}" for i in range(people)], len(time)),
                    "x": found[..., 0].ravel(),
                    "y": found[..., 1].ravel(),
                    "dest_x": np.tile(goal[:, 0], len(time)),
                    "dest_y": np.tile(goal[:, 1], len(time)),
                }
            )
        )
    walls = path.with_name("walls.csv")
    pd.DataFrame(WALLS, columns=["x1", "y1", "x2", "y2"]).to_csv(walls, index=False)
    return _write(path, parts), walls


def _places(way: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Where people start who walk to the right (1) or left (-1), at least 0.7 m apart."""
    found: list[np.ndarray] = []
    for side in way:
        while True:
            new = np.array([-side * rng.uniform(0, 5), rng.uniform(0.6, 3.4)])
            if all(np.linalg.norm(new - old) > 0.7 for old in found):
                break
        found.append(new)
    return np.array(found)


def _write(path: Path, parts: list[pd.DataFrame]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.concat(parts).to_csv(path, index=False)
    return path
