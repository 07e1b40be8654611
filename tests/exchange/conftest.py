"""The neighbouring programs; what needs one that is not installed is skipped."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def jupedsim() -> ModuleType:
    result: ModuleType = pytest.importorskip("jupedsim", minversion="1.4")
    return result


@pytest.fixture(scope="session")
def sumo() -> Path:
    """SUMO's folder."""
    return Path(pytest.importorskip("sumo").SUMO_HOME)


@pytest.fixture(scope="session")
def program(sumo: Path) -> str:
    """How SUMO is run: ``libsumo`` where it is installed, else ``traci``, which comes with it."""
    tools = str(sumo / "tools")
    if tools not in sys.path:
        sys.path.append(tools)  # libsumo imports what stands there
    return "libsumo" if importlib.util.find_spec("libsumo") else "traci"
