"""SUMO and JuPedSim; tests that need a program that is not installed are skipped."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.app.conftest import forks, script  # noqa: F401


@pytest.fixture(scope="session")
def jupedsim() -> ModuleType:
    result: ModuleType = pytest.importorskip("jupedsim", minversion="1.4")
    return result


@pytest.fixture(scope="session")
def sumo() -> Path:
    """The folder of SUMO."""
    return Path(pytest.importorskip("sumo").SUMO_HOME)


@pytest.fixture(scope="session")
def program(sumo: Path) -> str:
    """The interface to SUMO: ``libsumo`` if it is installed, otherwise ``traci``."""
    tools = str(sumo / "tools")
    if tools not in sys.path:
        sys.path.append(tools)  # libsumo imports modules from this folder
    return "libsumo" if importlib.util.find_spec("libsumo") else "traci"
