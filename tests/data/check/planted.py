"""Correct tables of cars and people, to plant faults in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd


def cars(number: int = 12, seconds: float = 40.0, dt: float = 0.1) -> pd.DataFrame:
    """Cars of 4.2 m to 4.9 m in one lane at 10 m/s to 14 m/s, in SI units, sorted by vehicle."""
    time = dt * np.arange(round(seconds / dt) + 1)
    parts = []
    for i in range(number):
        phase = 0.4 * i
        v = 12 + 1.5 * np.sin(0.3 * time + phase)
        x = 26.0 * (number - i) + 12 * time - 5 * (np.cos(0.3 * time + phase) - np.cos(phase))
        parts.append(
            pd.DataFrame(
                {"veh": i, "t": time.round(6), "x": x, "v": v, "length": 4.2 + 0.06 * i, "lane": 1}
            )
        )
    return pd.concat(parts, ignore_index=True)


def people(
    number: int = 40, rate: float = 16.0, length: float = 12.0, sway: float = 0.95
) -> pd.DataFrame:
    """People who walk through a corridor in both directions and sway; m, s, m/s."""
    rng = np.random.default_rng(4)
    parts = []
    for i in range(number):
        first_frame = round(rate * 1.5 * i)
        direction = 1.0 if i % 2 else -1.0
        speed = 1.3 + 0.15 * rng.standard_normal()
        k = np.arange(round(rate * length / speed))
        time = k / rate
        omega, phase = 2 * np.pi * sway, rng.uniform(0, 6)
        x = direction * (speed * time - length / 2) + 0.004 * rng.standard_normal(len(k))
        y = 0.5 + (3 * i % 4) * 0.9 + 0.03 * np.sin(omega * time + phase)
        y += 0.004 * rng.standard_normal(len(k))
        parts.append(
            pd.DataFrame(
                {
                    "id": i + 1,
                    "frame": first_frame + k,
                    "x": x,
                    "y": y,
                    "vx": direction * speed,
                    "vy": 0.03 * omega * np.cos(omega * time + phase),
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def saved(table: pd.DataFrame, folder: Path, name: str = "table.csv") -> Path:
    """Write a table as CSV."""
    path = folder / name
    table.to_csv(path, index=False)
    return path


def text(table: pd.DataFrame, folder: Path, head: str = "", scale: float = 1.0) -> Path:
    """Write people as text with the columns ``id frame x y z``."""
    path = folder / "people.txt"
    rows = table.assign(x=scale * table["x"], y=scale * table["y"], z=0.0)
    body = rows[["id", "frame", "x", "y", "z"]].to_csv(sep=" ", header=False, index=False)
    path.write_text(head + body)
    return path
