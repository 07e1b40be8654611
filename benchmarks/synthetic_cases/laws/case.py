"""Measured platoons whose base law is one of the literature's: a table, and the law's name."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import pandas as pd

from benchmarks.synthetic_cases.laws.motion import FIRST_ORDER, RANGES, STEP, followed
from nnode.errors import ConfigError

#: s: simulated before the recording, so that nobody remembers how he was placed.
WARM = 20.0
#: Standard deviation of drivers' disturbances, m/s² and m/s, and how long they last, s.
PUSH, FIRST_PUSH, LASTS = (0.05, 0.3), (0.1, 0.4), (1.0, 5.0)
#: Errors of measured places, m; half of the cases have errors that last for this long, s.
ERROR, ERROR_LASTS = (0.02, 0.3), 1.0


@dataclass(frozen=True)
class LawCase:
    """One world of a law; equal cases give equal tables.

    Attributes:
        law: see :data:`benchmarks.synthetic_cases.laws.motion.RANGES`.
        seed: of everything random.
        sequences, vehicles, seconds, dt: platoons, their vehicles with the leader, their length
            and sampling interval.
    """

    law: str
    seed: int
    sequences: int = 40
    vehicles: int = 5
    seconds: float = 30.0
    dt: float = 0.2

    def __post_init__(self) -> None:
        if self.law not in RANGES:
            raise ConfigError(f"law={self.law} is unknown, expected one of {', '.join(RANGES)}")

    @property
    def key(self) -> str:
        """Unique among cases of one size."""
        return f"{self.law}-s{self.seed}"


def measured(case: LawCase) -> tuple[pd.DataFrame, dict[str, float]]:
    """The table (sequence, time, agent, x, length) and the law's parameters."""
    digest = hashlib.sha256(f"{case.law} {case.seed}".encode()).digest()
    rng = np.random.default_rng(list(digest))
    p = {name: float(rng.uniform(*ends)) for name, ends in RANGES[case.law].items()}
    size = rng.uniform(*(FIRST_PUSH if case.law in FIRST_ORDER else PUSH))
    lasts, error = rng.uniform(*LASTS), rng.uniform(*ERROR)
    keep = np.exp(-case.dt / ERROR_LASTS) if rng.random() < 0.5 else 0.0
    fastest = 0.85 * p.get("v0", 30.0) * (1 if case.law != "log" else 1.5)
    every, steps = round(case.dt / STEP), round((WARM + case.seconds) / STEP) + 1
    tables = []
    for s in range(case.sequences):
        length = rng.uniform(4.0, 5.5, case.vehicles)
        lead = _leader(rng, steps, fastest)
        push = _fading(rng, (steps, case.vehicles - 1), np.exp(-STEP / lasts), size)
        x = followed(case.law, p, lead, length, push)[round(WARM / STEP) :: every]
        x = x - x[0, -1] + _fading(rng, x.shape, keep, error)
        k, n = (axis.ravel() for axis in np.indices(x.shape))
        tables.append(
            pd.DataFrame(
                {
                    "sequence": f"s{s:03d}",
                    "time": 1000.0 * s + case.dt * k,
                    "agent": [f"{s}-{i}" for i in n],
                    "x": x.ravel(),
                    "length": length[n],
                }
            )
        )
    return pd.concat(tables, ignore_index=True), p


def accelerations(rng: np.random.Generator, steps: int, step: float) -> list[float]:
    """Of a leader, m/s², at least so many: for 2 to 7 s each it keeps its speed, speeds up or
    brakes."""
    found: list[float] = []
    while len(found) < steps:
        rate = rng.choice([0.0, rng.uniform(0.3, 1.2), -rng.uniform(0.3, 2.0)])
        found += [float(rate)] * round(rng.uniform(2, 7) / step)
    return found


def _leader(rng: np.random.Generator, steps: int, fastest: float) -> np.ndarray:
    """``(K,)`` place, m: it accelerates and brakes for some seconds each."""
    rates = accelerations(rng, steps, STEP)
    speed = [float(rng.uniform(0.3, 0.9) * fastest)]
    for rate in rates[: steps - 1]:
        speed.append(min(max(speed[-1] + STEP * rate, 0.0), fastest))
    found: np.ndarray = np.concatenate([[0.0], np.cumsum(speed[:-1])]) * STEP
    return found


def _fading(
    rng: np.random.Generator, shape: tuple[int, ...], keep: float, size: float
) -> np.ndarray:
    """Noise of a standard deviation, of which a step keeps a share."""
    found = size * rng.normal(size=shape)
    for k in range(1, shape[0]):
        found[k] = keep * found[k - 1] + np.sqrt(1 - keep**2) * found[k]
    return found
