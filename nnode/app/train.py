"""Calibrate a model: ``scripts/train.py``."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch.utils.data import DataLoader

from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.saved import merge_saved, plain_config, refuse_changes
from nnode.app.cli.sweep import RESULT
from nnode.app.cli.typed import shell_override
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint
from nnode.calibrate.cost import Convention
from nnode.calibrate.distributed import World
from nnode.calibrate.evaluate import best_common_speed
from nnode.calibrate.interrupt import Interrupted
from nnode.calibrate.optimizers import build_optimizer, needs_full_batch
from nnode.calibrate.optimizers.damped import GaussNewton
from nnode.calibrate.options import (
    FusedOptions,
    SolverOptions,
    TorchdiffeqOptions,
    TrainerOptions,
)
from nnode.calibrate.trainer import Provenance, Trainer
from nnode.data.clusters import clusters
from nnode.data.dataset import SequenceDataset, make_loader
from nnode.data.options import DataOptions, LoaderOptions
from nnode.data.prepare import open_data
from nnode.data.sequence import Batch
from nnode.data.split import Split, split
from nnode.data.store import Store
from nnode.errors import ConfigError
from nnode.files import write_json
from nnode.models import InteractionForce, System, build_model
from nnode.models.term import short_names
from nnode.plots import force_figure
from nnode.solvers import Solver, TorchdiffeqSolver, substeps

log = logging.getLogger(__name__)

#: Options that may change when a run is resumed: they do not touch the numbers of a step.
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
SECTIONS = ("model", "data", "optimizer", "solver", "trainer", "seed")


def build_solver(options: SolverOptions, device: torch.device | None = None) -> Solver:
    """The solver that the options describe.

    Raises:
        ConfigError: unknown options, or a compiled solver asked to work on a GPU.
    """
    if isinstance(options, FusedOptions):
        if device is not None and device.type != "cpu":
            raise ConfigError(
                f"solver=fused works on the CPU, the device is {device}; set the device to cpu, "
                "or take solver=torchdiffeq"
            )
        from nnode.solvers import FusedSolver  # loads Numba, which takes a second

        return FusedSolver(
            options.dt, options.threads, options.cutoff, options.cutoff_error, options.method
        )
    assert isinstance(options, TorchdiffeqOptions)
    return TorchdiffeqSolver(
        options.method, options.gradient.value, options.dt, options.rtol, options.atol
    )


def stream(
    loader: DataLoader[Any],
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Iterator[Batch]:
    """The mini-batches of a loader, in the precision and on the device asked for."""
    return (batch.to(device, dtype) for batch in loader)


def straight_loader(
    store: Store, indices: list[int], size: int, world: World | None = None
) -> DataLoader[Any]:
    """A loader that visits sequences in order; this process's shares where a world is given."""
    options = LoaderOptions(batch_size=size, shuffle=False)
    rank, number = (world.rank, world.size) if world else (0, 1)
    return make_loader(SequenceDataset(store, indices), options, seed=0, rank=rank, size=number)


def set_threads(threads: int | None, domain: str) -> None:
    """Torch's threads; by default one for traffic, whose tensors are too small to share."""
    if threads is not None and threads < 1:
        raise ConfigError(f"trainer.threads={threads} must be at least 1, or null")
    if threads is not None or domain == "traffic":
        torch.set_num_threads(threads or 1)


def _check(config: DictConfig) -> None:
    trainer = config.trainer
    for name, low in (("max_epochs", 0), ("evaluate_every", 1), ("figure_every", 0)):
        if trainer[name] < low:
            raise ConfigError(f"trainer.{name}={trainer[name]} must be at least {low}")
    if trainer.save_every < 0:
        raise ConfigError(f"trainer.save_every={trainer.save_every} must be at least 0 s")
    if trainer.patience is not None and trainer.patience < 1:
        raise ConfigError(f"trainer.patience={trainer.patience} must be at least 1, or null")


def train(config: DictConfig, folder: Path) -> None:
    """Run one training as configured and say where its results are.

    Processes that were started together share it; the first one's folder is taken.

    Raises:
        NNodeError: see the packages below; Interrupted after a signal, with all work saved.
    """
    world = World()
    folder = world.from_first(folder)
    with world.together():
        config, checkpoint = _composed(config)
    options: TrainerOptions = OmegaConf.to_object(config.trainer)  # type: ignore[assignment]
    device = world.use(options.device, "trainer.device")
    with world.together():
        model, store = _model(config), None
        solver = build_solver(OmegaConf.to_object(config.solver), device)  # type: ignore[arg-type]
        if world.first:
            data: DataOptions = OmegaConf.to_object(config.data)  # type: ignore[assignment]
            store = open_data(data, folder / "data")
    place = world.from_first(Path() if store is None else store.folder)
    with world.together():
        store = Store(place) if store is None else store
        trainer = _trainer(config, folder, model.to(device), solver, store, checkpoint, world)
    start = time.monotonic()
    try:
        trainer.fit()
    except Interrupted as stop:
        raise Interrupted(
            f"{stop}\nresume with: python scripts/train.py "
            f"{shell_override('resume', trainer.last_path)} "
            f"{shell_override('hydra.run.dir', folder)}",
            stop.signal,
        ) from None
    if world.first:
        _report(trainer, plain_config(config), folder, time.monotonic() - start, store)


