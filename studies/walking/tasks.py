"""One calibration on all runs but one, and its errors on that one."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model.scene import Scene, with_destinations
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver
from studies.pooled import parameters_of, pooled_fit
from studies.walking.data import chosen
from studies.walking.laws import GRID, new_system

Result = dict[str, Any]
Predict = Callable[[Batch], Tensor]


def fit(law: str, desired: str, folders: list[str], held: list[str]) -> Result:
    """Calibrate a law on all runs but some, and evaluate it on those.

    Args:
        law: of :data:`studies.walking.laws.LAWS`.
        desired: where people want to go.
        folders: of the prepared data.
        held: recordings that are left out.

    Returns:
        Parameters as ``row``, the training error (m²) as ``train``, and ``errors`` by law and run.
    """
    system = new_system(law, desired)
    train = chosen(folders, held, test=False)
    own = parameters_of(system)
    grid = [dict(zip(GRID[law], each, strict=True)) for each in product(*GRID[law].values())]
    row, error = pooled_fit(system, train, [own, *({**own, **more} for more in grid)])
    errors = {law: _of_runs(simulated(system), folders, held)}
    return {"row": row, "train": error, "errors": errors}


def baselines(folders: list[str], held: list[str]) -> Result:
    """Errors of predictions that need no calibration, as those of :func:`fit`."""
    simple: dict[str, Predict] = {
        "constant_velocity": lambda b: straight(b, b.v[0]),
        "preferred": lambda b: straight(b, along_stream(b)),
    }
    return {"errors": {name: _of_runs(x, folders, held) for name, x in simple.items()}}


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
    scene = with_destinations(Scene.of(batch), batch, "direction")
    way = scene.destination - batch.x[0]
    length = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
    return scene.pace[..., None] * way / length.clamp(min=1e-9)  # who stood wants to stay


def straight(batch: Batch, velocity: Tensor) -> Tensor:
    """Positions of who keeps a velocity ``(B, N, 2)``."""
    time = batch.dt * torch.arange(batch.n_samples, dtype=batch.x.dtype)
    return batch.x[:1] + time[:, None, None, None] * velocity


def _errors(x: Predict, batches: list[Batch]) -> Result:
    """Means over people, over a sequence and at its end: of squared distances (m²) as ``mean`` and
    ``end``, of distances (m) as ``ade`` and ``fde``."""
    errors: dict[str, list[Tensor]] = {name: [] for name in ("mean", "end", "ade", "fde")}
    for batch in batches:
        square = (x(batch) - batch.x).square().sum(-1)
        people = batch.valid[0]
        samples = batch.valid[1:].sum(0).clamp(min=1)
        last = batch.valid.sum(0).clamp(min=1) - 1
        for of, at_end, values in (("mean", "end", square), ("ade", "fde", square.sqrt())):
            errors[of].append(((values[1:] * batch.valid[1:]).sum(0) / samples)[people])
            errors[at_end].append(values.gather(0, last[None])[0][people])
    if not batches:
        return {"people": 0, **dict.fromkeys(errors, 0.0)}
    means = {name: float(torch.cat(parts).mean()) for name, parts in errors.items()}
    return {"people": sum(map(len, errors["mean"])), **means}
