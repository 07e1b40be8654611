"""Both benchmarks in their own conventions, and calibrations of laws of car following."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from nnode.data.options import DataOptions
from nnode.data.prepare import prepare
from nnode.data.readers.juelich import Velocity
from nnode.data.readers.jupedsim import WalkwayOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.sequence import Sequence, collate
from nnode.data.split import TEST, TRAIN
from nnode.data.store import Store
from nnode.model.build import build_model
from nnode.model.laws import CAR_FOLLOWING_LAWS
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver
from studies.following.data import gap_of
from studies.pooled import parameters_of, pooled_fit

#: Scenes of the benchmark of prediction in the open.
SCENES = ("eth_univ", "eth_hotel", "ucy_univ", "ucy_zara01", "ucy_zara02")
#: s between two samples; samples that are seen, and samples that are predicted from them.
STEP, SEEN, AHEAD = 0.4, 8, 12


def events(source: str) -> PairOptions:
    """People who follow automated cars, with the published division."""
    return PairOptions(
        name="waymo_pairs",
        source=source,
        path="waymo_pairs",
        files=["*.parquet"],
        columns={"time": "t", "run": "split", "pair": "event"},
    )


def scene(name: str, source: str) -> WalkwayOptions:
    """A scene in windows of what is predicted; everybody was seen before, on average as fast as
    his ``preferred`` velocity says."""
    return WalkwayOptions(
        name=name,
        source=source,
        path=f"eth_ucy/{name}.parquet",
        columns={"agent": "id", "time": "frame"},
        time_unit="frame",
        frame_rate=1 / STEP,
        t_seq=AHEAD * STEP,
        history=(SEEN - 1) * STEP,
        velocity=Velocity.backward,
    )


def stores(source: str, folder: Path) -> dict[str, Store]:
    """Prepared data of the pairs and of every scene.

    Raises:
        DataError: files that are not there or cannot be read.
    """
    chosen: dict[str, DataOptions] = {"waymo_pairs": events(source)}
    chosen |= {name: scene(name, source) for name in SCENES}
    return {name: prepare(options, folder / name) for name, options in chosen.items()}


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
    initial = parameters_of(system)
    drawn = [
        {name: value * float(np.exp(SPREAD * rng.normal())) for name, value in initial.items()}
        for _ in range(starts)
    ]
    row, _ = pooled_fit(system, [train], [initial, *drawn])
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
