"""Calibration of a model: the command ``train``."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from omegaconf import DictConfig

from nnode.app.calibration import Calibration, calibrated
from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.runs import RESULT
from nnode.app.cli.saved import merge_saved, options_of, plain_config, refuse_changes
from nnode.app.cli.typed import shell_override
from nnode.app.training import build_solver, check, model_of, trainer_of
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from nnode.calibrate.distributed import World
from nnode.calibrate.interrupt import BreakingGuard, Interrupted
from nnode.calibrate.options import TrainerOptions
from nnode.calibrate.trainer import Trainer
from nnode.data.options import DataOptions
from nnode.data.prepare import open_data
from nnode.data.store import Store
from nnode.files import write_csv, write_json
from nnode.progress import Stages

log = logging.getLogger(__name__)

#: Options that may change when a run is resumed, because they do not affect the steps' numbers.
RESUMABLE = (
    "data.source",
    "data.prepared",
    "data.path",
    "data.download",
    "data.loader.workers",
    "trainer.device",
    "trainer.max_epochs",
    "trainer.patience",
    "trainer.min_delta",
    "trainer.save_every",
    "trainer.figure_every",
)
#: Table of the separate parameters of sequences, for ``trainer.drivers=alone``.
SEPARATE = "separate_parameters.csv"
#: Table of drivers, for ``trainer.drivers``.
DRIVERS = "drivers.csv"
SECTIONS = ("model", "data", "optimizer", "solver", "trainer", "seed")


def train(config: DictConfig, folder: Path) -> None:
    """Run one training, write its results, and print their places.

    Processes that were started together share the training and the first process's folder.

    Raises:
        NNodeError: see the packages below; Interrupted after a signal, with all work saved.
    """
    world = World()
    folder = world.from_first(folder)
    with world.together():
        config, checkpoint = _composed(config)
    options: TrainerOptions = options_of(config.trainer)
    device = world.use(options.device, "trainer.device")
    with world.together():
        model, store = model_of(config), None
        solver = build_solver(options_of(config.solver), device)
        if world.first:
            data: DataOptions = options_of(config.data)
            store = open_data(data, folder / "data")
    place = world.from_first(Path() if store is None else store.folder)
    with world.together():
        store = Store(place) if store is None else store
        trainer = trainer_of(
            config,
            model.to(device),
            solver,
            store,
            plain=plain_config(config),
            folder=folder,
            checkpoint=checkpoint,
            world=world,
        )
        if checkpoint is not None:
            trainer.restore(Path(config.resume))
            progress = config.resume, trainer.epoch, trainer.step
            log.info("resumed from %s at epoch %d, step %d", *progress)
            if trainer.epoch >= options.max_epochs:
                log.info("nothing left to train: raise trainer.max_epochs=%d", options.max_epochs)
    start = time.monotonic()
    try:
        trainer.fit()
        if not world.first:
            return
        result = _result(trainer, store, start)
    except Interrupted as stop:
        overrides = [shell_override("resume", trainer.last_path)]
        overrides.append(shell_override("hydra.run.dir", folder))
        command = " ".join(["nnode train", *overrides])
        raise Interrupted(f"{stop}\nresume with: {command}", stop.signal) from None
    paths = {
        "tensorboard": folder / "tensorboard",
        "best checkpoint": trainer.best_path,
        "last checkpoint": trainer.last_path,
    }
    if result.drivers is not None:
        save_checkpoint(result.checkpoint, trainer.best_path)
        paths["drivers"] = write_csv(folder / DRIVERS, result.drivers.table)
    if result.separate is not None:
        paths["separate parameters"] = write_csv(folder / SEPARATE, result.separate)
    write_json(folder / RESULT, result.plain({name: str(path) for name, path in paths.items()}))
    print(result.summary())
    for what, path in paths.items():
        if path.exists():
            print(f"{what}: {path}")


def _result(trainer: Trainer, store: Store, start: float) -> Calibration:
    """The result of the training.

    Raises:
        Interrupted: on a signal; the last checkpoint contains the training.
    """
    left = f" while results were computed; the training is in {trainer.last_path}"
    with BreakingGuard(left), Stages("results", {"costs and intervals": 1.0}) as stages:
        stages.begin("costs and intervals")
        return calibrated(trainer, store, time.monotonic() - start)


def _composed(config: DictConfig) -> tuple[DictConfig, Checkpoint | None]:
    """The checked configuration and, for a resumed run, the checkpoint, whose options are the
    defaults."""
    checkpoint: Checkpoint | None = None
    resume = config.resume
    if resume is not None:
        checkpoint = load_checkpoint(resume)
        config = with_prepared(merge_saved(config, checkpoint.config, SECTIONS))
        refuse_changes(plain_config(config), checkpoint.config, RESUMABLE)
    else:
        config = with_prepared(config)
    check(config)
    return config, checkpoint
