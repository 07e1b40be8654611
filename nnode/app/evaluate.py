"""Errors of a checkpoint and of baselines: ``nnode evaluate``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.saved import merge_saved, options_of
from nnode.app.training import (
    batches,
    build_solver,
    set_threads,
    source_hashes,
    started,
)
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint
from nnode.calibrate.cost import Convention
from nnode.calibrate.distributed import World
from nnode.calibrate.evaluate import Metrics, Simulate, baselines, evaluate
from nnode.calibrate.options import Device, SolverOptions
from nnode.data.dataset import Source
from nnode.data.options import DataOptions
from nnode.data.prepare import NOT_PREPARATION, open_data
from nnode.data.sequence import Batch
from nnode.data.store import Store
from nnode.errors import ConfigError, unknown_value
from nnode.files import write_json
from nnode.model import System
from nnode.progress import Stages
from nnode.simulation import Solver
from nnode.simulation.base import Trajectory

PARTS = ("auto", "heldout", "train", "unseen", "all")


def choose(store: Source, checkpoint: Checkpoint, part: str) -> tuple[str, list[int], int | None]:
    """Select the sequences of a store for an evaluation.

    ``heldout`` and ``train`` are the checkpoint's parts. ``unseen`` are sequences that it neither
    trained on nor dropped. ``auto`` takes the held-out sequences if there are any, or else the
    unseen ones, or else all.

    Returns:
        The part, its positions in the store, and the number of trained sequences among them, which
        is None if the same files were cut into sequences in another way.

    Raises:
        ConfigError: an unknown part, or a part without sequences.
    """
    if part not in PARTS:
        raise unknown_value("part", part, PARTS)
    before = set(source_hashes(checkpoint.manifest).values())
    shared = bool(before & set(source_hashes(store.manifest).values()))
    comparable = not shared or _cut_alike(store.manifest, checkpoint.manifest)
    saved = checkpoint.split if shared and comparable else {}
    names = [entry["name"] for entry in store.index]
    train, dropped = (set(saved.get(key, [])) for key in ("train", "dropped"))
    members = {
        "heldout": saved.get("heldout", []),
        "train": train,
        "unseen": set(names) - train - dropped if comparable else (),
        "all": names,
    }
    indices = {
        key: [i for i, name in enumerate(names) if name in chosen]
        for key, chosen in members.items()
    }
    if part == "auto":
        part = next(name for name in ("heldout", "unseen", "all") if indices[name])
    if not indices[part]:
        raise ConfigError(
            f"part={part}: these data have no such sequences of the checkpoint; use part=all"
        )
    trained = len(set(indices[part]) & set(indices["train"])) if comparable else None
    return part, indices[part], trained


def _cut_alike(*manifests: dict[str, Any]) -> bool:
    """Whether files were cut into sequences in the same way.

    Options that an earlier version did not have are not compared.
    """
    first, second = ({**m.get("options", {}), "reader": m.get("reader")} for m in manifests)
    ignored = ("recording", "faults", "agents", "path", "name", *NOT_PREPARATION)
    return all(first[key] == second[key] for key in first.keys() & second.keys() - {*ignored})


@dataclass(frozen=True)
class SavedRun:
    """A checkpoint's model, and sequences that it can be evaluated on.

    Attributes:
        checkpoint: the checkpoint.
        data: options of the data.
        store: all sequences.
        part, indices, trained: the chosen sequences, see :func:`choose`.
        model: the model, on the device.
        solver: the solver.
        device: the device.
    """

    checkpoint: Checkpoint
    data: DataOptions
    store: Store
    part: str
    indices: list[int]
    trained: int | None
    model: System
    solver: Solver
    device: torch.device

    @classmethod
    def of(cls, checkpoint: Checkpoint, config: DictConfig, folder: Path) -> SavedRun:
        """Read the data of a command whose defaults are those of the checkpoint.

        Args:
            config: the command's configuration, with ``data``, ``solver``, ``part`` and ``device``.
            folder: folder of the command's results.

        Raises:
            NNodeError: the data do not exist, or have no sequences of the part.
        """
        config = with_prepared(merge_saved(config, checkpoint.config, ("data", "solver")))
        data: DataOptions = options_of(config.data)
        solver_options: SolverOptions = options_of(config.solver)
        set_threads(checkpoint.config["trainer"]["threads"], data.domain)
        store = open_data(data, folder / "data")
        device = World().use(Device(config.device), "device")
        solver = build_solver(solver_options, device)
        chosen = choose(store, checkpoint, config.part)
        return cls(checkpoint, data, store, *chosen, checkpoint.build().to(device), solver, device)

    @property
    def name(self) -> str:
        """Name of the model."""
        return str(self.checkpoint.config["model"]["name"])

    @property
    def dtype(self) -> torch.dtype:
        """Floating-point type of the training."""
        dtype: torch.dtype = getattr(torch, self.checkpoint.config["trainer"]["dtype"])
        return dtype

    @property
    def convention(self) -> Convention:
        """The cost of the training."""
        return Convention(self.checkpoint.config["trainer"]["cost"])

    def simulate(self, batch: Batch) -> Trajectory:
        """Simulate a batch by the model."""
        return self.solver(self.model, batch)

    def batches(self, store: Source) -> Iterator[Batch]:
        """The chosen sequences of a store, in batches on the device."""
        size = self.data.loader.batch_size
        return batches(store, self.indices, size, self.dtype, self.device)


def evaluate_checkpoint(config: DictConfig, folder: Path) -> None:
    """Write ``metrics.json`` and ``replay.html``, and print errors of the model and baselines.

    For lanes, the errors of every follower are printed and written as well.

    Raises:
        NNodeError: the checkpoint or the data do not exist, or the data have another domain.
    """
    checkpoint = load_checkpoint(config.checkpoint)
    run = SavedRun.of(checkpoint, config, folder)
    if run.trained is None:
        print("these files were cut into sequences in another way than in training: some of what")
        print("is evaluated may have been trained on")
    elif run.trained and run.part != "train":
        print(f"{run.trained} of the {len(run.indices)} sequences were trained on")
    source = started(checkpoint, run.store)
    others = baselines(run.model, run.solver, checkpoint.free_speed)

    def measured(title: str, simulate: Simulate) -> Metrics:
        stages.begin(title)
        return evaluate(simulate, run.batches(source), run.convention)

    shares = {run.name: 1.0, **{f"baseline {key}": 0.5 for key in others}}
    with Stages("evaluating", shares) as stages:
        metrics = measured(run.name, run.simulate)
        errors = {key: measured(f"baseline {key}", other) for key, other in others.items()}
    write_json(
        folder / "metrics.json",
        {
            **metrics.plain(),
            "model": run.name,
            "data": run.data.name,
            "part": run.part,
            "trained_on": run.trained,
            "unit": run.convention.unit,
            # the usual name in car following
            **({"spacing_rmse": metrics.objectives["spacing"]} if metrics.objectives else {}),
            "parameters": {k: float(v) for k, (v, _) in run.model.physical().items()},
            "free_speed": checkpoint.free_speed,
            "baselines": {key: error.plain() for key, error in errors.items()},
        },
    )
    _print(
        {run.name: metrics, **errors},
        f"{run.data.name}, {run.part}: {metrics.sequences} sequences",
        run.convention,
    )
    if run.data.domain == "traffic":
        from nnode.app.followers import follower_errors, write_followers  # loads Matplotlib

        rows = follower_errors(run.simulate, run.batches(source), run.store.index)
        if len(rows):
            write_followers(rows, folder)
    print(f"metrics: {folder / 'metrics.json'}")
    if config.replay:
        from nnode.app.replay import write_replay  # loads Matplotlib, which takes a second

        with Stages("drawing", {"drawing": 1.0}) as stages:
            stages.begin("drawing")
            path = write_replay(
                folder / "replay.html",
                run.store,
                run.indices,
                run.simulate,
                run.model,
                run.name,
                dtype=run.dtype,
                device=run.device,
            )
        print(f"replay: {path}")


def _print(rows: dict[str, Metrics], title: str, convention: Convention) -> None:
    table = Table(title=title)
    unit = convention.unit
    heads = ("", f"J ({unit})", "RMSE (m)", "final displacement (m)", "collisions (%)")
    last = next(iter(rows.values())).horizons
    chosen = sorted({len(last) // 4, len(last) // 2, len(last) - 1} & set(range(len(last))))
    for head in (*heads, *(f"RMSE at {last[i]['t']:g} s" for i in chosen)):
        table.add_column(head, justify="right")
    for name, m in rows.items():
        values = (m.J, m.rmse, m.final_displacement, 100 * m.collisions)
        at = (m.horizons[i]["rmse"] for i in chosen)
        table.add_row(name, *(f"{value:.4g}" for value in (*values, *at)))
    Console(width=140).print(table)
