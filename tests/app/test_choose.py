"""The sequences that an evaluation takes, given the training's split."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nnode.app.saved_run import choose
from nnode.calibrate.checkpoint import Checkpoint
from nnode.data.store import Store, write_store
from nnode.errors import ConfigError
from tests.builders import lane


def store(folder: Path, recordings: str, **options: Any) -> Store:
    """Three sequences of each recording; a recording's hash is its name."""
    x = np.arange(6.0).reshape(3, 2)
    sequences = [lane(x, 1.0, name=f"{r}/{i}") for r in recordings for i in range(3)]
    files = {r: {"name": r, "sha256": r} for r in recordings}
    return write_store(folder, sequences, {"files": files, "options": options})


@pytest.fixture
def checkpoint(tmp_path: Path) -> Checkpoint:
    return Checkpoint(
        config={},
        manifest=store(tmp_path / "then", "ab", t_seq=1.0, faults="drop", recording="ab").manifest,
        model={},
        optimizer={},
        progress={},
        split={"train": ["a/0", "b/0", "b/1"], "heldout": ["a/1", "b/2"], "dropped": ["a/2"]},
    )


@pytest.mark.parametrize(
    ("recordings", "part", "expected"),
    [
        ("ab", "auto", ("heldout", ["a/1", "b/2"], 0)),
        ("a", "auto", ("heldout", ["a/1"], 0)),  # fewer recordings than in the training
        ("abc", "auto", ("heldout", ["a/1", "b/2"], 0)),  # more recordings
        ("abc", "unseen", ("unseen", ["a/1", "b/2", "c/0", "c/1", "c/2"], 0)),
        ("c", "auto", ("unseen", ["c/0", "c/1", "c/2"], 0)),
        ("a", "all", ("all", ["a/0", "a/1", "a/2"], 1)),
        ("b", "train", ("train", ["b/0", "b/1"], 2)),
    ],
)
def test_selected_part(
    tmp_path: Path,
    checkpoint: Checkpoint,
    recordings: str,
    part: str,
    expected: tuple[str, list[str], int],
) -> None:
    present = store(tmp_path / "now", recordings, t_seq=1.0, faults="keep", recording=recordings)
    result, indices, trained = choose(present, checkpoint, part)
    assert (result, [present.index[i]["name"] for i in indices], trained) == expected


def test_other_sequence_lengths_select_all(tmp_path: Path, checkpoint: Checkpoint) -> None:
    present = store(tmp_path / "now", "a", t_seq=2.0)
    assert choose(present, checkpoint, "auto") == ("all", [0, 1, 2], None)
    with pytest.raises(ConfigError, match="part=heldout"):
        choose(present, checkpoint, "heldout")


def test_options_missing_in_the_checkpoint_are_ignored(
    tmp_path: Path, checkpoint: Checkpoint
) -> None:
    present = store(tmp_path / "now", "ab", t_seq=1.0, fill=0.5)
    assert choose(present, checkpoint, "auto") == ("heldout", [1, 5], 0)


def test_unknown_part_is_refused(tmp_path: Path, checkpoint: Checkpoint) -> None:
    with pytest.raises(ConfigError, match="part=test is unknown"):
        choose(store(tmp_path / "now", "a"), checkpoint, "test")
