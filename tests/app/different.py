"""Drivers who differ and are disturbed, simulated here without the package."""

from __future__ import annotations

import numpy as np
import pandas as pd

#: The median driver of Treiber, Hennecke & Helbing's model: v0 m/s, T s, s0 m, a and b m/s².
TRUE = {"v0": 32.0, "T": 1.4, "s0": 2.0, "a": 1.2, "b": 1.8}
#: Standard deviation of pushes, m/s², the time that they last, s; length, m.
PUSH, LASTING, LONG = 0.1, 4.0, 4.5
#: Step of the simulation and sampling interval, s.
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
    """A tidy table of positions, and of each parameter what ``(platoons, cars - 1)`` drivers have.

    Steps are Heun's. Speeds of leaders are sums of two waves around 8 to 22 m/s.

    Args:
        noise: standard deviation of errors of measured positions, m.
        differ: standard deviations of logarithms of parameters between drivers.
    """
    rng, shape = np.random.default_rng([32, seed]), (platoons, cars - 1)
    own = {
        name: value * np.exp(differ.get(name, 0.0) * rng.normal(size=shape))
        for name, value in TRUE.items()
    }
    mean, high = rng.uniform(8, 22, platoons), rng.uniform(2, 5, (platoons, 2))
    period = rng.uniform([9, 25], [18, 50], (platoons, 2))
    phase = rng.uniform(0, 2 * np.pi, (platoons, 2))

    def leader(t: float) -> np.ndarray:
        waves = high * np.sin(2 * np.pi * t / period + phase)
        return np.asarray(np.maximum(mean + waves.sum(1), 0.0)[:, None])

    def force(x: np.ndarray, v: np.ndarray, push: np.ndarray) -> np.ndarray:
        gap, u = np.maximum(-np.diff(x) - LONG, 0.1), v[:, 1:]
        closing = u * np.diff(v) / (2 * np.sqrt(own["a"] * own["b"]))
        wish = own["s0"] + np.maximum(u * own["T"] + closing, 0.0)
        result = own["a"] * (1 - (u / own["v0"]) ** 4 - (wish / gap) ** 2) + push
        return np.asarray(result)

    first = np.minimum(leader(0.0), 0.8 * own["v0"].min(1)[:, None])
    at_rest = (own["s0"] + first * own["T"]) / np.sqrt(1 - (first / own["v0"]) ** 4)
    behind = np.cumsum(at_rest * rng.uniform(0.9, 1.2, shape) + LONG, 1)
    x = np.concatenate([np.zeros((platoons, 1)), -behind], 1)
    v = np.concatenate([leader(0.0), np.repeat(first, cars - 1, 1)], 1)
    push, keep, paths = PUSH * rng.normal(size=shape), np.exp(-STEP / LASTING), []
    for k in range(round(seconds / STEP) + 1):
        if k % round(DT / STEP) == 0:
            paths.append(x + noise * rng.normal(size=x.shape))
        slope, ahead = force(x, v, push), leader((k + 1) * STEP)
        guess = np.concatenate([ahead, np.maximum(v[:, 1:] + STEP * slope, 0.0)], 1)
        push = keep * push + PUSH * np.sqrt(1 - keep**2) * rng.normal(size=shape)
        then = force(x + STEP * (v + guess) / 2, guess, push)
        speed = np.maximum(v[:, 1:] + STEP * (slope + then) / 2, 0.0)
        new = np.concatenate([ahead, speed], 1)
        x, v = x + STEP * (v + new) / 2, new
    samples, platoon, place = np.meshgrid(
        np.arange(len(paths)), np.arange(platoons), np.arange(cars), indexing="ij"
    )
    result = pd.DataFrame(
        {
            "sequence": platoon.ravel(),
            "time": (DT * samples).ravel().round(6),
            "agent": (10 * platoon + place).ravel(),
            "x": np.array(paths).ravel(),
            "length": LONG,
        }
    )
    return result, own
