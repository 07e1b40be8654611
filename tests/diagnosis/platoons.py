"""Small platoons with known effects, simulated without the package, and their model.

The simulation is Runge and Kutta's method at a fifth of the sampling interval.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from nnode.data.sequence import Sequence
from nnode.model import System
from nnode.model.build import add_effects, build_model
from tests import builders

V0, LENGTH, DT, SUBSTEPS = 28.0, 6.0, 0.2, 5

#: Followers' speeds as a function of positions ``(S, N)``, the law's speeds ``(S, N - 1)`` and the
#: leaders' speeds ``(S,)``.
Effect = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def lin(*effects: dict[str, Any], v0: float = V0, length: float = LENGTH) -> System:
    """The law of the followers, with effects."""
    options = {"leader": "measured", "v0": v0, "L": length, "L_min": 1.0}
    system = build_model({"term": "lin", "name": "lin", **options})
    add_effects(system, list(effects))
    return system


def law(gap: np.ndarray) -> np.ndarray:
    return np.asarray(V0 * (1 - LENGTH / gap))


def _leader(
    rng: np.random.Generator, time: np.ndarray, calm: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    waves = [
        (calm * rng.uniform(0.8, 2.0), rng.uniform(8, 30), rng.uniform(0, 6)) for _ in range(4)
    ]
    speed = 17 + sum(a * np.sin(2 * np.pi * time / p + q) for a, p, q in waves)
    step = time[1] - time[0]
    place = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2) * step])
    return place, speed


def _start(lead: np.ndarray, speed: np.ndarray, followers: int) -> np.ndarray:
    """``(S, N - 1)`` positions of followers in equilibrium."""
    gap = LENGTH * V0 / (V0 - speed)
    return np.asarray(lead[:, None] - gap[:, None] * np.arange(followers, 0, -1.0))


def _sequences(places: np.ndarray) -> list[Sequence]:
    """One sequence every 100 s, each with its own vehicles, from positions ``(K, S, N)``."""
    sequences = []
    for s, x in enumerate(places.swapaxes(0, 1)):
        agents = tuple(f"{s}-{i}" for i in range(x.shape[1]))
        sequences.append(builders.lane(x, DT, start=100.0 * s, name=f"r/{s}", agents=agents))
    return sequences


def platoons(
    effect: Effect | None = None,
    *,
    number: int = 10,
    vehicles: int = 5,
    seconds: float = 20.0,
    noise: float = 0.02,
    driver: float = 0.0,
    lasts: float = 3.0,
    calm: float = 1.0,
    seed: int = 0,
) -> list[Sequence]:
    """Platoons behind leaders of varying speed.

    Args:
        number: of platoons; a larger one adds platoons and changes none.
        noise: standard deviation of measured positions, m.
        driver, lasts: standard deviation (m/s) and correlation time (s) of an Ornstein-Uhlenbeck
            disturbance of each follower's speed.
        calm: factor of the variation of the leaders' speeds.
    """
    rng = np.random.default_rng(seed)
    half = DT / SUBSTEPS / 2  # the leaders' positions are computed at half steps
    samples, warm = round(seconds / DT) + 1, round(15 / DT)
    steps = SUBSTEPS * (samples + warm)
    time = half * np.arange(2 * steps + 2)
    leaders, shocks, errors = [], [], []
    for _ in range(number):
        leaders.append(_leader(rng, time, calm))
        shocks.append(driver * rng.normal(size=(steps + 1, vehicles - 1)))
        errors.append(noise * rng.normal(size=(samples, vehicles)))
    lead, speed = np.array(leaders).transpose(1, 2, 0)
    shock = np.stack(shocks, 1)
    keep = np.exp(-2 * half / lasts)

    def rate(x: np.ndarray, i: int, push: np.ndarray) -> np.ndarray:
        positions = np.column_stack([x, lead[i]])
        speeds = law(np.diff(positions))
        return push + (speeds if effect is None else effect(positions, speeds, speed[i]))

    x, push, rows = _start(lead[0], speed[0], vehicles - 1), shock[0], []
    for step in range(steps):
        i = 2 * step
        if step % SUBSTEPS == 0:
            rows.append(np.column_stack([x, lead[i]]))
        k1 = rate(x, i, push)
        k2 = rate(x + half * k1, i + 1, push)
        k3 = rate(x + half * k2, i + 1, push)
        k4 = rate(x + 2 * half * k3, i + 2, push)
        x = x + 2 * half / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        push = keep * push + np.sqrt(1 - keep**2) * shock[step + 1]
    return _sequences(np.array(rows[warm:]) + np.stack(errors, 1))


def streams(
    *, number: int = 8, vehicles: int = 5, window: float = 10.0, pace: float = 0.0, **options: Any
) -> list[Sequence]:
    """Long platoons, cut into windows of ``window`` s with the same agents and clock.

    Args:
        pace: standard deviation of the drivers' relative speeds.
        options: of :func:`platoons`.
    """
    draw = np.random.default_rng((options.get("seed", 0), 1))
    paces = 1 + pace * draw.normal(size=(number, vehicles - 1))
    whole = platoons(lambda x, law, lead: paces * law, number=number, vehicles=vehicles, **options)
    size = round(window / DT)
    return [
        replace(
            sequence,
            name=f"{sequence.name}-{first // size}",
            time=sequence.time[first : first + size + 1],
            x=sequence.x[first : first + size + 1],
            kind=("car", "truck", *["car"] * (vehicles - 2)),
        )
        for sequence in whole
        for first in range(0, sequence.n_samples - size, size)
    ]


def relative_speed(kappa: float) -> Effect:
    """W + kappa (speed ahead - W)."""

    def effect(x: np.ndarray, law: np.ndarray, lead: np.ndarray) -> np.ndarray:
        ahead, speeds = lead, np.empty_like(law)
        for i in range(law.shape[-1] - 1, -1, -1):
            ahead = speeds[:, i] = law[:, i] + kappa * (ahead - law[:, i])
        return speeds

    return effect


def delayed(delay: float, number: int = 4, seconds: float = 20.0) -> list[Sequence]:
    """Platoons of three with a reaction delay, simulated by small Euler steps."""
    rng = np.random.default_rng(3)
    every = 200
    step = DT / every
    lag, warm = round(delay / step), round(20 / DT)
    time = step * np.arange((round(seconds / DT) + 1 + warm) * every)
    lead, speed = np.array([_leader(rng, time) for _ in range(number)]).transpose(1, 2, 0)
    x = np.empty((len(time), number, 3))
    x[:, :, 2] = lead
    x[: lag + 1, :, :2] = _start(lead[0], speed[0], 2) + (lead - lead[0])[: lag + 1, :, None]
    for k in range(lag, len(time) - 1):
        x[k + 1, :, :2] = x[k, :, :2] + step * law(np.diff(x[k - lag]))
    return _sequences(x[warm * every :: every])
