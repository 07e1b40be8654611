"""Checkpoints: atomic writing, safe reading, and all state that a resumed training needs."""

from __future__ import annotations

import io
import os
import warnings
import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nnode.errors import CheckpointError, NNodeError
from nnode.files import disk_words, interpolation, replacing
from nnode.model import System, build_model
from nnode.version import VERSION

#: Version number of the layout of checkpoints.
FORMAT = 1


@dataclass(kw_only=True)
class Checkpoint:
    """All state that a resumed run needs, in plain types and tensors.

    Attributes:
        config: the composed configuration.
        manifest: provenance of the data: sources, hashes, options, counts.
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
    version: str = VERSION

    def build(self) -> System:
        """The model, with the parameters of this checkpoint."""
        try:
            dtype = getattr(torch, self.config["trainer"]["dtype"])
            system = build_model(self.config["model"], self.config["seed"], dtype)
        except NNodeError:
            raise
        except Exception as error:  # unchecked options cause many kinds of errors
            raise CheckpointError(
                "the checkpoint's configuration describes no model "
                f"({type(error).__name__}: {error}); it is damaged: take another checkpoint"
            ) from error
        try:
            system.load_state_dict(self.model)
        except (RuntimeError, TypeError, AttributeError) as error:
            raise CheckpointError(
                f"the checkpoint's parameters do not fit its own model.term="
                f"{self.config['model'].get('term')}: {error}"
            ) from error
        return system


def copied(value: Any) -> Any:
    """Deep copy of nested state with detached tensors on the CPU."""
    if isinstance(value, Tensor):
        return value.detach().cpu().clone()
    if isinstance(value, dict):
        return {key: copied(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(copied(item) for item in value)
    return value


def save_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint atomically.

    Raises:
        WriteError: the disk is full or the folder is not writable; the old file is kept.
    """
    with disk_words(path.parent), replacing(path) as temporary, open(temporary, "wb") as file:
        # written to memory first, because torch's error would hide that the disk is full
        buffer = io.BytesIO()
        torch.save(vars(checkpoint), buffer)
        file.write(buffer.getbuffer())
        file.flush()
        os.fsync(file.fileno())


def load_checkpoint(path: str | os.PathLike[str]) -> Checkpoint:
    """Read a checkpoint with torch's safe loading, which executes no code of the file.

    Raises:
        CheckpointError: the file does not exist, is not a checkpoint, is damaged, has another
            format, or has ``${...}`` in its configuration.
    """
    file = Path(path)
    if not file.is_file():
        raise CheckpointError(f"no checkpoint {file}; {_where(file)}")
    content = _content(file)
    names = {f.name for f in fields(Checkpoint)}
    if not isinstance(content, dict) or not {"format", "model", "config"} <= set(content):
        raise CheckpointError(f"{file} is no checkpoint of this package")
    if not isinstance(content["format"], int) or content["format"] != FORMAT:
        raise CheckpointError(
            f"{file} has checkpoint format {content['format']}, this version reads {FORMAT}; "
            f"it was written by version {content.get('version', 'unknown')}"
        )
    if set(content) != names:
        raise CheckpointError(
            f"{file} is incomplete: {', '.join(sorted(names ^ set(content)))} missing or unknown"
        )
    wrong = [name for name, kind in _KINDS.items() if not isinstance(content[name], kind)]
    wrong += [] if wrong else _wrong_inside(content)
    if wrong:
        raise CheckpointError(
            f"{file} is damaged: {', '.join(wrong)} hold(s) what no checkpoint has there; take "
            "another checkpoint"
        )
    try:
        # every value has at least one byte; cyclic lists have more values than bytes
        limit = file.stat().st_size
        reference = interpolation([content["config"], content["manifest"].get("options")], limit)
    except ValueError as error:
        raise CheckpointError(
            f"{file} is damaged: its configuration has {error}; take another checkpoint"
        ) from error
    if reference is not None:
        raise CheckpointError(
            f"{file} is refused: its configuration holds {reference[:80]!r}, and ${{...}} stands "
            "for values of this machine, such as its environment; no run writes that: take another "
            "checkpoint"
        )
    return Checkpoint(**content)


def _where(file: Path) -> str:
    """A hint to the checkpoints near a path that is not a checkpoint."""
    if file.is_dir():
        near = sorted([*file.glob("*.pt"), *file.glob("checkpoints/*.pt")])
        return f"it is a folder, {f'name {near[0]}' if near else 'expected a file *.pt'}"
    near = sorted(file.parent.glob("*.pt")) if file.parent.is_dir() else []
    if near:
        return f"that folder holds {', '.join(p.name for p in near)}"
    return "a training prints where it leaves them: RUN/checkpoints/best.pt"


#: Types of the fields.
_KINDS: dict[str, Any] = {
    "config": dict,
    "manifest": dict,
    "model": dict,
    "optimizer": dict,
    "progress": dict,
    "history": list,
    "split": dict,
    "free_speed": float | int | None,
    "version": str,
}


def _wrong_inside(content: dict[str, Any]) -> list[str]:
    """Names of the fields whose entries have wrong types."""

    def texts(value: Any) -> bool:
        return isinstance(value, list) and all(isinstance(item, str) for item in value)

    def numbers(value: Any) -> bool:
        return isinstance(value, dict) and all(isinstance(v, int | float) for v in value.values())

    config = content["config"]
    sound = {
        "config": all(isinstance(key, str) for key in config)
        and all(isinstance(config.get(key, {}), dict) for key in _SECTIONS),
        "model": all(isinstance(v, Tensor) for v in content["model"].values()),
        "progress": numbers(content["progress"]),
        "history": all(numbers(row) for row in content["history"]),
        "split": all(isinstance(k, str) and texts(v) for k, v in content["split"].items()),
    }
    return [name for name, good in sound.items() if not good]


#: Parts of the configuration that are mappings.
_SECTIONS = ("model", "data", "solver", "optimizer", "trainer", "groups")


def _content(file: Path) -> Any:
    """The content of the file, read without executing code and in memory of the file's size."""
    try:
        with zipfile.ZipFile(file) as archive:
            records = archive.infolist()
        # torch does not compress; a compressed file could exhaust the memory
        packed = any(record.compress_type != zipfile.ZIP_STORED for record in records)
        if packed or sum(record.file_size for record in records) > file.stat().st_size:
            raise ValueError("its records are packed")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns of damaged files
            return torch.load(file, map_location="cpu", weights_only=True)
    except PermissionError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror}") from error
    except Exception as error:  # damaged files cause many kinds of errors
        raise CheckpointError(
            f"{file} cannot be opened as a checkpoint: it is damaged or of another kind "
            f"({type(error).__name__})"
        ) from error


def load(path: str | os.PathLike[str]) -> System:
    """The calibrated model of a checkpoint, ready for simulation.

    Raises:
        CheckpointError: see :func:`load_checkpoint`.
    """
    return load_checkpoint(path).build()
