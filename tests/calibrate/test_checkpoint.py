"""Checkpoints: atomic, safe, complete."""

from __future__ import annotations

import pickle
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import pytest
import torch

import nnode
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from nnode.calibrate.trainer import Trainer
from nnode.errors import CheckpointError, WriteError

Make = Callable[..., Trainer]


@pytest.fixture(scope="module")
def trained(make_trainer: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The last checkpoint of a calibration; tests do not change it."""
    trainer = make_trainer(tmp_path_factory.mktemp("trained"), max_epochs=2)
    trainer.fit()
    return trainer.last_path


@pytest.fixture
def saved(trained: Path, tmp_path: Path) -> Path:
    """A copy of the checkpoint."""
    return shutil.copytree(trained.parent, tmp_path / "checkpoints") / trained.name


def changed(saved: Path, **values: object) -> Path:
    """The checkpoint with other values."""
    content = torch.load(saved, weights_only=True)
    torch.save({**content, **values}, saved)
    return saved


def assert_refused(path: Path, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(path)


def test_load_rebuilds_the_model(saved: Path) -> None:
    model = nnode.load(saved)
    checkpoint = load_checkpoint(saved)
    assert float(model.physical()["lin.v0"][0]) == checkpoint.history[-1]["parameters/lin.v0"]
    assert checkpoint.manifest["dt"] == 0.2
    assert checkpoint.config["model"]["term"] == "lin"


def test_weights_only_loading_reads_all_fields(saved: Path) -> None:
    assert set(torch.load(saved, weights_only=True)) == {f.name for f in fields(Checkpoint)}


def test_failed_write_keeps_the_old_file(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()
    checkpoint = load_checkpoint(saved)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(WriteError, match=r"cannot be written: No space left on device\. Earlier"):
        save_checkpoint(checkpoint, saved)
    assert saved.read_bytes() == before
    assert sorted(p.name for p in saved.parent.iterdir()) == ["best.pt", "last.pt"]


class Evil:
    """An object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return (open, (str(self.path), "w"))


def test_code_in_a_checkpoint_is_not_executed(tmp_path: Path) -> None:
    trap, file = tmp_path / "trap", tmp_path / "evil.pt"
    torch.save({"format": 1, "model": Evil(trap), "config": {}}, file)
    assert_refused(file, "cannot be opened")
    file.write_bytes(pickle.dumps(Evil(trap)))
    assert_refused(file, r"evil\.pt")
    assert not trap.exists()


@pytest.mark.parametrize("keep", [0, 1, 100, 2000])
def test_truncated_file_is_refused(saved: Path, keep: int) -> None:
    saved.write_bytes(saved.read_bytes()[:keep])
    assert_refused(saved, r"last\.pt")


def test_missing_and_foreign_files_are_refused(saved: Path, tmp_path: Path) -> None:
    assert_refused(saved.with_name("lost.pt"), r"that folder holds best\.pt, last\.pt")
    torch.save({"weights": torch.ones(2)}, tmp_path / "other.pt")
    assert_refused(tmp_path / "other.pt", "no checkpoint of this package")


def test_missing_entry_is_named(saved: Path) -> None:
    content = torch.load(saved, weights_only=True)
    content.pop("optimizer")
    torch.save(content, saved)
    assert_refused(saved, "optimizer missing")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"config": 3}, "config hold"),
        ({"config": {"model": 3}}, "config hold"),
        ({"model": {"terms.0.v0": 30.0}}, "model hold"),
        ({"progress": {"epoch": "one"}}, "progress hold"),
        ({"history": [3]}, "history hold"),
        ({"split": {"train": "demo/000"}}, "split hold"),
        ({"format": torch.zeros(2, 2)}, "checkpoint format"),
        ({"format": 99}, "format 99, this version reads 1"),
    ],
)
def test_values_of_wrong_type_are_refused(
    saved: Path, values: dict[str, object], message: str
) -> None:
    assert_refused(changed(saved, **values), message)


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "a/${oc.env:HOME}.csv", "${x:1}", "\\${a}"])
def test_interpolations_are_refused(saved: Path, text: str) -> None:
    before = load_checkpoint(saved)
    places: list[dict[str, object]] = [
        {"config": {**before.config, "data": {"source": text}}},
        {"config": {**before.config, "model": {"law": {"where": {"a": ["b", text]}}}}},
        {"config": {**before.config, text: 1}},
        {"manifest": {**before.manifest, "options": {"columns": {text: "x"}}}},
    ]
    original = {"config": before.config, "manifest": before.manifest}
    for values in places:
        path = changed(saved, **{**original, **values})
        assert_refused(path, r"is refused: its configuration holds .*environment")
    # names of sequences are not interpolated
    changed(saved, **original, split={"train": [text]})
    assert load_checkpoint(saved).split == {"train": [text]}


def test_endless_configuration_is_refused(saved: Path) -> None:
    config = load_checkpoint(saved).config
    endless: list[object] = []
    endless.append(endless)
    doubled: list[object] = ["a"]
    for _ in range(60):
        doubled = [doubled, doubled]
    deep: list[object] = []
    for _ in range(200):
        deep = [deep]
    for value in (endless, doubled, deep):
        path = changed(saved, config={**config, "data": {"columns": value}})
        assert_refused(path, "is damaged: its configuration has more than")


def test_configuration_without_model_is_refused(saved: Path) -> None:
    config = load_checkpoint(saved).config
    with pytest.raises(CheckpointError, match=r"describes no model \(KeyError"):
        nnode.load(changed(saved, config={**config, "trainer": {}}))


def test_state_of_another_optimiser_is_refused(
    saved: Path, make_trainer: Make, tmp_path: Path
) -> None:
    trainer = make_trainer(tmp_path / "other", max_epochs=2)
    with pytest.raises(CheckpointError, match="does not fit the model and the optimiser"):
        trainer.restore(changed(saved, optimizer={"strange": 1}))


def test_compressed_records_are_refused(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        records = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in records.items():
            archive.writestr(name, data + bytes(1 << 20))
    assert_refused(saved, "cannot be opened as a checkpoint")
