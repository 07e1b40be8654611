"""One calibration on all runs but one, and its errors on that one."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.ensemble import EnsembleCost
from nnode.calibrate.least_squares import Residuals, least_squares
from nnode.data.sequence import Batch
from nnode.errors import SimulationError
from nnode.models.scene import Scene, wanted
from nnode.models.system import System
from nnode.solvers.fused.engine import FusedSolver
from nnode.study.walking.data import chosen
from nnode.study.walking.laws import STARTS, new_system

Result = dict[str, Any]
#: Steps of the calibration at most.
STEPS = 20


def fit(law: str, desired: str, folders: list[str], held: str) -> Result:
    """Calibrate a law on all runs but one, and evaluate it on that one.

    Args:
        law: of :data:`nnode.study.walking.laws.LAWS`.
        desired: where people want to go.
        folders: of the prepared data.
        held: recording that is left out.
    """
    system = new_system(law, desired)
    train = chosen(folders, held, test=False)
    costs = [EnsembleCost(system, batch, FusedSolver()) for batch in train]
    first = costs[0]
    names = [name for name, _ in system.terms[0].named_parameters()]
    own = dict(zip(names, first.row(system).tolist(), strict=True))
    begin = [own, *({**own, **more} for more in STARTS.get(law, ()))]
    minima = [
        least_squares(
            residuals(costs), np.array(list(start.values())), first.low.numpy(),
            first.high.numpy(), steps=STEPS, least=0.1,
        )
        for start in begin
    ]  # fmt: skip
    found = min(minima, key=lambda one: one.cost)
    first.fill_(system, torch.from_numpy(found.row))
    return {
        "row": dict(zip(names, found.row.tolist(), strict=True)),
        "train": found.cost,
        "starts": [one.cost for one in minima],
        "evaluations": sum(one.evaluations for one in minima),
        **_errors(simulated(system), chosen(folders, held, test=True)),
    }


def baselines(folders: list[str], held: str) -> Result:
    """Errors of predictions that need no calibration, by name."""
    test = chosen(folders, held, test=True)
    return {
        "constant_velocity": _errors(lambda batch: straight(batch, batch.v[0]), test),
        "preferred": _errors(lambda batch: straight(batch, along_stream(batch)), test),
    }


def residuals(costs: list[EnsembleCost]) -> Residuals:
    """Residuals whose sum of squares is the mean squared distance over people and samples."""
    number = sum(int(cost.batch.valid[1:].sum()) for cost in costs)

    def found(row: np.ndarray) -> Tensor | None:
        parts = []
        for cost in costs:
            batch = cost.batch
            system = cost.fill_(cost.system, torch.from_numpy(row))
            seen = batch.valid[1:]
            try:
                with torch.no_grad():
                    away = cost.solver(system, batch).x[1:][seen] - batch.x[1:][seen]
            except SimulationError:
                return None
            parts.append(away.flatten())
        return torch.cat(parts) / number**0.5

    return found


def simulated(system: System) -> Any:
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


def _errors(x: Any, batches: list[Batch]) -> Result:
    """Squared distances (m²), means over people: over a sequence and at its end."""
    whole, end = [], []
    for batch in batches:
        square = (x(batch) - batch.x).square().sum(-1)
        people = batch.valid[0]
        samples = batch.valid[1:].sum(0).clamp(min=1)
        last = batch.valid.sum(0).clamp(min=1) - 1
        whole.append(((square[1:] * batch.valid[1:]).sum(0) / samples)[people])
        end.append(square.gather(0, last[None])[0][people])
    count = sum(len(part) for part in whole)
    return {
        "people": count,
        "mean": float(torch.cat(whole).mean()),
        "end": float(torch.cat(end).mean()),
    }
