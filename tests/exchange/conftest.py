"""The neighbouring programs; what needs one that is not installed is skipped."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def jupedsim() -> ModuleType:
    found: ModuleType = pytest.importorskip("jupedsim", minversion="1.4")
    return found


@pytest.fixture(scope="session")
def sumo() -> Path:
    """SUMO's folder."""
    return Path(pytest.importorskip("sumo").SUMO_HOME)
