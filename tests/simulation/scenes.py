"""Small scenes and laws for the tests of solvers."""

from __future__ import annotations

import numpy as np
import torch

from nnode.data.sequence import Sequence
from nnode.model import Law, make_law
from tests.builders import lane, straight


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(3)


LAWS = {
    "lin": lambda: make_law("lin", v0=18.0, L=4.0),
    "log": lambda: make_law("log", v0=18.0, L=6.0),
    "n4": lambda: make_law("network_speed", hidden=4, v0=18.0, generator=seeded()),
}


def network_force(**options: bool) -> Law:
    return make_law("network_force", hidden=4, generator=seeded(), **options)


def platoon(
    gaps: list[float],
    speed: float = 15.0,
    samples: int = 6,
    dt: float = 0.2,
    name: str = "p",
    start: float = 12.0,
    noise: float = 0.3,
) -> Sequence:
    """A platoon with gaps (m) from the last vehicle on, a speed (m/s), and noise (m)."""
    x = start + np.concatenate([[0.0], np.cumsum(gaps)])[None]
    x = x + speed * (dt * np.arange(samples))[:, None]
    draw = np.random.default_rng(len(gaps) + 10 * samples)
    # the start has no noise
    x[1:] += noise * draw.standard_normal(x[1:].shape)
    return lane(x, dt, start=3.0, name=name, recording="r")


def crowd(
    n: int, samples: int = 5, dt: float = 0.2, apart: float = 0.42, name: str = "c"
) -> Sequence:
    """People in a corridor, 0 <= y <= 3, whose neighbours are ``apart`` (m) away."""
    x = np.stack([apart * np.arange(n), 0.2 + 0.01 * np.arange(n) ** 2], 1)
    v = np.array([1.3, 0.1]) + 0.1 * np.random.default_rng(n).standard_normal((n, 2))
    walls = np.array([[-1.0, 0.0, 4.0, 0.0], [4.0, 3.0, -1.0, 3.0]])[: n - 1]
    goal = x + np.array([6.0, 0.5])
    return straight(x, v, samples, dt, name=name, recording="r", destination=goal, walls=walls)
