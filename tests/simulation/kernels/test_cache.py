"""The cache of compiled modules, which runs only files of the user."""

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


def fill_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache.os, "replace", full)


@pytest.mark.parametrize("content", [b"", TEXT[:30], b"def plus(a):\n    return 41\n"])
def test_file_with_other_content_is_replaced(folder: Path, content: bytes) -> None:
    folder.mkdir(parents=True, mode=0o700)
    (folder / "nnode_one.py").write_bytes(content)
    assert cache.keep("nnode_one", TEXT).plus(1) == 2
    assert (folder / "nnode_one.py").read_bytes() == TEXT


def test_mode_of_the_folder(folder: Path) -> None:
    before = os.umask(0)
    try:
        assert cache.keep("nnode_mode", TEXT).plus(1) == 2
    finally:
        os.umask(before)
    for place in (folder.parent, folder, folder / "__pycache__"):
        assert mode(place) == 0o700, place
    assert cache.keep("nnode_mode", TEXT).plus(1) == 2


@pytest.mark.parametrize(("place", "bits"), [("", 0o770), ("", 0o707), ("__pycache__", 0o777)])
def test_folder_writable_by_others(folder: Path, place: str, bits: int) -> None:
    (folder / place).mkdir(parents=True, mode=0o700)
    (folder / place).chmod(bits)
    with pytest.raises(ConfigError, match=r"others may write to.*NNODE_CACHE"):
        cache.keep("nnode_open", TEXT)
    assert not list(folder.glob("*.py"))


def test_parent_folder_writable_by_everybody(folder: Path) -> None:
    folder.mkdir(parents=True, mode=0o700)
    folder.parent.chmod(0o777)
    with pytest.raises(ConfigError, match="others may write to"):
        cache.keep("nnode_among", TEXT)
    folder.parent.chmod(0o1777)  # as /tmp, where only owners can replace their files
    assert cache.keep("nnode_among", TEXT).plus(1) == 2


@pytest.mark.skipif("os.getuid() != 0", reason="only root can change owners")
@pytest.mark.parametrize("place", ["", "..", "__pycache__"])
def test_folder_of_another_user(folder: Path, place: str) -> None:
    (folder / "__pycache__").mkdir(parents=True, mode=0o700)
    os.chown(folder / place, 65534, 65534)
    with pytest.raises(ConfigError, match=r"user 65534 owns.*NNODE_CACHE"):
        cache.keep("nnode_other", TEXT)


def test_full_disk_leaves_no_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill_disk(monkeypatch)
    with pytest.raises(ConfigError, match=r"No space left on device.*NNODE_CACHE"):
        cache.keep("nnode_full", TEXT)
    assert not [path for path in folder.rglob("*") if path.is_file()]


def test_full_disk_during_compilation(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    module = cache.keep("nnode_full_later", TEXT)
    fill_disk(monkeypatch)
    assert module.plus(1) == 2
    assert "No space left on device" in caplog.text


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
@pytest.mark.parametrize("size", [0, 40])
def test_damaged_compiled_code_is_replaced(folder: Path, ending: str, size: int) -> None:
    assert cache.keep("nnode_damaged", TEXT).plus(1) == 2
    (path,) = folder.rglob(f"*{ending}")
    path.write_bytes(path.read_bytes()[:size])
    for statistic in ("cache_misses", "cache_hits"):
        module = cache.keep("nnode_damaged", TEXT)
        assert module.plus(1) == 2
        assert sum(getattr(module.plus.stats, statistic).values()) == 1


def test_numba_without_a_cache_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.skipif("sys.platform != 'linux'", reason="the folder is that of Linux")
def test_home_that_cannot_be_used(tmp_path: Path) -> None:
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
