"""Platoons and car-following models for tests of laws, effects and steps."""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Batch, collate
from nnode.model import System, Traffic, build_model
from nnode.model.laws import CAR_FOLLOWING_LAWS, NEURONS
from nnode.simulation import TorchdiffeqSolver, Trajectory
from tests.builders import lane

DT = 0.1


def model(law: str | dict[str, Any], *effects: dict[str, Any], **options: Any) -> Traffic:
    """A law of the catalogue by its name, or a law by its description, with a measured leader."""
    name = law if isinstance(law, str) else "mine"
    network = {"network": NEURONS[name]} if name in NEURONS else {}
    return build_model(
        {
            "term": "formula",
            "name": name,
            "leader": "measured",
            "effects": list(effects),
            "law": CAR_FOLLOWING_LAWS[name] if isinstance(law, str) else law,
            **network,
            **options,
        }
    )


def set_(system: Traffic, **values: float) -> Traffic:
    """The same model with other values of its law's parameters."""
    with torch.no_grad():
        for name, value in values.items():
            getattr(system.terms[0], name).fill_(value)
    return system


def parameters_of(system: Traffic) -> SimpleNamespace:
    """The law's parameters as plain numbers."""
    law = system.terms[0]
    return SimpleNamespace(**{name: float(getattr(law, name).detach()) for name in law.scalars})


def idm(net: Any, v: Any, ahead: Any, p: Any) -> Any:
    """Accelerations by Treiber, Hennecke & Helbing 2000, equations (2) and (3).

    Args:
        net: gaps from bumper to bumper, m; gaps below 0.1 m count as 0.1 m.
        v, ahead: speeds of the vehicles and of those ahead, m/s.
        p: the parameters as attributes.
    """
    wish = p.s0 + np.maximum(v * p.T + v * (v - ahead) / (2 * np.sqrt(p.a * p.b)), 0)
    return p.a * (1 - (v / p.v0) ** 4 - (wish / np.maximum(net, 0.1)) ** 2)


def platoon_behind(
    lead: Any, gaps: Many[float], seconds: float, length: float = 4.0, dt: float = DT
) -> Batch:
    """Vehicles that all start at their leader's speed; the leader's position is ``lead(t)``, m."""
    time = dt * np.arange(round(seconds / dt) + 1)
    h = 1e-4
    speed = (lead(time + h) - lead(time - h)) / (2 * h)
    x = lead(time)[:, None] - np.cumsum([0.0, *gaps])[::-1]
    return collate([lane(x, dt, v=speed[:, None], length=length)])


def states(seed: int = 3, platoons: int = 40) -> Batch:
    """Random platoons of one to five vehicles; some stand, some touch, some have equal speeds."""
    draw, sequences = np.random.default_rng(seed), []
    for number in range(platoons):
        n = 1 + number % 5
        gap = draw.uniform(0.0, 60.0, n - 1)
        gap[draw.random(n - 1) < 0.15] = 4.0  # bumper to bumper
        v = draw.uniform(0.0, 35.0, n)
        v[draw.random(n) < 0.15] = 0.0
        if number % 4 == 0:
            v[:] = v[0]
        x = 100 + np.cumsum([0.0, *gap])
        x = x + v * np.array([[0.0], [DT]])
        sequences.append(lane(x, DT, v=v, length=4.0, name=f"s{number}"))
    return collate(sequences)


def simulate(
    system: System, batch: Batch, method: str | None = None, step: float = DT
) -> Trajectory:
    """A simulation without gradients, by default with the method of the law."""
    with torch.no_grad():
        return TorchdiffeqSolver(method, "discrete", step)(system, batch)


def rates(system: System, batch: Batch, t: float = 0.0, y: Tensor | None = None) -> Tensor:
    """Rates of all states, ``(B, N, M)``, by default at the start."""
    y = system.initial(batch) if y is None else y
    return system(torch.tensor(t, dtype=torch.float64), y, system.scene(batch)).detach()


def accelerations(system: Traffic, batch: Batch, method: str = "euler") -> np.ndarray:
    """``(B, N)`` accelerations at the start in a step of ``DT``; NaN except for followers."""
    scene = replace(system.scene(batch), step=DT, method=method)
    with torch.no_grad():
        rate = system(torch.zeros((), dtype=torch.float64), system.initial(batch), scene)
    return torch.where(scene.follower, rate[..., 1], torch.nan).numpy()


def each_follower(batch: Batch) -> list[tuple[int, int, float, float, float]]:
    """Per follower: sequence, number, gap (front to front, m), speed, speed ahead (m/s)."""
    x, v = batch.x[0, ..., 0].numpy(), batch.v[0, ..., 0].numpy()
    return [
        (b, i, float(x[b, i + 1] - x[b, i]), float(v[b, i]), float(v[b, i + 1]))
        for b in range(len(batch.names))
        for i in range(int(batch.agent[b].sum()) - 1)
    ]