def _composed(config: DictConfig) -> tuple[DictConfig, Checkpoint | None]:
    """The checked configuration, that of the checkpoint under it when a run is resumed."""
    checkpoint: Checkpoint | None = None
    resume = config.resume
    if resume is not None:
        checkpoint = load_checkpoint(resume)
        config = with_prepared(merge_saved(config, checkpoint.config, SECTIONS))
        refuse_changes(plain_config(config), checkpoint.config, RESUMABLE)
    else:
        config = with_prepared(config)
    _check(config)
    return config, checkpoint


def _model(config: DictConfig) -> System:
    """The model, if it is of the data's domain; torch's threads are set for it."""
    model = build_model(config.model, int(config.seed), getattr(torch, config.trainer.dtype.value))
    domain = str(config.data.domain)
    if domain in ("traffic", "crowd") and domain != model.domain:
        raise ConfigError(
            f"model={config.model.name} is a {model.domain} model, data={config.data.name} are "
            f"{domain} data; choose both of one domain"
        )
    set_threads(config.trainer.threads, domain)
    return model


def _trainer(
    config: DictConfig,
    folder: Path,
    model: System,
    solver: Solver,
    store: Store,
    checkpoint: Checkpoint | None,
    world: World,
) -> Trainer:
    data: DataOptions = OmegaConf.to_object(config.data)  # type: ignore[assignment]
    options: TrainerOptions = OmegaConf.to_object(config.trainer)  # type: ignore[assignment]
    optimizer_options: Any = OmegaConf.to_object(config.optimizer)
    if needs_full_batch(optimizer_options.name):
        data.loader.batch_size = 0
    seed = int(config.seed)
    _check_same_data(store, checkpoint)
    parts = _parts(store, data, checkpoint)
    loader = make_loader(
        SequenceDataset(store, parts.train),
        data.loader,
        seed=seed,
        rank=world.rank,
        size=world.size,
    )
    heldout = (
        straight_loader(store, parts.heldout, data.loader.batch_size, world)
        if parts.heldout
        else None
    )
    n = substeps(store[0].dt, config.solver.dt, model)
    log.info(
        "%s: %d sequences train, %d held out, %d dropped between; %d steps per sample",
        data.name, len(parts.train), len(parts.heldout), len(parts.dropped), n,
    )  # fmt: skip
    free_speed = None
    if model.domain == "traffic" and world.first:
        free_speed = best_common_speed(
            stream(straight_loader(store, parts.train, data.loader.batch_size))
        )
    names = [entry["name"] for entry in store.index]
    trainer = Trainer(
        model,
        solver,
        build_optimizer(model, optimizer_options, seed),
        loader,
        heldout,
        options,
        folder,
        Provenance(
            config=plain_config(config),
            manifest=brief(store.manifest),
            split={k: [names[i] for i in v] for k, v in asdict(parts).items() if k in _PARTS},
            free_speed=free_speed,
        ),
        # a law of people of one's own has no force that could be drawn by itself
        None if model.domain == "crowd" and model.find(InteractionForce) is None else force_figure,
        world,
    )
    if config.resume is not None:
        trainer.restore(Path(config.resume))
        log.info("resumed from %s at epoch %d, step %d", config.resume, trainer.epoch, trainer.step)
        if trainer.epoch >= options.max_epochs:
            log.info("nothing left to train: raise trainer.max_epochs=%d", options.max_epochs)
    return trainer


#: What is not known of a parameter without intervals.
_UNKNOWN = {"low": None, "high": None}
_BOUND = {"low": "lower", "high": "upper"}


def _in_words(own: dict[str, Any]) -> str:
    """A parameter with its interval, and what is wrong with it."""
    text = f"{own['value']:.4g} {own['unit']}"
    if own.get("at_bound"):
        return f"{text}, at the {_BOUND[own['at_bound']]} bound of what is admissible"
    if own["low"] is None:
        return text
    text += f"  [{own['low']:.4g}, {own['high']:.4g}]"
    return text if own["identified"] else f"{text}, not identified by these data"


