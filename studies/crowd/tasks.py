"""The calculations of the crowd study: one calibration or one evaluation each."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from nnode.calibrate.cost import sequence_costs
from nnode.calibrate.evaluate import Simulate, constant_velocity, no_interaction
from nnode.calibrate.resampling import group_weights
from nnode.data.sequence import Batch, collate
from nnode.simulation.base import Trajectory
from nnode.simulation.fused import FusedSolver
from studies.crowd import printed
from studies.crowd.data import chosen, parts, time_groups, turned
from studies.crowd.fit import calibrate, costs, new_system, row_of
from studies.stores import sequences

Result = dict[str, Any]

#: What is calibrated, and the model it is: the social force, both networks, or the network of
#: the walls alone.
KINDS = {"sf": "sf", "nn": "nn", "wall": "nn"}

#: Steps at most of the social force, which mostly needs fewer, and of a refit that starts at the
#: minimum of the sequences before resampling.
SF_STEPS, REFIT = 30, 4


def fit(
    kind: str,
    folder: str,
    scope: str,
    folds: int,
    span: list[float],
    seed: int,
    start: list[float] | None,
    steps: int,
) -> Result:
    """Calibrate one model from one start, and evaluate it on what was held out.

    Args:
        kind: of KINDS.
        folder, scope, folds, span: see :func:`studies.crowd.data.parts`.
        seed: of the random start, as the paper draws it.
        start: parameters found at a shorter horizon, to go on from; None starts afresh.
        steps: of the networks, see :func:`studies.crowd.fit.calibrate`.
    """
    train, held = parts(folder, scope, folds, (span[0], span[1]))
    batch, model = chosen(folder, train), KINDS[kind]
    begin = row_of(new_system(model, seed)) if start is None else np.array(start)
    row, evaluations = calibrate(
        model,
        batch,
        begin,
        people=kind != "wall",
        grow=start is None,
        steps=SF_STEPS if kind == "sf" else steps,
    )
    each = costs(model, row, batch)
    return {
        "row": row,
        "J": each.mean(),
        "evaluations": evaluations,
        "train": _by_name(batch, each),
        "heldout": _of(model, row, chosen(folder, held)) if held else {},
    }


def resample(folder: str, row: list[float], draws: int, first: int, last: int, seed: int) -> Result:
    """Local refits of the social force to resampled stretches of time, all sequences.

    Args:
        row: A, k, kappa calibrated to all sequences.
        draws: resamples in all; those from ``first`` to before ``last`` are computed here.
    """
    every = sequences(folder)
    rng = np.random.default_rng(seed)
    rows = []
    for weights in group_weights(time_groups(every), draws, rng)[first:last]:
        drawn = np.flatnonzero(weights)
        batch = collate(every[i] for i in drawn)
        refit, _ = calibrate(
            "sf", batch, np.array(row), grow=False, weights=weights[drawn], steps=REFIT
        )
        rows.append(refit)
    return {"rows": rows}


def baselines(folder: str) -> Result:
    """Costs by sequence of simulations that calibrate nothing, and of the printed parameters."""
    return {"costs": _simple(collate(sequences(folder)))}


def transfer(folder: str, rows: dict[str, list[float]]) -> Result:
    """Costs by recording and sequence of calibrated models on other runs, and of the baselines.

    Args:
        rows: parameters by kind.
    """
    every = [turned(s) for s in sequences(folder)]
    by_recording: Result = {}
    for recording in dict.fromkeys(s.recording for s in every):
        batch = collate(s for s in every if s.recording == recording)
        costs_by_kind = {kind: _of(KINDS[kind], row, batch) for kind, row in rows.items()}
        by_recording[recording] = {**costs_by_kind, **_simple(batch)}
    return {"runs": by_recording}


def even_pace(batch: Batch) -> Trajectory:
    """Everyone walks straight to his destination, at the pace that takes him there in time.

    It knows as much of the end as the models do, and when it is reached.
    """
    last = (batch.valid.sum(0) - 1).clamp(min=1)
    number = torch.arange(batch.n_samples, dtype=batch.x.dtype)
    share = (number[:, None, None] / last).clamp(max=1.0)[..., None]
    return Trajectory(torch.lerp(batch.x[:1], batch.destination[None], share), None)


def _simple(batch: Batch) -> dict[str, dict[str, float]]:
    system = new_system("sf")
    simple: dict[str, Simulate] = {
        "relaxation": no_interaction(system, FusedSolver(), None),
        "constant_velocity": constant_velocity(system),
        "even_pace": even_pace,
    }
    with torch.no_grad():
        costs_by_name = {
            name: _by_name(batch, sequence_costs(s(batch), batch)) for name, s in simple.items()
        }
    return {**costs_by_name, "printed": _of("sf", list(printed.parameters.values()), batch)}


def _of(model: str, row: Any, batch: Batch) -> dict[str, float]:
    return _by_name(batch, costs(model, row, batch))


def _by_name(batch: Batch, each: np.ndarray | torch.Tensor) -> dict[str, float]:
    return dict(zip(batch.names, each.tolist(), strict=True))
