"""Platoons with a hidden slow zone, drivers who differ and noise, as a table with one row per car
and sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

#: Time between two platoons, s: no car is seen in two of them.
_PAUSE = 60.0
#: Time that a platoon drives before it is measured, s.
_BEFORE = 15.0
#: Step of the integration, s.
_STEP = 0.02


@dataclass(frozen=True, kw_only=True)
class SlowZone:
    """What the cars do: speed v0 (1 - L/gap), times alpha between a and b.

    Attributes:
        v0: m/s. L: m. alpha: 1.
        a, b: positions along the lane, m.
        drivers: standard deviation of the drivers' own v0, as a share of v0.
        noise: standard deviation of the measured positions, m.
    """

    v0: float = 28.0
    L: float = 6.0
    alpha: float = 0.65
    a: float = 350.0
    b: float = 450.0
    drivers: float = 0.05
    noise: float = 0.1


def platoon_table(
    path: Path | str,
    *,
    seed: int,
    truth: SlowZone | None = None,
    platoons: int = 30,
    cars: int = 5,
    duration: float = 25.0,
    dt: float = 0.2,
) -> Path:
    """Simulate independent platoons on one stretch of road and write them as CSV.

    The last car of a platoon leads: its desired speed is a sum of sines around 17 m/s. Every car
    drives slower in the zone, the leaders as well.

    Args:
        path: the file; folders are created.
        seed: the same seed gives the same bytes.
        truth: parameters; None takes the defaults of :class:`SlowZone`.
        platoons: their number.
        cars: of each platoon.
        duration: of each platoon's measurement, s.
        dt: sampling interval, s.

    Returns:
        The path: columns sequence, time (s), agent, x (m).

    Source: Göttlich & Totzeck, equation (LWR), with a zone and drivers added.
    """
    truth = truth or SlowZone()
    rng = np.random.default_rng(seed)
    desired = truth.v0 * (1 + truth.drivers * rng.standard_normal((platoons, cars - 1)))
    height = rng.uniform(0.8, 2.0, (4, platoons))
    period, phase = rng.uniform(8, 30, (4, platoons)), rng.uniform(0, 2 * np.pi, (4, platoons))

    def slowed(x: np.ndarray) -> np.ndarray:
        return np.where((truth.a <= x) & (x <= truth.b), truth.alpha, 1.0)

    def leader(t: float) -> np.ndarray:
        speeds: np.ndarray = 17 + (height * np.sin(2 * np.pi * t / period + phase)).sum(0)
        return speeds

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        speeds = np.column_stack([desired * (1 - truth.L / np.diff(x)), leader(t)])
        return slowed(x) * speeds

    gap = truth.L * desired / (desired - leader(0.0)[:, None])
    behind = np.cumsum(gap[:, ::-1], 1)[:, ::-1]
    front = rng.uniform(-150, 150, platoons)[:, None]
    x = np.column_stack([front - behind, front])
    every, first = round(dt / _STEP), round(_BEFORE / _STEP)
    rows = []
    for k in range(first + round(duration / dt) * every + 1):
        if k >= first and (k - first) % every == 0:
            rows.append(x)
        x = _advanced(rates, k * _STEP, x)
    measured = np.stack(rows)
    measured = measured + truth.noise * rng.standard_normal(measured.shape)
    samples = len(measured)
    clock = dt * np.arange(samples) + (duration + _PAUSE) * np.arange(platoons)[:, None]
    # each car of the whole table has a number of its own
    agent = 1 + np.arange(platoons * cars).reshape(platoons, cars)
    table = pd.DataFrame(
        {
            "sequence": np.repeat(np.arange(1, platoons + 1), samples * cars),
            "time": np.repeat(clock.round(6), cars),
            "agent": np.tile(agent, samples).ravel(),
            "x": measured.transpose(1, 0, 2).ravel().round(3),
        }
    )
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(table.to_csv(index=False, lineterminator="\n").encode("ascii"))
    return path


def _advanced(
    rates: Callable[[float, np.ndarray], np.ndarray], t: float, x: np.ndarray
) -> np.ndarray:
    """Positions after a step by the classical method of Runge and Kutta."""
    h = _STEP
    k1 = rates(t, x)
    k2 = rates(t + h / 2, x + h / 2 * k1)
    k3 = rates(t + h / 2, x + h / 2 * k2)
    k4 = rates(t + h, x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
