"""One calibration of a law of car following on the training events, and its errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from nnode.data.sequence import Sequence, collate
from nnode.data.split import TEST, TRAIN
from nnode.data.store import Store
from nnode.model.build import build_model
from nnode.model.laws import CAR_FOLLOWING_LAWS
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver
from studies.following.data import gap_of
from studies.pooled import parameters_of, pooled_fit

#: Standard deviation of the logarithm of parameters at a start.
SPREAD = 0.4


def follow(law: str, folder: str, starts: int, seed: int) -> dict[str, Any]:
    """Calibrate a law by the squared errors of all spacings together, and test it.

    This minimises the published metric: its denominator does not depend on the law.

    Args:
        law: of :data:`nnode.model.laws.CAR_FOLLOWING_LAWS`.
        folder: of the prepared pairs.
        starts: starts beside the law's own.
        seed: of these.
    """
    system = build_model(
        {"term": "formula", "name": law, "leader": "measured", "law": CAR_FOLLOWING_LAWS[law]}
    )
    sides = {side: [s for s in Store(folder) if s.split == side] for side in (TRAIN, TEST)}
    train, rng = collate(sides[TRAIN]), np.random.default_rng(seed)
    own = parameters_of(system)
    drawn = [
        {name: value * float(np.exp(SPREAD * rng.normal())) for name, value in own.items()}
        for _ in range(starts)
    ]
    row, _ = pooled_fit(system, [train], [own, *drawn])
    return {"row": row, **{side: squares(system, pairs) for side, pairs in sides.items()}}


@torch.no_grad()
def squares(system: System, pairs: list[Sequence]) -> dict[str, list[float]]:
    """Sums of squares (m²) by pair: of errors of the spacing, and of the measured spacing.

    The leader follows its measured path, so that a spacing is wrong by as much as the follower's
    position. All samples count, the first one as well.
    """
    batch = collate(pairs)
    late = (FusedSolver()(system, batch).x - batch.x)[..., 0, 0]
    error = (late.square() * batch.valid[..., 0]).sum(0)
    return {"error": error.tolist(), "spacing": [float((gap_of(s) ** 2).sum()) for s in pairs]}


def rmspe(sums: dict[str, list[float]], weights: np.ndarray | None = None) -> float:
    """Root mean square percentage error of spacings over all samples together.

    Args:
        weights: of the pairs; None: all count once.
    """
    error, spacing = (np.array(sums[name]) for name in ("error", "spacing"))
    weights = np.ones(len(error)) if weights is None else weights
    return float(np.sqrt((weights @ error) / (weights @ spacing)))
