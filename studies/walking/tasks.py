"""Laws of people, calibrated on all runs but some, and their errors on those."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nnode.data.readers.juelich import Velocity
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.store import Store
from nnode.model.build import build_model
from nnode.model.laws import PEDESTRIAN_LAWS
from nnode.model.scene import Scene, with_destinations
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver
from studies.crowd.data import OTHERS, RECORDING, prepared
from studies.options import StudyOptions
from studies.pooled import parameters_of, pooled_fit
from studies.stores import sequences

#: Recordings of both experiments; frame rates differ, so that they are two batches.
RUNS = {"main": (RECORDING,), "others": OTHERS}
#: s before a sequence in which preferred velocities are measured.
HISTORY = 1.0


def prepare_runs(options: StudyOptions, folder: Path, kind: str, horizon: float) -> Store:
    """The recordings of one experiment as sequences of ``horizon`` seconds.

    Velocities at the start are backward differences, so that nothing of what is predicted is in
    them. Sequences of one person, and the first one of a recording, which nothing went before,
    are left out by :func:`measured_before`.
    """
    history = {"history": HISTORY, "velocity": Velocity.backward, "min_agents": 2}
    return prepared(options, folder, kind, horizon, **history)


def measured_before(folder: str) -> list[Sequence]:
    """The sequences of a prepared folder before which somebody was measured."""
    return [s for s in sequences(folder) if s.preferred is not None]


def chosen(folders: Iterable[str], held: Iterable[str], *, test: bool) -> list[Batch]:
    """The sequences of some runs, or of all others, as one batch of each experiment."""
    batches, runs = [], set(held)
    for folder in folders:
        mine = [s for s in measured_before(folder) if (s.recording in runs) == test]
        if mine:
            batch = collate(mine)
            assert batch.preferred is not None
            # people who were not measured before are there for the others, but nothing is
            # asked of them
            measured = batch.preferred.isfinite().all(-1)
            batches.append(replace(batch, valid=batch.valid & measured))
    return batches


def without_walls(description: Mapping[str, Any]) -> dict[str, Any]:
    """A law of people whose walls nobody feels."""
    unit = "0" if "x" in description["rate"] else "0 m/s²"
    zero = dict.fromkeys(description.get("walls", {}), unit)
    kept = {key: value for key, value in description.items() if key != "walls"}
    return {**kept, "constants": {**description.get("constants", {}), **zero}}


_FORCE = without_walls(PEDESTRIAN_LAWS["esf"])
_CIRCLE = {"stride": "0 s", "lam": "1"}

#: Name to the law; the first is without any interaction.
LAWS: dict[str, dict[str, Any]] = {
    "alone": {
        "parameters": {"tau": PEDESTRIAN_LAWS["esf"]["parameters"]["tau"]},
        "rate": {"vx": "(pace*way_x - vx)/tau", "vy": "(pace*way_y - vy)/tau"},
    },
    "exponential": {
        **_FORCE,
        "parameters": {k: v for k, v in _FORCE["parameters"].items() if k not in _CIRCLE},
        "constants": {**_FORCE["constants"], **_CIRCLE},
    },
    **{name: without_walls(PEDESTRIAN_LAWS[name]) for name in ("esf", "ttc", "gcfm", "cfsm")},
}
#: Values of parameters from all combinations of which a calibration chooses its starts: forces that
#: jump where people just touch leave many valleys.
GRID: dict[str, dict[str, tuple[float, ...]]] = {
    "alone": {},
    "exponential": {"A": (0.05, 0.2, 1.0), "B": (0.1, 0.2, 0.5)},
    "esf": {"A": (0.05, 0.2, 1.0), "B": (0.15, 0.3), "stride": (0.3, 1.0), "lam": (0.06, 1.0)},
    "ttc": {"k": (0.005, 0.02, 0.1, 0.5), "r": (0.05, 0.1, 0.2), "t0": (1.0, 3.0)},
    "gcfm": {"eta": (0.05, 0.3), "tau": (0.1, 0.5)},
    "cfsm": {"T": (0.3, 0.6, 1.0), "l": (0.1, 0.25), "a": (1.0, 5.0), "D": (0.05, 0.15, 0.3)},
}
#: How the page calls them.
LABELS = {
    "constant_velocity": "constant velocity",
    "preferred": "preferred velocity",
    "alone": "no interaction",
    "exponential": "exponential force",
    "esf": "elliptical force",
    "ttc": "time to collision",
    "gcfm": "centrifugal force",
    "cfsm": "collision-free speed",
}
#: Need no calibration.
SIMPLE = ("constant_velocity", "preferred")
#: Where people want to go.
DESIRED = ("direction", "last")


def new_system(law: str, desired: str) -> System:
    """A law of LAWS at its start."""
    options = {"term": "formula", "name": law, "law": LAWS[law], "desired": desired}
    return build_model({**options, "leader": "measured"})


Result = dict[str, Any]
Predict = Callable[[Batch], Tensor]


def fit(law: str, desired: str, folders: list[str], held: list[str]) -> Result:
    """Calibrate a law on all runs but some, and evaluate it on those.

    Args:
        law: of :data:`LAWS`.
        desired: where people want to go.
        folders: of the prepared data.
        held: recordings that are left out.

    Returns:
        Parameters as ``row``, the training error (m²) as ``train``, and ``errors`` by law and run.
    """
    system = new_system(law, desired)
    train = chosen(folders, held, test=False)
    initial = parameters_of(system)
    grid = [dict(zip(GRID[law], each, strict=True)) for each in product(*GRID[law].values())]
    row, error = pooled_fit(system, train, [initial, *({**initial, **values} for values in grid)])
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
