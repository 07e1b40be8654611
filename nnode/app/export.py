"""A run's results in the formats of other programs: ``nnode export``."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.runs import RESULT
from nnode.app.cli.saved import merge_saved, path_given, saved_groups
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
from nnode.errors import ConfigError
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

#: What can be written, in the order in which it is.
TARGETS = ("jupedsim", "sumo", "pedpy", "fcd", "parquet", "csv")

#: Which trajectories ``trajectories=`` asks for.
SOURCES = {
    "measured": ("measured",),
    "simulated": ("simulated",),
    "both": ("measured", "simulated"),
}

#: Where a training or a diagnosis leaves its calibrated model.
BEST = Path("checkpoints") / "best.pt"


def checkpoint_of(run: str) -> Path:
    """The checkpoint of a run's folder; a path to a checkpoint is taken as it stands."""
    place = Path(run).expanduser()
    return place if place.suffix == ".pt" else place / BEST


def intervals_of(run: str) -> Intervals:
    """What a run's ``result.json`` says of its parameters; nothing where it is not there."""
    path = checkpoint_of(run).parent.parent / RESULT
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["parameters"]
    except (OSError, ValueError, KeyError):
        return {}
    return found if isinstance(found, dict) else {}


def groups_of_run(overrides: list[str]) -> list[str]:
    """Overrides that choose the run's own data and solver where the user chooses none."""
    run = path_given(overrides, "run")
    told = [] if run is None else [f"checkpoint={checkpoint_of(run)}"]
    return saved_groups([*overrides, *told], "checkpoint", ("data", "solver"))


@dataclass
class _Export:
    """What all writers look at."""

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
        found: torch.dtype = getattr(torch, self.checkpoint.config["trainer"]["dtype"])
        return found

    def trajectories(self, source: str) -> Iterator[Sequence]:
        measured = (self.sequences[i] for i in range(len(self.sequences)))
        if source == "measured":
            return measured
        size = self.batch_size or len(self.sequences)
        return simulated(self.simulate, measured, size=size, dtype=self.dtype, device=self.device)


def export(config: DictConfig, folder: Path) -> None:
    """Write what is asked for, say where it is and what had no counterpart.

    Raises:
        NNodeError: no such run or data, an unknown target, or one that the model does not have.
    """
    checkpoint = load_checkpoint(checkpoint_of(config.run))
    config = with_prepared(merge_saved(config, checkpoint.config, ("data", "solver")))
    model = checkpoint.build()
    targets = targets_of(config.to, model)
    if config.trajectories not in SOURCES:
        raise ConfigError(
            f"trajectories={config.trajectories} is unknown, expected {', '.join(SOURCES)}"
        )
    data: DataOptions = OmegaConf.to_object(config.data)  # type: ignore[assignment]
    solver_options: SolverOptions = OmegaConf.to_object(config.solver)  # type: ignore[assignment]
    set_threads(checkpoint.config["trainer"]["threads"], data.domain)
    store = open_data(data, folder / "data")
    part, indices, _ = choose(store, checkpoint, config.part)
    device = World().use(Device(config.device), "device")
    model, solver = model.to(device), build_solver(solver_options, device)
    model.scene(next(stream(straight_loader(store, indices[:1], 1))))  # of the data's domain
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
    told: dict[str, Any] = {}
    for target in targets:
        files, counterpart = WRITERS[target](job)
        told[target] = {
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
    account = {"run": str(config.run), "part": part, "sequences": len(indices), "written": told}
    write_json(folder / "export.json", account)
    print(f"account: {folder / 'export.json'}")


def targets_of(asked: Any, model: System) -> list[str]:
    """What is to be written, in the order of :data:`TARGETS`.

    Raises:
        ConfigError: nothing, or a target that there is not.
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
            raise ConfigError(f"to={name} is unknown, expected auto or any of {', '.join(TARGETS)}")
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
    found = jupedsim_parameters(job.model, scenes, job.intervals)
    return [write_text(job.folder / "jupedsim.json", found.text + "\n")], found


def _sumo(job: _Export) -> _Written:
    speed, length = traffic_of(job.trajectories("measured"))
    found = sumo_type(job.model, _label(job.checkpoint), speed, length, job.intervals)
    return [write_text(job.folder / "vtype.add.xml", found.text)], found


def _paths(name: str, job: _Export) -> _Written:
    files: list[Path] = []
    for source in job.sources:
        paths = job.trajectories(source)
        files += write_trajectories(job.folder, source, name, paths, job.model.dim)
    return files, Counterpart()


def _parquet(job: _Export) -> _Written:
    files, found = _paths("parquet", job)
    path, sets = write_walls(job.folder / "walls.csv", job.trajectories("measured"))
    files += [] if path is None else [path]
    if sets > 1:
        found.missing.append(f"walls: the sequences have {sets} sets, a table has one")
    return files, found


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
