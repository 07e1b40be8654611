"""Small crowds with known accelerations, simulated without the package, and their model.

The simulation is Runge and Kutta's method at a fifth of the sampling interval.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from nnode.data.sequence import Sequence
from nnode.model import Crowd, make_law
from nnode.model.laws import InteractionForce
from nnode.model.term import Term

A, R, B, TAU = 3.0, 0.25, 0.3, 0.5
WIDTH, HALF = 4.5, 8.0
WALLS = np.array([[-HALF, 0.0, HALF, 0.0], [HALF, WIDTH, -HALF, WIDTH]])
DT, SUBSTEPS = 0.1, 5

#: Accelerations as a function of positions and velocities ``(S, N, 2)`` and time.
Extra = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


def model(
    *effects: Term, force: type[InteractionForce] = InteractionForce, **options: Any
) -> Crowd:
    """The law of the people, with effects.

    Args:
        force: the class of the force. options: of the force.
    """
    law = force(entry="social_force", **{"A": A, "k": 0.0, "kappa": 0.0, "B": B, **options})
    return Crowd([make_law("relaxation", tau=TAU), law, *effects])


def length(a: np.ndarray) -> np.ndarray:
    return np.sqrt((a**2).sum(-1) + 1e-12)


def _base(x: np.ndarray, v: np.ndarray, goal: np.ndarray) -> np.ndarray:
    n = x.shape[1]
    way = goal - x
    out = (length(v) / length(way))[..., None] * way / TAU - v / TAU
    dx = x[:, :, None] - x[:, None]
    push = A * np.exp((2 * R - length(dx)) / B) * (1 - np.eye(n)) / length(dx)
    out += (push[..., None] * dx).sum(2) / n
    along = np.linspace(-HALF, HALF, 65)
    points = np.concatenate([np.stack([along, np.full(65, y)], 1) for y in (0.0, WIDTH)])
    dw = x[:, :, None] - points
    push = A * np.exp((R - length(dw)) / B) / length(dw)
    return out + (push[..., None] * dw).mean(2)


def crowd(
    extra: Extra | None = None,
    *,
    seed: int = 0,
    sequences: int = 6,
    people: int = 6,
    samples: int = 46,
    noise: float = 0.005,
) -> list[Sequence]:
    """People who walk both ways through a corridor of 4.5 m."""
    draw = np.random.default_rng(seed)
    way = np.where(np.arange(people) % 2, 1.0, -1.0)
    # people on different lanes collide lightly at most
    lanes = draw.permuted(np.tile(np.linspace(0.9, WIDTH - 0.9, people), (sequences, 1)), axis=1)
    y = lanes + draw.uniform(-0.05, 0.05, lanes.shape)
    x = np.stack([-way * draw.uniform(1.5, 4.0, (sequences, people)), y], -1)
    side = np.clip(y + draw.normal(0, 0.5, y.shape), 0.9, WIDTH - 0.9)
    goal = np.stack([np.broadcast_to(way * 25.0, y.shape), side], -1)
    v = np.stack([way * draw.uniform(1.0, 1.6, y.shape), 0 * y], -1)

    def rate(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        return _base(x, v, goal) + (0 if extra is None else extra(x, v, t))

    h, path = DT / SUBSTEPS, [x]
    for k in range((samples - 1) * SUBSTEPS):
        t = k * h
        k1 = rate(x, v, t)
        k2 = rate(x + h / 2 * v, v + h / 2 * k1, t + h / 2)
        k3 = rate(x + h / 2 * v + h**2 / 4 * k1, v + h / 2 * k2, t + h / 2)
        k4 = rate(x + h * v + h**2 / 2 * k2, v + h * k3, t + h)
        x = x + h * v + h**2 / 6 * (k1 + k2 + k3)
        v = v + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if (k + 1) % SUBSTEPS == 0:
            path.append(x)
    measured = np.array(path)
    measured = measured + noise * draw.normal(size=measured.shape)
    return [
        Sequence(
            name=f"r/{s}",
            recording="r",
            time=100.0 * s + DT * np.arange(samples),
            x=measured[:, s],
            agents=tuple(f"{s}-{i}" for i in range(people)),
            destination=goal[s],
            walls=WALLS,
        )
        for s in range(sequences)
    ]


def wind(a_x: float, a_y: float) -> Extra:
    """A constant acceleration, m/s²."""
    return lambda x, v, t: np.broadcast_to([a_x, a_y], x.shape)
