"""Export of a run's results to other programs: ``nnode export``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig

from nnode.app.cli.saved import load_run
from nnode.app.saved_run import SavedRun, result_of
from nnode.calibrate.evaluate import evaluate
from nnode.data.sequence import Sequence
from nnode.errors import CheckpointError, ConfigError, unknown_value
from nnode.exchange.counterpart import Counterpart, Intervals
from nnode.exchange.jupedsim import has_parameters, jupedsim_parameters, scenes_of
from nnode.exchange.sumo import has_type, sumo_type, traffic_of
from nnode.exchange.trajectories import (
    FORMATS,
    check_format,
    simulated,
    write_trajectories,
    write_walls,
)
from nnode.files import write_csv, write_json, write_text
from nnode.model import System

#: Value of ``trajectories=`` to the sets of trajectories.
SOURCES = {
    "measured": ("measured",),
    "simulated": ("simulated",),
    "both": ("measured", "simulated"),
}


def intervals_of(run: str) -> Intervals:
    """The parameters in a run's ``result.json``; empty without the file."""
    try:
        parameters = result_of(run)["parameters"]
    except (CheckpointError, KeyError):
        return {}
    return parameters if isinstance(parameters, dict) else {}


@dataclass(frozen=True)
class _Export:
    """Arguments of all writers."""

    run: SavedRun
    folder: Path
    sources: tuple[str, ...]
    intervals: Intervals

    def trajectories(self, source: str) -> Iterator[Sequence]:
        run = self.run
        if source == "measured":
            return (run.measured[i] for i in run.indices)
        started = (run.source[i] for i in run.indices)
        size = run.batch_size or len(run.indices)
        return simulated(run.simulate, started, size=size, dtype=run.dtype, device=run.device)


def export(config: DictConfig, folder: Path) -> None:
    """Write the targets, and print their places and what had no counterpart.

    Raises:
        NNodeError: the run or the data do not exist, or a target is unknown or does not fit the
            model.
    """
    checkpoint = load_run(config.run)
    targets = targets_of(config.to, checkpoint.build())
    if config.trajectories not in SOURCES:
        raise unknown_value("trajectories", config.trajectories, SOURCES)
    run = SavedRun.of_command(checkpoint, config, folder)
    run.model.scene(next(run.batches()))  # checks the domain
    job = _Export(run, folder, SOURCES[config.trajectories], intervals_of(config.run))
    number = len(run.indices)
    print(f"{run.data}, {run.part}: {number} sequences, model {run.name}")
    written: dict[str, Any] = {}
    for target in targets:
        files, counterpart = WRITERS[target](job)
        written[target] = {
            "files": [str(path.relative_to(folder)) for path in files],
            "notes": counterpart.notes,
            "no_counterpart": counterpart.missing,
        }
        place = files[0] if len(files) == 1 else os.path.commonpath(files)
        print(f"{target}: {place}" + (f" ({len(files)} files)" if len(files) > 1 else ""))
        for line in counterpart.lines:
            print(f"  {line}")
    write_json(
        folder / "export.json",
        {"run": str(config.run), "part": run.part, "sequences": number, "written": written},
    )
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


_Written = tuple[list[Path], Counterpart]


def _jupedsim(job: _Export) -> _Written:
    scenes = scenes_of(job.trajectories("measured"), job.run.model.wall_spacing)
    counterpart = jupedsim_parameters(job.run.model, scenes, job.intervals)
    return [write_text(job.folder / "jupedsim.json", counterpart.text + "\n")], counterpart


def _sumo(job: _Export) -> _Written:
    speed, length = traffic_of(job.trajectories("measured"))
    counterpart = sumo_type(job.run.model, job.run.name, speed, length, job.intervals)
    return [write_text(job.folder / "vtype.add.xml", counterpart.text)], counterpart


def _paths(name: str, job: _Export) -> _Written:
    files: list[Path] = []
    for source in job.sources:
        paths = job.trajectories(source)
        files += write_trajectories(job.folder, source, name, paths, job.run.model.dim)
    return files, Counterpart()


def _parquet(job: _Export) -> _Written:
    files, counterpart = _paths("parquet", job)
    path, sets = write_walls(job.folder / "walls.csv", job.trajectories("measured"))
    files += [] if path is None else [path]
    if sets > 1:
        counterpart.missing.append(f"walls: the sequences have {sets} sets, a table has one")
    return files, counterpart


def _csv(job: _Export) -> _Written:
    """The tables ``parameters``, ``history``, ``sequences`` and ``horizons``, one value per row."""
    run, unit = job.run, job.run.convention.unit
    metrics = evaluate(run.simulate, run.batches(), run.convention)
    part = {name: key for key, names in run.checkpoint.split.items() for name in names}
    physical = run.model.physical()
    values = [(name, float(value), units) for name, (value, units) in physical.items()]
    costs = [(name, part.get(name, ""), cost, unit) for name, cost in metrics.costs.items()]
    history = [
        (row.get("epoch"), name, value)
        for row in run.checkpoint.history
        for name, value in row.items()
        if name != "epoch"
    ]
    tables = {
        "parameters": pd.DataFrame(values, columns=["parameter", "value", "unit"]),
        "history": pd.DataFrame(history, columns=["epoch", "quantity", "value"]),
        "sequences": pd.DataFrame(costs, columns=["sequence", "part", "cost", "unit"]),
        "horizons": pd.DataFrame(metrics.horizons, columns=["t", "rmse", "n"]).set_axis(
            ["time_s", "rmse_m", "samples"], axis=1
        ),
    }
    files = [write_csv(job.folder / "csv" / f"{name}.csv", t) for name, t in tables.items()]
    return files, Counterpart()


WRITERS: dict[str, Callable[[_Export], _Written]] = {
    "jupedsim": _jupedsim,
    "sumo": _sumo,
    "pedpy": partial(_paths, "pedpy"),
    "fcd": partial(_paths, "fcd"),
    "parquet": _parquet,
    "csv": _csv,
}
#: Targets, in the order of writing.
TARGETS = tuple(WRITERS)
