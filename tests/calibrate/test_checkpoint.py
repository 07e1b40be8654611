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
    """The last checkpoint of a training, which no test changes."""
    trainer = make_trainer(tmp_path_factory.mktemp("trained"), max_epochs=2)
    trainer.fit()
    return trainer.last_path


@pytest.fixture
def saved(trained: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(trained.parent, tmp_path / "checkpoints") / trained.name


def test_load_rebuilds_the_model_alone(saved: Path) -> None:
    model = nnode.load(saved)
    checkpoint = load_checkpoint(saved)
    assert float(model.physical()["lin.v0"][0]) == checkpoint.history[-1]["parameters/lin.v0"]
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
    with pytest.raises(WriteError, match=r"cannot be written: No space left on device\. Earlier"):
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


def test_a_missing_entry_is_told(saved: Path) -> None:
    content = torch.load(saved, weights_only=True)
    content.pop("optimizer")
    torch.save(content, saved)
    with pytest.raises(CheckpointError, match="optimizer missing"):
        load_checkpoint(saved)


def changed(saved: Path, **values: object) -> Path:
    content = torch.load(saved, weights_only=True)
    torch.save({**content, **values}, saved)
    return saved


@pytest.mark.parametrize(
    ("values", "words"),
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
def test_values_of_another_kind_are_refused(
    saved: Path, values: dict[str, object], words: str
) -> None:
    with pytest.raises(CheckpointError, match=words):
        load_checkpoint(changed(saved, **values))


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "a/${oc.env:HOME}.csv", "${x:1}", "\\${a}"])
def test_values_of_this_machine_are_no_part_of_a_checkpoint(saved: Path, text: str) -> None:
    before = load_checkpoint(saved)
    places: list[dict[str, object]] = [
        {"config": {**before.config, "data": {"source": text}}},
        {"config": {**before.config, "model": {"law": {"where": {"a": ["b", text]}}}}},
        {"config": {**before.config, text: 1}},
        {"manifest": {**before.manifest, "options": {"columns": {text: "x"}}}},
    ]
    content = torch.load(saved, weights_only=True)
    for values in places:
        torch.save({**content, **values}, saved)
        with pytest.raises(CheckpointError, match="is refused: its configuration holds") as error:
            load_checkpoint(saved)
        assert "environment" in str(error.value)
    # a name that nothing replaces
    torch.save({**content, "split": {"train": [text]}}, saved)
    assert load_checkpoint(saved).split == {"train": [text]}


def test_a_configuration_without_an_end_is_refused(saved: Path) -> None:
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
        changed(saved, config={**config, "data": {"columns": value}})
        with pytest.raises(CheckpointError, match="is damaged: its configuration has more than"):
            load_checkpoint(saved)


def test_a_configuration_of_no_model_is_refused(saved: Path) -> None:
    config = load_checkpoint(saved).config
    with pytest.raises(CheckpointError, match=r"describes no model \(KeyError"):
        nnode.load(changed(saved, config={**config, "trainer": {}}))


def test_a_checkpoint_of_another_optimiser_is_refused(
    saved: Path, make_trainer: Make, tmp_path: Path
) -> None:
    trainer = make_trainer(tmp_path / "other", max_epochs=2)
    with pytest.raises(CheckpointError, match="does not fit the model and the optimiser"):
        trainer.restore(changed(saved, optimizer={"strange": 1}))


def test_packed_records_are_refused_before_they_swell(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        records = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in records.items():
            archive.writestr(name, data + bytes(1 << 20))
    with pytest.raises(CheckpointError, match="cannot be opened as a checkpoint"):
        load_checkpoint(saved)
