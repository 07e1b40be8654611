"""Small scenes that the solvers' tests share."""

from __future__ import annotations

import numpy as np

from nnode.data.sequence import Sequence
from tests.builders import lane, straight


def platoon(
    gaps: list[float],
    speed: float = 15.0,
    samples: int = 6,
    dt: float = 0.2,
    name: str = "p",
    start: float = 12.0,
    noise: float = 0.3,
) -> Sequence:
    """A platoon with gaps (m) from the last vehicle on, at a speed (m/s); slightly noisy."""
    x = start + np.concatenate([[0.0], np.cumsum(gaps)])[None]
    x = x + speed * (dt * np.arange(samples))[:, None]
    draw = np.random.default_rng(len(gaps) + 10 * samples)
    # nothing may depend on a noise of the start: only later samples are disturbed
    x[1:] += noise * draw.standard_normal(x[1:].shape)
    return lane(x, dt, start=3.0, name=name, recording="r")


def crowd(
    n: int, samples: int = 5, dt: float = 0.2, apart: float = 0.42, name: str = "c"
) -> Sequence:
    """People in a corridor, 0 <= y <= 3; neighbours are ``apart`` (m) from each other."""
    x = np.stack([apart * np.arange(n), 0.2 + 0.01 * np.arange(n) ** 2], 1)
    v = np.array([1.3, 0.1]) + 0.1 * np.random.default_rng(n).standard_normal((n, 2))
    walls = np.array([[-1.0, 0.0, 4.0, 0.0], [4.0, 3.0, -1.0, 3.0]])[: n - 1]
    goal = x + np.array([6.0, 0.5])
    return straight(x, v, samples, dt, name=name, recording="r", destination=goal, walls=walls)
