"""Vehicles that follow a known IDM, simulated without the package."""

from __future__ import annotations

import numpy as np
import pandas as pd

#: The true parameters: v0 (m/s), T (s), s0 (m), a and b (m/s²).
TRUE = {"v0": 30.0, "T": 1.2, "s0": 2.2, "a": 1.3, "b": 1.9}
#: Vehicle length (m) and time step (s).
LENGTH, STEP = 4.5, 0.1


def idm(
    v: np.ndarray, s: np.ndarray, closing: np.ndarray, v0: float | np.ndarray = TRUE["v0"]
) -> np.ndarray:
    """The acceleration: Treiber, Hennecke & Helbing 2000, equations (2) and (3)."""
    p = TRUE
    desired_gap = p["s0"] + np.maximum(v * p["T"] + v * closing / (2 * np.sqrt(p["a"] * p["b"])), 0)
    return p["a"] * (1 - (v / v0) ** 4 - (desired_gap / s) ** 2)


def platoon(rng: np.random.Generator, cars: int, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """``(K, N)`` front positions (m) and speeds (m/s) in ballistic steps; the leader is last."""
    phase, mean, amplitude = rng.uniform(0, 6), rng.uniform(12, 22), rng.uniform(4, 8)
    x = np.cumsum([0.0, *rng.uniform(22, 40, cars - 1)])
    v = np.full(cars, mean + amplitude * np.cos(phase))
    positions, speeds = [x], [v]
    for k in range(round(seconds / STEP)):
        lead = mean + amplitude * np.cos(0.35 * STEP * (k + 1) + phase)
        force = idm(v[:-1], np.diff(x) - LENGTH, -np.diff(v))
        new = np.append(v[:-1] + STEP * force, lead)
        x, v = x + STEP * (v + new) / 2, new
        positions.append(x)
        speeds.append(v)
    return np.array(positions), np.array(speeds)


def table(platoons: int, seconds: float, cars: int = 3, seed: int = 0) -> pd.DataFrame:
    """A tidy table; sequences and vehicles have integer names."""
    rng, rows = np.random.default_rng(seed), []
    for number in range(platoons):
        x, _ = platoon(rng, cars, seconds)
        for k, positions in enumerate(x):
            for i, position in enumerate(positions):
                rows.append((number, round(STEP * k, 9), 10 * number + i, position, LENGTH))
    return pd.DataFrame(rows, columns=["sequence", "time", "agent", "x", "length"])


def pairs(number: int, seconds: float, seed: int = 0) -> pd.DataFrame:
    """A table of leader-follower pairs with measured speeds."""
    rng, tables = np.random.default_rng(seed), []
    for pair in range(number):
        x, v = platoon(rng, 2, seconds)
        tables.append(
            pd.DataFrame(
                {
                    "pair": f"p{pair}",
                    "time": STEP * np.arange(len(x)),
                    "x_follower": x[:, 0],
                    "x_leader": x[:, 1],
                    "v_follower": v[:, 0],
                    "v_leader": v[:, 1],
                    "leader_length": LENGTH,
                    "follower_length": LENGTH,
                    "follower": f"f{pair}",
                    "leader": f"l{pair}",
                }
            )
        )
    return pd.concat(tables, ignore_index=True)
