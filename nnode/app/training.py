"""Composition of a training from options, for the command and :class:`nnode.Calibrator`."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from omegaconf import DictConfig
from threadpoolctl import threadpool_limits
from torch.utils.data import DataLoader

from nnode.app.cli.saved import options_of
from nnode.app.drivers import ALONE, NONE, check_drivers, planned
from nnode.calibrate.checkpoint import Checkpoint
from nnode.calibrate.distributed import World
from nnode.calibrate.evaluate import best_common_speed
from nnode.calibrate.optimizers import build_optimizer, needs_full_batch
from nnode.calibrate.options import (
    FusedOptions,
    SolverOptions,
    StartSpeeds,
    TorchdiffeqOptions,
    TrainerOptions,
)
from nnode.calibrate.trainer import Provenance, Trainer
from nnode.data.dataset import SequenceDataset, SmoothSpeeds, Source, make_loader, sound_speeds
from nnode.data.options import DataOptions, LoaderOptions
from nnode.data.sequence import Batch
from nnode.data.split import Split, split
from nnode.errors import ConfigError
from nnode.model import InteractionForce, System, build_model
from nnode.simulation import Solver, TorchdiffeqSolver, substeps

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

#: Smallest values of the trainer's options.
_LOWEST = {"max_epochs": 0, "evaluate_every": 1, "figure_every": 0, "save_every": 0}
_LOWEST |= {"patience": 1, "threads": 1}

#: Parts of a split, as checkpoints name them.
PARTS = ("train", "heldout", "dropped")


def build_solver(options: SolverOptions, device: torch.device | None = None) -> Solver:
    """The solver that the options describe.

    Raises:
        ConfigError: unknown options, or a compiled solver on a GPU.
    """
    if isinstance(options, FusedOptions):
        if device is not None and device.type != "cpu":
            raise ConfigError(
                f"solver=fused works on the CPU, the device is {device}; set the device to cpu, "
                "or take solver=torchdiffeq"
            )
        from nnode.simulation import FusedSolver  # loads Numba, which takes a second

        return FusedSolver(
            options.dt, options.threads, options.cutoff, options.cutoff_error, options.method
        )
    assert isinstance(options, TorchdiffeqOptions)
    return TorchdiffeqSolver(
        options.method, options.gradient.value, options.dt, options.rtol, options.atol
    )


def straight_loader(
    store: Source, indices: list[int], size: int, world: World | None = None
) -> DataLoader[Any]:
    """A loader that visits sequences in order; with ``world``, only this process's shares."""
    options = LoaderOptions(batch_size=size, shuffle=False)
    rank, number = (world.rank, world.size) if world else (0, 1)
    return make_loader(SequenceDataset(store, indices), options, seed=0, rank=rank, size=number)


