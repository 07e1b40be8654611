"""Forces of calibrated crowd models at the states and pairs that were measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch

from nnode.data.sequence import Batch
from nnode.model.system import System
from nnode.model.term import State
from nnode.plots.interaction import evaluate_force, interaction

#: Pairs are looked at up to this distance, m, in bins of this width, m.
FAR, BIN = 6.0, 0.25
#: Speeds (m/s) are looked at in bins of this width, up to this speed.
SPEED_BIN, FASTEST = 0.1, 2.0
#: A bin counts from so many measured pairs or people on.
LEAST = 20
#: Pairs that are looked at; all give the same picture.
MOST_PAIRS = 20000


@dataclass(frozen=True)
class Measured:
    """States of all people at the middle of their sequences, and their pairs.

    Attributes:
        scenes: sequences of that one sample.
        dx, dv: ``(P, 2)`` relative positions (m) and velocities (m/s) of pairs nearer than FAR.
        facing: ``(P,)`` True where the two walk in opposite directions.
    """

    scenes: Batch
    dx: np.ndarray
    dv: np.ndarray
    facing: np.ndarray

    @classmethod
    def of(cls, batch: Batch, seed: int = 0) -> Measured:
        """What a batch of sequences holds; pairs are drawn where there are very many."""
        k = batch.n_samples // 2
        middle = replace(batch, x=batch.x[k:], v=batch.v[k:])
        x, v, real = middle.x[0], middle.v[0], batch.agent
        dx, dv = x[:, :, None] - x[:, None], v[:, :, None] - v[:, None]
        near = torch.linalg.vector_norm(dx, dim=-1) < FAR
        near &= real[:, :, None] & real[:, None] & ~torch.eye(x.shape[1], dtype=torch.bool)
        facing = v[:, :, None, 0] * v[:, None, :, 0] < 0
        pairs = [each[near].numpy() for each in (dx, dv, facing)]
        if near.sum() > MOST_PAIRS:
            rng = np.random.default_rng(seed)
            drawn = rng.choice(len(pairs[0]), MOST_PAIRS, replace=False)
            pairs = [each[drawn] for each in pairs]
        return cls(middle, *pairs)


@torch.no_grad()
def accelerations(system: System, measured: Measured) -> dict[str, np.ndarray]:
    """``(M, 2)`` accelerations of the M measured people, m/s²: ``pair``, ``wall``, ``sum``; and
    their velocities ``v``, m/s."""
    batch = measured.scenes
    state = State(torch.zeros(()), batch.x[0], batch.v[0], system.scene(batch))
    parts = interaction(system).components(state)
    forces = {name: part[batch.agent].numpy() for name, part in parts.items()}
    return {
        **forces,
        "sum": sum(forces.values(), np.zeros(1)),
        "v": batch.v[0][batch.agent].numpy(),
    }


def along_by_speed(parts: dict[str, np.ndarray]) -> pd.DataFrame:
    """Mean acceleration along a person's own way, m/s², by his speed.

    Returns:
        Indexed by speed (m/s, middle of the bin): ``pair``, ``wall``, ``sum`` and ``n`` people.
    """
    heading = np.where(parts["v"][:, 0] < 0, -1.0, 1.0)
    table = pd.DataFrame({name: heading * parts[name][:, 0] for name in ("pair", "wall", "sum")})
    speed = np.abs(parts["v"][:, 0])
    table["speed"] = _middle(speed, SPEED_BIN)
    grouped = table[speed < FASTEST].groupby("speed")
    by_speed = grouped.mean().assign(n=grouped.size())
    return by_speed[by_speed["n"] >= LEAST]


def slope(parts: dict[str, np.ndarray]) -> tuple[float, float]:
    """Rate (1/s) at which the sum pulls a person's speed along the corridor, and the speed
    (m/s) it pulls to: the least-squares line through acceleration against speed."""
    heading = np.where(parts["v"][:, 0] < 0, -1.0, 1.0)
    rise, level = np.polyfit(np.abs(parts["v"][:, 0]), heading * parts["sum"][:, 0], 1)
    return -rise, -level / rise


def away_by_distance(system: System, measured: Measured) -> pd.DataFrame:
    """Mean force of one person on another, N, along the line from the one to the other.

    Positive pushes apart.

    Returns:
        Indexed by distance (m, middle of the bin): ``facing`` and ``same way``.
    """
    force = evaluate_force(system, measured.dx, measured.dv, "pair")
    distance = np.linalg.norm(measured.dx, axis=1)
    away = pd.Series((force * measured.dx).sum(1) / np.maximum(distance, 1e-9))
    way = np.where(measured.facing, "facing", "same way")
    grouped = away.groupby([pd.Index(_middle(distance, BIN), name="distance"), way])
    return grouped.mean()[grouped.size() >= LEAST].unstack()


def _middle(values: np.ndarray, width: float) -> np.ndarray:
    """The middles of the bins of values."""
    return np.asarray((np.floor(values / width) + 0.5) * width)


def likeness(first: np.ndarray, second: np.ndarray) -> float:
    """Correlation of two ``(M, 2)`` fields of vectors about their means; NaN where one is
    constant."""
    fields = pd.DataFrame([(field - field.mean(0)).ravel() for field in (first, second)])
    return float(fields.T.corr().to_numpy()[0, 1])


def size(field: np.ndarray) -> float:
    """Root mean square length of ``(M, 2)`` vectors."""
    return float(np.sqrt((field**2).sum(1).mean()))
