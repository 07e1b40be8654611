"""One run at a time in a folder, and no lock that outlives its process."""

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
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "taken\n"
    return process


def test_a_second_process_is_told_who_works_there(tmp_path: Path) -> None:
    process = holder(tmp_path)
    try:
        words = rf"another run works in .* \(process {process.pid} on .*hydra\.run\.dir="
        with pytest.raises(FolderInUseError, match=words):
            take(tmp_path)
    finally:
        process.kill()
        process.communicate()
    with alone(tmp_path):  # the killed one's lock is still there, and blocks nobody
        assert str(os.getpid()) in (tmp_path / LOCK).read_text()
    assert not (tmp_path / LOCK).exists()


def test_a_process_may_take_a_folder_twice(tmp_path: Path) -> None:
    with alone(tmp_path):
        with alone(tmp_path / "." / ""):
            pass
        assert (tmp_path / LOCK).exists()
    give(tmp_path)  # and giving back what is not held does nothing
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_run_left_half_written_is_removed(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    half = [tmp_path / ".report.json.123.partial", tmp_path / "checkpoints" / ".last.pt.9.partial"]
    own = [tmp_path / "notes.partial", tmp_path / ".hidden", tmp_path / ".x.partial"]
    for path in half + own:
        path.write_text("x")
    with alone(tmp_path):
        assert not any(path.exists() for path in half)
        assert all(path.exists() for path in own)


def test_what_a_live_run_in_a_folder_below_writes_is_kept(tmp_path: Path) -> None:
    inner = tmp_path / "sweep" / "inner"
    code = f"from pathlib import Path\nfrom nnode.lock import take\ntake(Path({str(tmp_path)!r}))"
    (inner / "checkpoints").mkdir(parents=True)
    beside = tmp_path / "sweep" / ".result.json.7.partial"
    beside.write_text("of a killed run")
    with alone(inner), replacing(inner / "checkpoints" / "last.pt") as temporary:
        temporary.write_text("new")
        subprocess.run([sys.executable, "-c", code], check=True)
        assert not beside.exists()
    assert (inner / "checkpoints" / "last.pt").read_text() == "new"


def test_a_link_in_place_of_a_rest_is_removed_and_not_followed(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "else").mkdir()
    (tmp_path / "else" / "data").write_text("")
    (tmp_path / "run" / ".a.1.partial").symlink_to(tmp_path / "else")
    with alone(tmp_path / "run"):
        assert not os.path.lexists(tmp_path / "run" / ".a.1.partial")
    assert (tmp_path / "else" / "data").exists()


def test_a_full_disk_is_told_in_words_and_other_errors_pass(tmp_path: Path) -> None:
    path = write_text(tmp_path / "a", "before")
    with (
        pytest.raises(WriteError, match=r"cannot be written: No space .* kept; make room"),
        disk_words(path),
    ):
        raise OSError(28, "No space left on device")
    with pytest.raises(FileNotFoundError), disk_words(path):
        (tmp_path / "nowhere").read_text()
