"""The processes of ``test_distributed.py``: ``torchrun together.py STORE FOLDER``."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import torch

from nnode.calibrate.distributed import World, join
from nnode.calibrate.interrupt import Interrupted
from nnode.calibrate.optimizers import (
    AdadeltaOptions,
    AdamOptions,
    LbfgsOptions,
    OptimizerOptions,
    build_optimizer,
)
from nnode.calibrate.options import TrainerOptions
from nnode.calibrate.trainer import Provenance, Trainer
from nnode.data.dataset import SequenceDataset, make_loader
from nnode.data.options import LoaderOptions
from nnode.data.store import Store
from nnode.errors import SimulationError
from nnode.model import build_model
from nnode.simulation import FusedSolver, Solver, TorchdiffeqSolver

N4 = {
    "term": "network_speed",
    "name": "n4",
    "leader": "constant",
    "hidden": 4,
    "v0": 30.0,
    "box": None,
}
LIN = {"term": "lin", "name": "lin", "leader": "constant", "v0": 30.0, "L": 5.0, "L_min": 2.0}

#: Model, optimiser, sequences per mini-batch and epochs of each case. With five sequences, the last
#: mini-batch of two is incomplete; mini-batches of one leave the second process without data.
CASES: dict[str, tuple[dict[str, Any], OptimizerOptions, int, int]] = {
    "adadelta": (N4, AdadeltaOptions(), 2, 3),
    "single": (N4, AdadeltaOptions(eta1=0.1), 1, 2),
    "projected": ({**LIN, "L": 2.5}, AdamOptions(lr=1.0), 2, 3),
    "lbfgs": (N4, LbfgsOptions(max_iter=2), 0, 8),
}


def trainer_of(
    store: Store,
    folder: Path,
    optimizer: OptimizerOptions | None = None,
    seed: int = 0,
    batch_size: int = 2,
    *,
    options: dict[str, Any] = LIN,
    solver: Solver | None = None,
    **settings: Any,
) -> Trainer:
    """A trainer with this process's share of five training and two held-out sequences."""
    world, model = World(), build_model(options, seed)

    def loader(indices: range, size: int) -> Any:
        dataset, chosen = SequenceDataset(store, indices), LoaderOptions(batch_size=size)
        return make_loader(dataset, chosen, seed=seed, rank=world.rank, size=world.size)

    defaults = {"max_epochs": 6, "figure_every": 0, "save_every": 1e9}
    config = {"model": options, "seed": seed, "trainer": {"dtype": "float64"}}
    return Trainer(
        model,
        solver or FusedSolver(0.1),
        build_optimizer(model, optimizer or AdadeltaOptions(), seed),
        loader(range(5), batch_size),
        loader(range(5, 7), 1),
        TrainerOptions(**{**defaults, **settings}),
        folder,
        Provenance(config=config, manifest=store.manifest, split={"train": [], "heldout": []}),
    )


def make_trainer(case: str, store: Store, folder: Path) -> Trainer:
    """The trainer of a case."""
    options, optimizer, size, epochs = CASES[case]
    return trainer_of(
        store,
        folder,
        optimizer,
        batch_size=size,
        options=options,
        solver=TorchdiffeqSolver(dt=0.1),
        max_epochs=epochs,
        evaluate_every=3,
    )


def numbers(trainer: Trainer) -> dict[str, Any]:
    """Parameters and history at the end of a calibration."""
    flat = torch.cat([p.detach().flatten() for p in trainer.model.parameters()])
    return {
        "parameters": flat.tolist(),
        "step": trainer.step,
        "train": [row["cost/train"] for row in trainer.history],
        "heldout": [row["cost/heldout"] for row in trainer.history],
        "norms": [row["gradient_norm"] for row in trainer.history[1:]],
    }


def failing(store: Store, folder: Path) -> str:
    """The error message in this process if the simulation fails in the last process only."""
    trainer = make_trainer("adadelta", store, folder)
    solve = trainer.solver

    def fail(model: Any, batch: Any) -> Any:
        if trainer.step == 3 and World().rank == World().size - 1:
            raise SimulationError(f"process {World().rank} lost a car")
        return solve(model, batch)

    trainer.solver = fail
    try:
        trainer.fit()
    except SimulationError as error:
        return str(error)
    return "no error"


def interrupted(store: Store, folder: Path) -> list[int]:
    """Step and signal at the end if only the last process gets a signal in step 4."""
    trainer = make_trainer("adadelta", store, folder)
    descend = trainer._descend

    def signalled(batch: Any) -> None:
        descend(batch)
        if trainer.step == 3 and World().rank == World().size - 1:
            os.kill(os.getpid(), signal.SIGTERM)

    trainer._descend = signalled
    try:
        trainer.fit()
    except Interrupted as stop:
        return [trainer.step, stop.signal]
    return [trainer.step, 0]


if __name__ == "__main__":
    torch.set_num_threads(1)
    join()
    prepared, out = Store(Path(sys.argv[1])), Path(sys.argv[2])
    results: dict[str, Any] = {}
    for name in CASES:
        fitted = make_trainer(name, prepared, out / name)
        fitted.fit()
        results[name] = numbers(fitted)
    results["failing"] = failing(prepared, out / "failing")
    results["interrupted"] = interrupted(prepared, out / "interrupted")
    (out / f"process_{World().rank}.json").write_text(json.dumps(results))
    World().leave()
