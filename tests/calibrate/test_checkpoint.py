"""Checkpoints: atomic, safe, complete."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import pytest
import torch

import nnode
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from nnode.calibrate.trainer import Trainer
from nnode.errors import CheckpointError

Make = Callable[..., Trainer]


@pytest.fixture
def saved(make_trainer: Make, tmp_path: Path) -> Path:
    trainer = make_trainer(tmp_path, max_epochs=2)
    trainer.fit()
    return trainer.last_path


def test_load_rebuilds_the_model_alone(saved: Path) -> None:
    model = nnode.load(saved)
    checkpoint = load_checkpoint(saved)
    assert float(model.physical()["v0"][0]) == checkpoint.history[-1]["parameters/v0"]
    assert checkpoint.manifest["dt"] == 0.2
    assert checkpoint.config["model"]["term"] == "lin"


def test_safe_loading_suffices(saved: Path) -> None:
    content = torch.load(saved, weights_only=True)
    assert set(content) == {f.name for f in fields(Checkpoint)}


def test_a_failed_write_leaves_the_old_file(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()
    checkpoint = load_checkpoint(saved)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space"):
        save_checkpoint(checkpoint, saved)
    assert saved.read_bytes() == before
    assert sorted(p.name for p in saved.parent.iterdir()) == ["best.pt", "last.pt"]


class Evil:
    """Unpickling this would create a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return (open, (str(self.path), "w"))


def test_code_in_a_checkpoint_is_not_executed(tmp_path: Path) -> None:
    trap, file = tmp_path / "trap", tmp_path / "evil.pt"
    torch.save({"format": 1, "model": Evil(trap), "config": {}}, file)
    with pytest.raises(CheckpointError, match="cannot be opened"):
        load_checkpoint(file)
    file.write_bytes(pickle.dumps(Evil(trap)))
    with pytest.raises(CheckpointError):
        load_checkpoint(file)
    assert not trap.exists()


@pytest.mark.parametrize("keep", [0, 1, 100, 2000])
def test_a_truncated_file_is_refused(saved: Path, keep: int) -> None:
    saved.write_bytes(saved.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match=r"last\.pt"):
        load_checkpoint(saved)


def test_other_files_are_refused_by_name(saved: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"that folder holds best\.pt, last\.pt"):
        load_checkpoint(saved.with_name("lost.pt"))
    torch.save({"weights": torch.ones(2)}, tmp_path / "other.pt")
    with pytest.raises(CheckpointError, match="no checkpoint of this package"):
        load_checkpoint(tmp_path / "other.pt")


def test_another_format_names_both(saved: Path) -> None:
    content = torch.load(saved, weights_only=True)
    torch.save({**content, "format": 99}, saved)
    with pytest.raises(CheckpointError, match="format 99, this version reads 1"):
        load_checkpoint(saved)
    content.pop("optimizer")
    torch.save(content, saved)
    with pytest.raises(CheckpointError, match="optimizer missing"):
        load_checkpoint(saved)
