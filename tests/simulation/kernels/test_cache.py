"""The folder of kept modules: only files that this user wrote are run."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from nnode.errors import ConfigError
from nnode.simulation.kernels import cache

TEXT = b"from numba import njit\n@njit(cache=True)\ndef plus(a):\n    return a + 1\n"

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="modes and owners of Unix")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NNODE_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept" / "fused"


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache.os, "replace", full)


@pytest.mark.parametrize("content", [b"", TEXT[:30], b"def plus(a):\n    return 41\n"])
def test_a_file_of_another_content_is_written_again(folder: Path, content: bytes) -> None:
    folder.mkdir(parents=True, mode=0o700)
    (folder / "nnode_one.py").write_bytes(content)
    assert cache.keep("nnode_one", TEXT).plus(1) == 2
    assert (folder / "nnode_one.py").read_bytes() == TEXT


def test_the_folder_is_its_owners_alone(folder: Path) -> None:
    before = os.umask(0)
    try:
        assert cache.keep("nnode_mode", TEXT).plus(1) == 2
    finally:
        os.umask(before)
    for place in (folder.parent, folder, folder / "__pycache__"):
        assert mode(place) == 0o700, place
    assert cache.keep("nnode_mode", TEXT).plus(1) == 2


@pytest.mark.parametrize(("place", "bits"), [("", 0o770), ("", 0o707), ("__pycache__", 0o777)])
def test_a_folder_that_others_may_write_to_is_refused(folder: Path, place: str, bits: int) -> None:
    (folder / place).mkdir(parents=True, mode=0o700)
    (folder / place).chmod(bits)
    with pytest.raises(ConfigError, match=r"others may write to.*NNODE_CACHE"):
        cache.keep("nnode_open", TEXT)
    assert not list(folder.glob("*.py"))


def test_a_folder_in_one_that_everybody_may_write_to(folder: Path) -> None:
    folder.mkdir(parents=True, mode=0o700)
    folder.parent.chmod(0o777)
    with pytest.raises(ConfigError, match="others may write to"):
        cache.keep("nnode_among", TEXT)
    folder.parent.chmod(0o1777)  # as /tmp, where only the owner replaces what is there
    assert cache.keep("nnode_among", TEXT).plus(1) == 2


@pytest.mark.skipif("os.getuid() != 0", reason="only root gives folders to others")
@pytest.mark.parametrize("place", ["", "..", "__pycache__"])
def test_a_folder_of_another_user_is_refused(folder: Path, place: str) -> None:
    (folder / "__pycache__").mkdir(parents=True, mode=0o700)
    os.chown(folder / place, 65534, 65534)
    with pytest.raises(ConfigError, match=r"user 65534 owns.*NNODE_CACHE"):
        cache.keep("nnode_other", TEXT)


def test_a_full_disk_leaves_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    no_room(monkeypatch)
    with pytest.raises(ConfigError, match=r"No space left on device.*NNODE_CACHE"):
        cache.keep("nnode_full", TEXT)
    assert not [path for path in folder.rglob("*") if path.is_file()]


def test_no_room_for_compiled_code(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    module = cache.keep("nnode_roomless", TEXT)
    no_room(monkeypatch)
    assert module.plus(1) == 2
    assert "No space left on device" in caplog.text


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
@pytest.mark.parametrize("size", [0, 40])
def test_damaged_compiled_code_is_made_again(folder: Path, ending: str, size: int) -> None:
    assert cache.keep("nnode_damaged", TEXT).plus(1) == 2
    (path,) = folder.rglob(f"*{ending}")
    path.write_bytes(path.read_bytes()[:size])
    second = cache.keep("nnode_damaged", TEXT)
    assert second.plus(1) == 2
    assert sum(second.plus.stats.cache_misses.values()) == 1
    once_more = cache.keep("nnode_damaged", TEXT)
    assert once_more.plus(1) == 2
    assert sum(once_more.plus.stats.cache_hits.values()) == 1


def test_numba_that_may_write_nowhere(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from numba.core.caching import CacheImpl

    monkeypatch.setattr(CacheImpl, "_locator_classes", [])
    with pytest.raises(ConfigError, match=r"no locator.*NNODE_CACHE"):
        cache.keep("nnode_nowhere", TEXT)


SCRIPT = """
import logging, sys, tempfile
logging.basicConfig(level="WARNING", stream=sys.stdout)
from nnode.simulation.kernels.cache import keep
for name in ("nnode_a", "nnode_b"):
    module = keep(name, sys.argv[1].encode())
    assert module.plus(1) == 2
    print(module.__file__)
"""


@pytest.mark.skipif("sys.platform != 'linux'", reason="the cache of Linux is meant")
def test_a_home_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    environment = {k: v for k, v in os.environ.items() if k != "NNODE_CACHE"}
    environment |= {"XDG_CACHE_HOME": str(tmp_path / "file"), "TMPDIR": str(scratch)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, TEXT.decode()],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("NNODE_CACHE") == 1  # one warning, not one per module
    assert done.stdout.count(str(scratch / "nnode-")) == 3
    assert not list(scratch.iterdir())
