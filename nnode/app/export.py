"""Export of a run's results to other programs: ``nnode export``."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.runs import RESULT
from nnode.app.cli.saved import merge_saved, options_of, path_given, saved_groups
from nnode.app.evaluate import choose
from nnode.app.training import build_solver, set_threads, straight_loader, stream
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint
from nnode.calibrate.cost import Convention
from nnode.calibrate.distributed import World
from nnode.calibrate.evaluate import Simulate, evaluate
from nnode.calibrate.options import Device, SolverOptions
from nnode.data.dataset import SequenceDataset
from nnode.data.options import DataOptions
from nnode.data.prepare import open_data
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError, unknown_value
from nnode.exchange.counterpart import Counterpart, Intervals
from nnode.exchange.jupedsim import has_parameters, jupedsim_parameters, scenes_of
from nnode.exchange.sumo import has_type, sumo_type, traffic_of
from nnode.exchange.tables import write_results
from nnode.exchange.trajectories import (
    FORMATS,
    check_format,
    simulated,
    write_trajectories,
    write_walls,
)
from nnode.files import write_json, write_text
from nnode.model import System

#: Targets, in the order of writing.
TARGETS = ("jupedsim", "sumo", "pedpy", "fcd", "parquet", "csv")

#: Value of ``trajectories=`` to the sets of trajectories.
SOURCES = {
    "measured": ("measured",),
    "simulated": ("simulated",),
    "both": ("measured", "simulated"),
}

#: Place of the calibrated model in the folder of a training or a diagnosis.
BEST = Path("checkpoints") / "best.pt"


def checkpoint_of(run: str) -> Path:
    """The checkpoint in a run's folder; a path to a checkpoint is returned unchanged."""
    place = Path(run).expanduser()
    return place if place.suffix == ".pt" else place / BEST


def intervals_of(run: str) -> Intervals:
    """The parameters in a run's ``result.json``; empty without the file."""
    path = checkpoint_of(run).parent.parent / RESULT
    try:
        parameters = json.loads(path.read_text(encoding="utf-8"))["parameters"]
    except (OSError, ValueError, KeyError):
        return {}
    return parameters if isinstance(parameters, dict) else {}


def groups_of_run(overrides: list[str]) -> list[str]:
    """Overrides that choose the run's data and solver if the user chooses none."""
    run = path_given(overrides, "run")
    checkpoint = [] if run is None else [f"checkpoint={checkpoint_of(run)}"]
    return saved_groups([*overrides, *checkpoint], "checkpoint", ("data", "solver"))


@dataclass
class _Export:
    """Arguments of all writers."""

    folder: Path
    checkpoint: Checkpoint
    model: System
    simulate: Simulate
    sequences: SequenceDataset
    device: torch.device
    sources: tuple[str, ...]
    batch_size: int
    intervals: Intervals

    @property
    def dtype(self) -> torch.dtype:
        dtype: torch.dtype = getattr(torch, self.checkpoint.config["trainer"]["dtype"])
        return dtype

    def trajectories(self, source: str) -> Iterator[Sequence]:
        measured = (self.sequences[i] for i in range(len(self.sequences)))
        if source == "measured":
            return measured
        size = self.batch_size or len(self.sequences)
        return simulated(self.simulate, measured, size=size, dtype=self.dtype, device=self.device)


