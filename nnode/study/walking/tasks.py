"""One calibration on all runs but one, and its errors on that one."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.cost import Convention
from nnode.calibrate.least_squares import Quadratic, least_squares
from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.problem import ResidualProblem
from nnode.data.sequence import Batch
from nnode.model.scene import Scene, wanted
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver
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
    problems = [ResidualProblem(system, batch, FusedSolver(), Convention.sum) for batch in train]
    first = problems[0]
    names = [name for name, _ in system.terms[0].named_parameters()]
    own = dict(zip(names, first.vector.row.tolist(), strict=True))
    grid = [dict(zip(GRID[law], each, strict=True)) for each in product(*GRID[law].values())]
    starts = [np.array(list({**own, **more}.values())) for more in [{}, *grid]]
    share = 2 / sum(int(batch.valid[1:].sum()) for batch in train)

    def costs(trials: np.ndarray) -> np.ndarray:
        """Mean squared distance over people and samples, m²."""
        return np.array([[share * sum(p.costs(row).sum() for p in problems)] for (row,) in trials])

    def quadratic(rows: np.ndarray) -> Quadratic:
        each = [problem(rows[0]) for problem in problems]
        parts = zip(*((one.cost, one.gradient, one.hessian) for one in each), strict=True)
        return Quadratic(*(share * np.concatenate(part).sum(0)[None] for part in parts))

    starts.sort(key=lambda row: float(costs(row[None, None])[0, 0]))
    minima = [
        least_squares(
            quadratic, costs, row[None], first.low, first.high, steps=STEPS, tolerance=1e-6
        )
        for row in starts[:BEST]
    ]
    found = min(minima, key=lambda one: float(one.cost[0]))
    ParameterVector(system).fill_(found.row[0])
    return {
        "row": dict(zip(names, found.row[0].tolist(), strict=True)),
        "train": float(found.cost[0]),
        "starts": [float(one.cost[0]) for one in minima],
        "evaluations": first.simulations,
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
