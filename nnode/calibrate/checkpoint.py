"""Checkpoints: written atomically, opened safely, enough to rebuild a model or go on training."""

from __future__ import annotations

import os
import pickle
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import nnode
from nnode.errors import CheckpointError
from nnode.models import System, build_model

#: Raised when the layout of a checkpoint changes.
FORMAT = 1


@dataclass(kw_only=True)
class Checkpoint:
    """Everything a run needs to go on, in plain types and tensors.

    Attributes:
        config: the composed configuration.
        manifest: where the data came from: sources, hashes, options, counts.
        model: the model's ``state_dict``.
        optimizer: the optimiser's ``state_dict``.
        progress: epoch, mini-batch and step counters, running sums, best value so far.
        history: one row of scalars per evaluation.
        split: names of the training and of the held-out sequences.
        free_speed: the common speed (m/s) that fits the training data best without any
            interaction; None for crowds.
        format, version: layout of the file, version of the package.
    """

    config: dict[str, Any]
    manifest: dict[str, Any]
    model: dict[str, Tensor]
    optimizer: dict[str, Any]
    progress: dict[str, Any]
    history: list[dict[str, float]] = field(default_factory=list)
    split: dict[str, list[str]] = field(default_factory=dict)
    free_speed: float | None = None
    format: int = FORMAT
    version: str = nnode.__version__

    def build(self) -> System:
        """The model, with the parameters of this checkpoint."""
        dtype = getattr(torch, self.config["trainer"]["dtype"])
        system = build_model(self.config["model"], self.config["seed"], dtype)
        try:
            system.load_state_dict(self.model)
        except RuntimeError as error:
            raise CheckpointError(
                f"the checkpoint's parameters do not fit its own model.term="
                f"{self.config['model'].get('term')}: {error}"
            ) from error
        return system


def save_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write ``path`` so that at every moment it is either the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(temporary, "wb") as file:
            torch.save({f.name: getattr(checkpoint, f.name) for f in fields(checkpoint)}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def load_checkpoint(path: str | os.PathLike[str]) -> Checkpoint:
    """Read a checkpoint with torch's safe loading: no code in it is executed.

    Raises:
        CheckpointError: no such file, not a checkpoint, damaged, or of another format.
    """
    file = Path(path)
    if not file.is_file():
        near = sorted(file.parent.glob("*.pt")) if file.parent.is_dir() else []
        hint = f"; that folder holds {', '.join(p.name for p in near)}" if near else ""
        raise CheckpointError(f"no checkpoint {file}{hint}")
    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError, OSError) as error:
        raise CheckpointError(
            f"{file} cannot be opened as a checkpoint: it is damaged or of another kind "
            f"({type(error).__name__})"
        ) from error
    names = {f.name for f in fields(Checkpoint)}
    if not isinstance(content, dict) or not {"format", "model", "config"} <= set(content):
        raise CheckpointError(f"{file} is no checkpoint of this package")
    if content["format"] != FORMAT:
        raise CheckpointError(
            f"{file} has checkpoint format {content['format']}, this version reads {FORMAT}; "
            f"it was written by version {content.get('version', 'unknown')}"
        )
    if set(content) != names:
        raise CheckpointError(
            f"{file} is incomplete: {', '.join(sorted(names ^ set(content)))} missing or unknown"
        )
    return Checkpoint(**content)


def load(path: str | os.PathLike[str]) -> System:
    """The calibrated model of a checkpoint, ready for simulation.

    Raises:
        CheckpointError: see :func:`load_checkpoint`.
    """
    return load_checkpoint(path).build()
