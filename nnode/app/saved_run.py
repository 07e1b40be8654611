"""A saved calibration and the sequences that it is applied to, for commands and for Python."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import torch
from omegaconf import DictConfig

from nnode.app.calibration import Calibration
from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.runs import RESULT
from nnode.app.cli.saved import checkpoint_of, load_run, merge_saved, options_of
from nnode.app.python.inputs import Table, data_used
from nnode.app.training import batches, build_solver, set_threads, source_hashes
from nnode.calibrate.checkpoint import Checkpoint
from nnode.calibrate.cost import Convention
from nnode.calibrate.distributed import World
from nnode.calibrate.options import Device, StartSpeeds
from nnode.data.dataset import Source, sound_speeds
from nnode.data.prepare import NOT_PREPARATION, open_data
from nnode.data.sequence import Batch
from nnode.data.sequences import Sequences
from nnode.data.store import Store
from nnode.errors import CheckpointError, ConfigError, unknown_value
from nnode.model import System
from nnode.simulation import Solver
from nnode.simulation.base import Trajectory

PARTS = ("auto", "heldout", "train", "unseen", "all")


@dataclass(frozen=True)
class SavedRun:
    """A checkpoint's model, and the sequences that it is applied to.

    Attributes:
        checkpoint: the checkpoint.
        config: options of ``data`` and ``solver``, and in some commands the ``device``.
        measured: all sequences, as they were measured.
        part, indices, trained: the chosen sequences, see :func:`choose`.
    """

    checkpoint: Checkpoint
    config: Any
    measured: Source
    part: str
    indices: list[int]
    trained: int | None

    @classmethod
    def of_command(cls, checkpoint: Checkpoint, config: DictConfig, folder: Path) -> Self:
        """Read the data of a command whose defaults are those of the checkpoint.

        Args:
            config: the command's configuration, see :func:`opened`, with ``part``.
            folder: folder of the command's results.

        Raises:
            NNodeError: the data do not exist, or have no sequences of the part.
        """
        return cls._chosen(checkpoint, *opened(checkpoint, config, folder), config.part)

    @classmethod
    def of_python(
        cls, run: str | Path | Calibration, data: Table | Sequences | None, part: str
    ) -> Self:
        """A run in Python.

        Args:
            run: folder of a run, a checkpoint, or a calibration.
            data: the data; None takes those of the run.

        Raises:
            NNodeError: the run or the data do not exist, or have no sequences of the part.
        """
        checkpoint = run.checkpoint if isinstance(run, Calibration) else load_run(run)
        store = data_used(checkpoint) if data is None else Sequences.of(data)
        return cls._chosen(checkpoint, checkpoint.config, store, part)

    @classmethod
    def _chosen(cls, checkpoint: Checkpoint, config: Any, store: Source, part: str) -> Self:
        run = cls(checkpoint, config, store, *choose(store, checkpoint, part))
        set_threads(checkpoint.config["trainer"]["threads"], run.model.domain)
        return run

    @property
    def name(self) -> str:
        """Name of the model."""
        return str(self.checkpoint.config["model"]["name"])

    @property
    def data(self) -> str:
        """Name of the data."""
        return str(self.config["data"]["name"])

    @property
    def batch_size(self) -> int:
        """Number of sequences that are simulated at once; 0 for all."""
        return int(self.config["data"]["loader"]["batch_size"])

    @property
    def dtype(self) -> torch.dtype:
        """Floating-point type of the training."""
        dtype: torch.dtype = getattr(torch, self.checkpoint.config["trainer"]["dtype"])
        return dtype

    @property
    def convention(self) -> Convention:
        """The cost of the training."""
        return Convention(self.checkpoint.config["trainer"]["cost"])

    @cached_property
    def device(self) -> torch.device:
        """The device of simulations."""
        return World().use(Device(self.config.get("device", Device.cpu)), "device")

    @cached_property
    def model(self) -> System:
        """The calibrated model, on the device."""
        return self.checkpoint.build().to(self.device)

    @cached_property
    def solver(self) -> Solver:
        """The solver of a command."""
        return build_solver(options_of(self.config.solver), self.device)

    @cached_property
    def source(self) -> Source:
        """All sequences with the speeds with which simulations start, as in the training."""
        if self.checkpoint.config["trainer"].get("start_speeds") != StartSpeeds.auto.value:
            return self.measured
        return sound_speeds(self.measured, self.model.domain, self.model.order)

    def simulate(self, batch: Batch) -> Trajectory:
        """Simulate a batch by the model."""
        return self.solver(self.model, batch)

    def batches(self) -> Iterator[Batch]:
        """The chosen sequences with their start speeds, in batches on the device."""
        return batches(self.source, self.indices, self.batch_size, self.dtype, self.device)


def opened(checkpoint: Checkpoint, config: DictConfig, folder: Path) -> tuple[DictConfig, Store]:
    """A command's configuration with the options of a checkpoint as defaults, and its data.

    Args:
        config: the configuration, with ``data`` and, in commands that simulate, ``solver``.
        folder: folder of the command's results.

    Raises:
        NNodeError: the data do not exist.
    """
    sections = tuple(name for name in ("data", "solver") if name in config)
    config = with_prepared(merge_saved(config, checkpoint.config, sections))
    return config, open_data(options_of(config.data), folder / "data")


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


def result_of(run: str | Path) -> dict[str, Any]:
    """The content of a run's ``result.json``.

    Raises:
        CheckpointError: the file is missing or damaged.
    """
    path = _result_file(run)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path} cannot be read; give the folder of a complete training"
        ) from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{path} has no entries; give the folder of a complete training")
    return content


def _result_file(run: str | Path) -> Path:
    return checkpoint_of(run).parent.parent / RESULT


def drivers_of(run: str | Path | Calibration) -> Any:
    """What :meth:`nnode.app.drivers.Drivers.plain` gave for a run; None if its drivers do not
    differ, or if it has no ``result.json``, as a diagnosis.

    Raises:
        CheckpointError: see :func:`result_of`.
    """
    if isinstance(run, Calibration):
        return None if run.drivers is None else run.drivers.plain()
    if not _result_file(run).exists():
        return None
    return result_of(run).get("drivers")
