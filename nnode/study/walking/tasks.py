"""One calibration on all runs but one, and its errors on that one."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.ensemble import EnsembleCost
from nnode.calibrate.least_squares import Residuals, least_squares
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch
from nnode.errors import SimulationError
from nnode.model.scene import Scene, wanted
from nnode.model.system import System
from nnode.simulate.fused import FusedSolver
from nnode.study.walking.data import chosen
from nnode.study.walking.laws import GRID, new_system

Result = dict[str, Any]
Predict = Callable[[Batch], Tensor]
#: Steps of a calibration at most, and how many of the best starts go on.
STEPS, BEST = 12, 2


def fit(law: str, desired: str, folders: list[str], held: list[str]) -> Result:
    """Calibrate a law on all runs but some, and evaluate it on those.

    Args:
        law: of :data:`nnode.study.walking.laws.LAWS`.
        desired: where people want to go.
        folders: of the prepared data.
        held: recordings that are left out.
    """
    system = new_system(law, desired)
    train = chosen(folders, held, test=False)
    costs = [EnsembleCost(system, batch, FusedSolver()) for batch in train]
    first = costs[0]
    names = [name for name, _ in system.terms[0].named_parameters()]
    own = dict(zip(names, ParameterVector(system).row.tolist(), strict=True))
    grid = [dict(zip(GRID[law], each, strict=True)) for each in product(*GRID[law].values())]
    starts = [np.array(list({**own, **more}.values())) for more in [{}, *grid]]
    away = residuals(costs)
    starts.sort(key=lambda row: _square(away(row)))
    minima = [
        least_squares(away, row, first.low.numpy(), first.high.numpy(), steps=STEPS)
        for row in starts[:BEST]
    ]
    found = min(minima, key=lambda one: one.cost)
    ParameterVector(system).fill_(found.row)
    return {
        "row": dict(zip(names, found.row.tolist(), strict=True)),
        "train": found.cost,
        "starts": [one.cost for one in minima],
        "evaluations": len(starts) + sum(one.evaluations for one in minima),
        "errors": _of_runs(simulated(system), folders, held),
    }


def baselines(folders: list[str], held: list[str]) -> Result:
    """Errors of predictions that need no calibration, by name and run."""
    return {
        "constant_velocity": _of_runs(lambda b: straight(b, b.v[0]), folders, held),
        "preferred": _of_runs(lambda b: straight(b, along_stream(b)), folders, held),
    }


def _of_runs(x: Predict, folders: list[str], runs: list[str]) -> Result:
    return {run: _errors(x, chosen(folders, [run], test=True)) for run in runs}


def _square(values: Tensor | None) -> float:
    return math.inf if values is None else float(values.square().sum())


def residuals(costs: list[EnsembleCost]) -> Residuals:
    """Residuals whose sum of squares is the mean squared distance over people and samples."""
    number = sum(int(cost.batch.valid[1:].sum()) for cost in costs)

    def found(row: np.ndarray) -> Tensor | None:
        parts = []
        for cost in costs:
            batch = cost.batch
            system = ParameterVector(cost.system).fill_(row)
            seen = batch.valid[1:]
            try:
                with torch.no_grad():
                    away = cost.solver(system, batch).x[1:][seen] - batch.x[1:][seen]
            except SimulationError:
                return None
            parts.append(away.flatten())
        return torch.cat(parts) / number**0.5

    return found


def simulated(system: System) -> Predict:
    """A batch to positions ``(K, B, N, 2)``."""

    def x(batch: Batch) -> Tensor:
        with torch.no_grad():
            return FusedSolver()(system, batch).x

    return x


def along_stream(batch: Batch) -> Tensor:
    """``(B, N, 2)`` m/s: preferred speeds in the directions of streams."""
    scene = wanted(Scene.of(batch), batch, "direction")
    way = scene.destination - batch.x[0]
    return scene.pace[..., None] * way / torch.linalg.vector_norm(way, dim=-1, keepdim=True)


def straight(batch: Batch, velocity: Tensor) -> Tensor:
    """Positions of who keeps a velocity ``(B, N, 2)``."""
    time = batch.dt * torch.arange(batch.n_samples, dtype=batch.x.dtype)
    return batch.x[:1] + time[:, None, None, None] * velocity


def _errors(x: Predict, batches: list[Batch]) -> Result:
    """Squared distances (m²), means over people: over a sequence and at its end."""
    whole, end = [], []
    for batch in batches:
        square = (x(batch) - batch.x).square().sum(-1)
        people = batch.valid[0]
        samples = batch.valid[1:].sum(0).clamp(min=1)
        last = batch.valid.sum(0).clamp(min=1) - 1
        whole.append(((square[1:] * batch.valid[1:]).sum(0) / samples)[people])
        end.append(square.gather(0, last[None])[0][people])
    if not whole:
        return {"people": 0, "mean": 0.0, "end": 0.0}
    return {
        "people": sum(len(part) for part in whole),
        "mean": float(torch.cat(whole).mean()),
        "end": float(torch.cat(end).mean()),
    }