def export(config: DictConfig, folder: Path) -> None:
    """Write the targets, and print their places and what had no counterpart.

    Raises:
        NNodeError: the run or the data do not exist, or a target is unknown or does not fit the
            model.
    """
    checkpoint = load_checkpoint(checkpoint_of(config.run))
    config = with_prepared(merge_saved(config, checkpoint.config, ("data", "solver")))
    model = checkpoint.build()
    targets = targets_of(config.to, model)
    if config.trajectories not in SOURCES:
        raise unknown_value("trajectories", config.trajectories, SOURCES)
    data: DataOptions = options_of(config.data)
    solver_options: SolverOptions = options_of(config.solver)
    set_threads(checkpoint.config["trainer"]["threads"], data.domain)
    store = open_data(data, folder / "data")
    part, indices, _ = choose(store, checkpoint, config.part)
    device = World().use(Device(config.device), "device")
    model, solver = model.to(device), build_solver(solver_options, device)
    model.scene(next(stream(straight_loader(store, indices[:1], 1))))  # checks the domain
    job = _Export(
        folder=folder,
        checkpoint=checkpoint,
        model=model,
        simulate=lambda batch: solver(model, batch),
        sequences=SequenceDataset(store, indices),
        device=device,
        sources=SOURCES[config.trajectories],
        batch_size=data.loader.batch_size,
        intervals=intervals_of(config.run),
    )
    print(f"{data.name}, {part}: {len(indices)} sequences, model {_label(checkpoint)}")
    written: dict[str, Any] = {}
    for target in targets:
        files, counterpart = WRITERS[target](job)
        written[target] = {
            "files": [str(path.relative_to(folder)) for path in files],
            "notes": counterpart.notes,
            "no_counterpart": counterpart.missing,
        }
        place = files[0] if len(files) == 1 else os.path.commonpath(files)
        number = "" if len(files) == 1 else f" ({len(files)} files)"
        print(f"{target}: {place}{number}")
        for line in counterpart.notes:
            print(f"  {line}")
        for line in counterpart.missing:
            print(f"  no counterpart: {line}")
    account = {"run": str(config.run), "part": part, "sequences": len(indices), "written": written}
    write_json(folder / "export.json", account)
    print(f"account: {folder / 'export.json'}")


def targets_of(asked: Any, model: System) -> list[str]:
    """The targets to write, in the order of :data:`TARGETS`.

    Raises:
        ConfigError: no target, or an unknown one.
    """
    if asked == "auto":
        fit = {"parquet", "csv"}
        if has_parameters(model):
            fit.add("jupedsim")
        if has_type(model):
            fit.add("sumo")
        fit.add("pedpy" if model.domain == "crowd" else "fcd")
        return [name for name in TARGETS if name in fit]
    names = [asked] if isinstance(asked, str) else list(asked or [])
    for name in names:
        if name not in TARGETS:
            raise unknown_value("to", name, ("auto", *TARGETS))
        if name in FORMATS:
            check_format("to", name, model.domain)
    if not names:
        raise ConfigError(f"to=[]: expected auto or any of {', '.join(TARGETS)}")
    return [name for name in TARGETS if name in names]


def _label(checkpoint: Checkpoint) -> str:
    return str(checkpoint.config["model"]["name"])


_Written = tuple[list[Path], Counterpart]


def _jupedsim(job: _Export) -> _Written:
    scenes = scenes_of(job.trajectories("measured"), job.model.wall_spacing)
    counterpart = jupedsim_parameters(job.model, scenes, job.intervals)
    return [write_text(job.folder / "jupedsim.json", counterpart.text + "\n")], counterpart


def _sumo(job: _Export) -> _Written:
    speed, length = traffic_of(job.trajectories("measured"))
    counterpart = sumo_type(job.model, _label(job.checkpoint), speed, length, job.intervals)
    return [write_text(job.folder / "vtype.add.xml", counterpart.text)], counterpart


def _paths(name: str, job: _Export) -> _Written:
    files: list[Path] = []
    for source in job.sources:
        paths = job.trajectories(source)
        files += write_trajectories(job.folder, source, name, paths, job.model.dim)
    return files, Counterpart()


def _parquet(job: _Export) -> _Written:
    files, counterpart = _paths("parquet", job)
    path, sets = write_walls(job.folder / "walls.csv", job.trajectories("measured"))
    files += [] if path is None else [path]
    if sets > 1:
        counterpart.missing.append(f"walls: the sequences have {sets} sets, a table has one")
    return files, counterpart


def _csv(job: _Export) -> _Written:
    convention = Convention(job.checkpoint.config["trainer"]["cost"])
    loader = straight_loader(job.sequences.store, list(job.sequences.indices), job.batch_size)
    metrics = evaluate(job.simulate, stream(loader, job.dtype, job.device), convention)
    unit = convention.unit
    folder = job.folder / "csv"
    return write_results(folder, job.checkpoint, job.model, metrics, unit), Counterpart()


WRITERS: dict[str, Callable[[_Export], _Written]] = {
    "jupedsim": _jupedsim,
    "sumo": _sumo,
    "pedpy": partial(_paths, "pedpy"),
    "fcd": partial(_paths, "fcd"),
    "parquet": _parquet,
    "csv": _csv,
}