_PARTS = ("train", "heldout", "dropped")


def brief(manifest: dict[str, Any]) -> dict[str, Any]:
    """A manifest without its long lists, small enough to travel in every checkpoint."""
    return {
        key: value
        for key, value in manifest.items()
        if not isinstance(value, list) or len(value) <= 50
    }


def source_hashes(manifest: dict[str, Any]) -> dict[str, str]:
    """SHA-256 of every raw file that a data set was prepared from."""
    return {name: file["sha256"] for name, file in manifest.get("files", {}).items()}


def _parts(store: Store, data: DataOptions, checkpoint: Checkpoint | None) -> Split:
    """Which sequences train; a resumed run keeps what its checkpoint trained on and held out."""
    places = {entry["name"]: i for i, entry in enumerate(store.index)}
    known = {} if checkpoint is None else checkpoint.split
    if not known or not {name for names in known.values() for name in names} <= set(places):
        return split(store, data.split)
    train, heldout, dropped = (
        sorted(places[name] for name in known.get(part, [])) for part in _PARTS
    )
    return Split(train=train, heldout=heldout, dropped=dropped, mode="checkpoint", note="as it was")


def _check_same_data(store: Store, checkpoint: Checkpoint | None) -> None:
    if checkpoint is None:
        return
    if source_hashes(store.manifest) != source_hashes(checkpoint.manifest):
        raise ConfigError(
            "the data are not those of the checkpoint: the hashes of the source files differ; "
            "point data.source= at the files it was trained on"
        )


def _intervals(trainer: Trainer, store: Store) -> dict[str, Any]:
    """Intervals of the best parameters, of models that have exact tangents; otherwise none."""
    if not isinstance(trainer.optimizer, GaussNewton):
        return {}
    # compiled code takes a second to import
    from nnode.calibrate.gauss_newton import TangentCost
    from nnode.calibrate.intervals import intervals
    from nnode.solvers.fused import FusedSolver

    assert isinstance(trainer.solver, FusedSolver)
    model = load_checkpoint(trainer.best_path).build().double()
    places = {entry["name"]: i for i, entry in enumerate(store.index)}
    indices = [places[name] for name in trainer.provenance.split["train"]]
    (batch,) = stream(straight_loader(store, indices, 0))
    cost = TangentCost(model, batch, trainer.solver, trainer.options.cost)
    return intervals(cost, cost.row(model), clusters(store.index)[indices])


def _report(
    trainer: Trainer, config: dict[str, Any], folder: Path, seconds: float, store: Store
) -> None:
    history = trainer.history
    first = history[0]
    best = min(history, key=lambda row: abs(row["epoch"] - trainer.best_epoch))
    unit = Convention(config["trainer"]["cost"]).unit
    # an epoch of an older checkpoint that was resumed may know its parameters by other names
    physical = {
        name: (best[f"parameters/{name}"], unit)
        for name, (_, unit) in trainer.model.physical().items()
        if f"parameters/{name}" in best
    }
    summary: dict[str, Any] = {
        "model": config["model"]["name"],
        "data": config["data"]["name"],
        "recording": config["data"]["recording"],
        "seed": config["seed"],
        "cost_start": first["cost/train"],
        "cost_train": best["cost/train"],
        "cost_heldout": best.get("cost/heldout"),
        "epoch": trainer.best_epoch,
        **{name: value for name, (value, _) in physical.items()},
        "seconds": round(seconds, 1),
    }
    paths = {
        "tensorboard": str(folder / "tensorboard"),
        "best checkpoint": str(trainer.best_path),
        "last checkpoint": str(trainer.last_path),
    }
    solver = {
        "name": config["solver"]["name"],
        "uncompiled": getattr(trainer.solver, "uncompiled", "") or None,
    }
    found = _intervals(trainer, store)
    known = found.pop("parameters", {})
    parameters = {
        name: {**_UNKNOWN, "value": value, "unit": unit, **known.get(name, {})}
        for name, (value, unit) in physical.items()
    }
    result = {
        "summary": summary,
        "parameters": parameters,
        **found,
        "solver": solver,
        "paths": paths,
        "history": history,
    }
    write_json(folder / RESULT, result)
    print(
        f"cost of a training sequence: {first['cost/train']:.4g} -> {best['cost/train']:.4g} {unit}"
    )
    if "cost/heldout" in best:
        before, after = first["cost/heldout"], best["cost/heldout"]
        print(f"cost of a held-out sequence: {before:.4g} -> {after:.4g} {unit}")
    short = short_names(physical)
    for name, own in parameters.items():
        print(f"{short[name]} = {_in_words(own)}")
    for what, path in paths.items():
        if Path(path).exists():
            print(f"{what}: {path}")
