"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:
    # as many processes as cores: more threads would wait for each other, and burn time doing so
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_collection_finish() -> None:
    """Take what is loaded out of Python's search for garbage, also that of forked children."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of the real recordings, from NNODE_DATA; skips where there is none."""
    folder = os.environ.get("NNODE_DATA")
    if not folder or not (Path(folder) / "esimas").is_dir():
        pytest.skip("real recordings absent: set NNODE_DATA to a folder with esimas/ and juelich/")
    return Path(folder).resolve()
