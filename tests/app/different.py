"""Different drivers with random accelerations, simulated without the package."""

from __future__ import annotations

import numpy as np
import pandas as pd

#: The IDM's median driver: v0 (m/s), T (s), s0 (m), a and b (m/s²).
TRUE = {"v0": 32.0, "T": 1.4, "s0": 2.0, "a": 1.2, "b": 1.8}
#: Random acceleration: standard deviation (m/s²) and correlation time (s). Vehicle length (m).
PUSH, PUSH_TIME, LENGTH = 0.1, 4.0, 4.5
#: Step of the simulation and sampling interval (s).
STEP, DT = 0.02, 0.2


def table(
    seed: int,
    *,
    platoons: int,
    cars: int,
    seconds: float,
    noise: float,
    differ: dict[str, float],
) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """A tidy table of positions, and ``(platoons, cars - 1)`` drivers' values of each parameter.

    Heun's method. Leaders' speeds are sums of two waves around a mean of 8 to 22 m/s.

    Args:
        noise: standard deviation of measurement errors of positions, m.
        differ: standard deviations between drivers of the parameters' logarithms.
    """
    rng, shape = np.random.default_rng([32, seed]), (platoons, cars - 1)
    values = {
        name: value * np.exp(differ.get(name, 0.0) * rng.normal(size=shape))
        for name, value in TRUE.items()
    }
    mean, amplitude = rng.uniform(8, 22, platoons), rng.uniform(2, 5, (platoons, 2))
    period = rng.uniform([9, 25], [18, 50], (platoons, 2))
    phase = rng.uniform(0, 2 * np.pi, (platoons, 2))

    def leader(t: float) -> np.ndarray:
        waves = amplitude * np.sin(2 * np.pi * t / period + phase)
        return np.asarray(np.maximum(mean + waves.sum(1), 0.0)[:, None])

    def force(x: np.ndarray, v: np.ndarray, push: np.ndarray) -> np.ndarray:
        gap, u = np.maximum(-np.diff(x) - LENGTH, 0.1), v[:, 1:]
        closing = u * np.diff(v) / (2 * np.sqrt(values["a"] * values["b"]))
        desired_gap = values["s0"] + np.maximum(u * values["T"] + closing, 0.0)
        result = values["a"] * (1 - (u / values["v0"]) ** 4 - (desired_gap / gap) ** 2) + push
        return np.asarray(result)

    first = np.minimum(leader(0.0), 0.8 * values["v0"].min(1)[:, None])
    equilibrium = (values["s0"] + first * values["T"]) / np.sqrt(1 - (first / values["v0"]) ** 4)
    behind = np.cumsum(equilibrium * rng.uniform(0.9, 1.2, shape) + LENGTH, 1)
    x = np.concatenate([np.zeros((platoons, 1)), -behind], 1)
    v = np.concatenate([leader(0.0), np.repeat(first, cars - 1, 1)], 1)
    push, keep, paths = PUSH * rng.normal(size=shape), np.exp(-STEP / PUSH_TIME), []
    for k in range(round(seconds / STEP) + 1):
        if k % round(DT / STEP) == 0:
            paths.append(x + noise * rng.normal(size=x.shape))
        acceleration, lead = force(x, v, push), leader((k + 1) * STEP)
        predicted = np.concatenate([lead, np.maximum(v[:, 1:] + STEP * acceleration, 0.0)], 1)
        push = keep * push + PUSH * np.sqrt(1 - keep**2) * rng.normal(size=shape)
        corrected = force(x + STEP * (v + predicted) / 2, predicted, push)
        speed = np.maximum(v[:, 1:] + STEP * (acceleration + corrected) / 2, 0.0)
        new = np.concatenate([lead, speed], 1)
        x, v = x + STEP * (v + new) / 2, new
    samples, platoon, vehicle = np.meshgrid(
        np.arange(len(paths)), np.arange(platoons), np.arange(cars), indexing="ij"
    )
    result = pd.DataFrame(
        {
            "sequence": platoon.ravel(),
            "time": (DT * samples).ravel().round(6),
            "agent": (10 * platoon + vehicle).ravel(),
            "x": np.array(paths).ravel(),
            "length": LENGTH,
        }
    )
    return result, values