def batches(
    store: Source,
    indices: list[int],
    size: int,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Iterator[Batch]:
    """Sequences in order, in mini-batches with a precision and on a device."""
    return (batch.to(device, dtype) for batch in straight_loader(store, indices, size))


def set_threads(threads: int | None, domain: str) -> None:
    """Set the threads of torch and of NumPy's linear algebra; by default one for traffic, whose
    tensors are small: others would wait busily, and results would depend on their number in the
    last digits."""
    if threads is not None or domain == "traffic":
        torch.set_num_threads(threads or 1)
        threadpool_limits(threads or 1, "blas")


@contextmanager
def threads_given_back() -> Iterator[None]:
    """Restore the numbers of threads at the end."""
    before = torch.get_num_threads()
    with threadpool_limits(user_api="blas"):
        try:
            yield
        finally:
            torch.set_num_threads(before)


def check(config: DictConfig) -> None:
    """Refuse options of the trainer that are out of their range.

    Raises:
        ConfigError: an option is out of its range.
    """
    trainer = config.trainer
    for name, low in _LOWEST.items():
        if trainer[name] is not None and trainer[name] < low:
            hint = ", or null" if name in ("patience", "threads") else ""
            raise ConfigError(f"trainer.{name}={trainer[name]} must be at least {low}{hint}")
    check_drivers(trainer.drivers)


def model_of(config: DictConfig) -> System:
    """Build the model, check its domain, and set torch's threads for it."""
    model = build_model(config.model, int(config.seed), getattr(torch, config.trainer.dtype.value))
    domain = str(config.data.domain)
    check_domain(model, str(config.model.name), domain, str(config.data.name))
    set_threads(config.trainer.threads, domain)
    return model


def check_domain(model: System, model_name: str, domain: str, data_name: str) -> None:
    """Refuse a model for data of another domain, if the domain of the data is known.

    Raises:
        ConfigError: the domains differ.
    """
    if domain in ("traffic", "crowd") and domain != model.domain:
        raise ConfigError(
            f"model={model_name} is a {model.domain} model, data={data_name} are {domain} data; "
            "choose both of one domain"
        )


def trainer_of(
    config: DictConfig,
    model: System,
    solver: Solver,
    store: Source,
    *,
    plain: dict[str, Any],
    folder: Path | None = None,
    checkpoint: Checkpoint | None = None,
    world: World | None = None,
) -> Trainer:
    """A trainer of a model on some sequences.

    Args:
        config: configuration with ``data``, ``optimizer``, ``trainer``, ``solver`` and ``seed``.
        model, solver: see :class:`nnode.calibrate.trainer.Trainer`.
        store: the sequences, on the disk or in memory.
        plain: the configuration in plain types, for checkpoints.
        folder: folder for checkpoints and curves; None writes nothing.
        checkpoint: checkpoint of a resumed run, whose division of the data is kept.
        world: the processes that train together.

    Raises:
        NNodeError: the data are not those of the checkpoint, or options are incompatible.
    """
    world = world or World()
    data: DataOptions = options_of(config.data)
    options: TrainerOptions = options_of(config.trainer)
    optimizer_options: Any = options_of(config.optimizer)
    if needs_full_batch(optimizer_options.name):
        data.loader.batch_size = 0
    if checkpoint is not None and source_hashes(store.manifest) != source_hashes(
        checkpoint.manifest
    ):
        raise ConfigError(
            "the data are not those of the checkpoint: the hashes of the source files differ; "
            "point data.source= at the files it was trained on"
        )
    parts = _parts(store, data, checkpoint)
    exact = optimizer_options.name == "gauss_newton"
    options.drivers = planned(options, model, lambda: [store[i] for i in parts.train], exact)
    source: Source = store
    if options.start_speeds is StartSpeeds.auto:
        source = sound_speeds(store, model.domain, model.order)
        # calibrations to drivers who differ fit start speeds themselves
        fits = exact and options.drivers in (NONE, ALONE) and isinstance(source, SmoothSpeeds)
        options.start_speeds = StartSpeeds.fitted if fits else StartSpeeds.given
    if options.start_speeds is StartSpeeds.fitted and not exact:
        raise ConfigError(
            "trainer.start_speeds=fitted needs optimizer=gauss_newton, found "
            f"optimizer={optimizer_options.name}; data.start_speeds=smoothed takes any"
        )
    seed = int(config.seed)
    loader = make_loader(
        SequenceDataset(source, parts.train),
        data.loader,
        seed=seed,
        rank=world.rank,
        size=world.size,
    )
    heldout = (
        straight_loader(source, parts.heldout, data.loader.batch_size, world)
        if parts.heldout
        else None
    )
    n = substeps(store[0].dt, config.solver.dt, model)
    log.info(
        "%s: %d sequences train, %d held out, %d dropped between; %d steps per sample",
        data.name,
        len(parts.train),
        len(parts.heldout),
        len(parts.dropped),
        n,
    )
    free_speed = None
    if model.domain == "traffic" and world.first:
        free_speed = best_common_speed(batches(store, parts.train, data.loader.batch_size), model)
    names = [entry["name"] for entry in store.index]
    return Trainer(
        model,
        solver,
        build_optimizer(model, optimizer_options, seed),
        loader,
        heldout,
        options,
        folder,
        Provenance(
            config=plain,
            manifest=brief(store.manifest),
            split={part: [names[i] for i in getattr(parts, part)] for part in PARTS},
            free_speed=free_speed,
        ),
        # only forces between people can be drawn
        None if model.domain == "crowd" and model.find(InteractionForce) is None else _forces,
        world,
    )


def _forces(model: System) -> Figure:
    """The force plot of a run's TensorBoard."""
    from nnode.plots import force_figure  # loads Matplotlib, which takes a second

    return force_figure(model)


def brief(manifest: dict[str, Any]) -> dict[str, Any]:
    """A manifest without its long lists, for checkpoints."""
    return {
        key: value
        for key, value in manifest.items()
        if not isinstance(value, list) or len(value) <= 50
    }


def source_hashes(manifest: dict[str, Any]) -> dict[str, str]:
    """SHA-256 of every raw file of a data set."""
    return {name: file["sha256"] for name, file in manifest.get("files", {}).items()}


def positions(store: Source, names: Iterable[str]) -> list[int]:
    """The positions of named sequences in a store."""
    places = {entry["name"]: i for i, entry in enumerate(store.index)}
    return [places[name] for name in names]


def _parts(store: Source, data: DataOptions, checkpoint: Checkpoint | None) -> Split:
    """The division of the sequences; a resumed run keeps that of its checkpoint."""
    saved = {} if checkpoint is None else checkpoint.split
    names = {entry["name"] for entry in store.index}
    if not saved or not {name for part in saved.values() for name in part} <= names:
        return split(store.index, data.split)
    parts = {part: sorted(positions(store, saved.get(part, []))) for part in PARTS}
    return Split(**parts, mode="checkpoint", note="as it was")
