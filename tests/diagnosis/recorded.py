"""Tables of data with known effects, simulated without the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

#: Parameters of the lane's law, and the zone of low speed.
V0, L, ALPHA, ZONE = 27.0, 6.0, 0.65, (400.0, 600.0)

#: Strength of the repulsion between people, N.
PUSH = 60.0

#: Acceleration of all people in the corridor, m/s².
WIND = (0.0, 0.35)

WALLS = np.array([[-6.0, 0.0, 6.0, 0.0], [6.0, 4.0, -6.0, 4.0]])


def lane(
    path: Path, *, sequences: int = 20, seconds: float = 30.0, cars: int = 8, seed: int = 0
) -> Path:
    """A tidy table of platoons behind leaders of varying speed that pass a zone of low speed."""
    rng = np.random.default_rng(seed)
    dt, h = 0.2, 0.02
    parts = []
    for number in range(sequences):
        phase, depth = rng.uniform(0, 6.28), rng.uniform(1, 4)
        x = rng.uniform(0, 500) + np.concatenate([[0], np.cumsum(rng.uniform(16, 32, cars - 1))])
        samples = []
        steps = round(seconds / dt)
        per = round(dt / h)
        for k in range(steps * per + 1):
            if k % per == 0:
                samples.append(x.copy())
            t = k * h
            speed = V0 * (1 - L / np.diff(x))
            inside = (x[:-1] > ZONE[0]) & (x[:-1] < ZONE[1])
            lead = 18 + depth * np.sin(0.4 * t + phase)
            x = x + h * np.append(np.where(inside, ALPHA, 1.0) * speed, lead)
        measured = np.array(samples) + 0.05 * rng.standard_normal((steps + 1, cars))
        time = 40.0 * number + dt * np.arange(steps + 1)
        parts.append(
            pd.DataFrame(
                {
                    "sequence": number,
                    "time": np.repeat(time, cars).round(6),
                    "agent": np.tile([f"v{number}-{i}" for i in range(cars)], len(time)),
                    "x": measured.ravel(),
                }
            )
        )
    return _write(path, parts)


def corridor(
    path: Path, *, sequences: int = 20, seconds: float = 6.0, people: int = 16, seed: int = 0
) -> tuple[Path, Path]:
    """Tidy tables of people who walk both ways with a lateral acceleration, and of walls."""
    rng = np.random.default_rng(seed)
    dt, h = 0.1, 0.02
    parts = []
    for number in range(sequences):
        sign = np.where(np.arange(people) % 2, 1.0, -1.0)
        x = _starts(sign, rng)
        speed = rng.uniform(0.9, 1.5, people)
        v = np.stack([sign * speed, np.zeros(people)], 1)
        goal = np.stack([40 * sign, x[:, 1]], 1)
        samples = []
        steps = round(seconds / dt)
        for k in range(steps * 5 + 1):
            if k % 5 == 0:
                samples.append(x.copy())
            to = goal - x
            desired = to / np.linalg.norm(to, axis=1)[:, None] * np.linalg.norm(v, axis=1)[:, None]
            dx = x[:, None] - x[None]
            d = np.linalg.norm(dx, axis=2) + np.eye(people) * 1e3
            push = (PUSH * np.exp((0.5 - d) / 0.3) / d)[..., None] * dx
            a = (desired - v) / 0.5 + push.sum(1) / people + np.array(WIND)
            x, v = x + h * v, v + h * a
        measured = np.array(samples) + 0.01 * rng.standard_normal((steps + 1, people, 2))
        time = 10.0 * number + dt * np.arange(steps + 1)
        parts.append(
            pd.DataFrame(
                {
                    "sequence": number,
                    "time": np.repeat(time, people).round(6),
                    "agent": np.tile([f"p{number}-{i}" for i in range(people)], len(time)),
                    "x": measured[..., 0].ravel(),
                    "y": measured[..., 1].ravel(),
                    "dest_x": np.tile(goal[:, 0], len(time)),
                    "dest_y": np.tile(goal[:, 1], len(time)),
                }
            )
        )
    walls = path.with_name("walls.csv")
    pd.DataFrame(WALLS, columns=["x1", "y1", "x2", "y2"]).to_csv(walls, index=False)
    return _write(path, parts), walls


def _starts(sign: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Positions of people who walk to the right (1) or left (-1), at least 0.7 m apart."""
    starts: list[np.ndarray] = []
    for side in sign:
        while True:
            new = np.array([-side * rng.uniform(0, 5), rng.uniform(0.6, 3.4)])
            if all(np.linalg.norm(new - old) > 0.7 for old in starts):
                break
        starts.append(new)
    return np.array(starts)


def _write(path: Path, parts: list[pd.DataFrame]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.concat(parts).to_csv(path, index=False)
    return path
