"""Locks of run folders, and partial files of killed runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nnode.errors import FolderInUseError, WriteError
from nnode.files import disk_words, replacing, write_text
from nnode.lock import LOCK, alone, give, take

HOLD = """
import sys
from pathlib import Path
from nnode.lock import take
take(Path(sys.argv[1]))
print("taken", flush=True)
sys.stdin.read()
"""


def holder(folder: Path) -> subprocess.Popen[str]:
    """A process that holds the lock of a folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "taken\n"
    return process


def test_locked_folder_is_refused_with_the_process_id(tmp_path: Path) -> None:
    process = holder(tmp_path)
    try:
        message = rf"another run works in .* \(process {process.pid} on .*hydra\.run\.dir="
        with pytest.raises(FolderInUseError, match=message):
            take(tmp_path)
    finally:
        process.kill()
        process.communicate()
    with alone(tmp_path):  # the lock of a killed process is ignored
        assert str(os.getpid()) in (tmp_path / LOCK).read_text()
    assert not (tmp_path / LOCK).exists()


def test_lock_is_reentrant(tmp_path: Path) -> None:
    with alone(tmp_path):
        with alone(tmp_path / "." / ""):
            pass
        assert (tmp_path / LOCK).exists()
    give(tmp_path)  # releasing a free folder has no effect
    assert list(tmp_path.iterdir()) == []


def test_partial_files_of_killed_runs_are_removed(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    partial = [
        tmp_path / ".report.json.123.partial",
        tmp_path / "checkpoints" / ".last.pt.9.partial",
    ]
    other = [tmp_path / "notes.partial", tmp_path / ".hidden", tmp_path / ".x.partial"]
    for path in partial + other:
        path.write_text("x")
    with alone(tmp_path):
        assert not any(path.exists() for path in partial)
        assert all(path.exists() for path in other)


def test_partial_files_of_running_nested_runs_are_kept(tmp_path: Path) -> None:
    inner = tmp_path / "sweep" / "inner"
    code = f"from pathlib import Path\nfrom nnode.lock import take\ntake(Path({str(tmp_path)!r}))"
    (inner / "checkpoints").mkdir(parents=True)
    stale = tmp_path / "sweep" / ".result.json.7.partial"
    stale.write_text("of a killed run")
    with alone(inner), replacing(inner / "checkpoints" / "last.pt") as temporary:
        temporary.write_text("new")
        subprocess.run([sys.executable, "-c", code], check=True)
        assert not stale.exists()
    assert (inner / "checkpoints" / "last.pt").read_text() == "new"


def test_partial_links_are_removed_and_not_followed(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    target = write_text(tmp_path / "target" / "data", "")
    link = tmp_path / "run" / ".a.1.partial"
    link.symlink_to(target.parent)
    with alone(tmp_path / "run"):
        assert not os.path.lexists(link)
    assert target.exists()


def test_full_disk_is_reported_and_other_errors_are_raised(tmp_path: Path) -> None:
    path = write_text(tmp_path / "a", "before")
    with (
        pytest.raises(WriteError, match=r"cannot be written: No space .* kept; make room"),
        disk_words(path),
    ):
        raise OSError(28, "No space left on device")
    with pytest.raises(FileNotFoundError), disk_words(path):
        (tmp_path / "nowhere").read_text()
