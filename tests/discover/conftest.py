"""Made-up data and finished diagnoses, made once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from nnode.app.python.inputs import model_options
from nnode.data.readers.table import TableOptions
from nnode.discover.inputs import Inputs, read_inputs
from nnode.discover.options import DiscoverOptions
from nnode.discover.outcome import DiagnosisOutcome
from nnode.model import build_model
from tests.discover import stand_in
from tests.discover.recorded import corridor, lane


@dataclass
class Case:
    """A diagnosis by hand of made-up data."""

    table: Path
    walls: Path | None
    model: dict[str, Any]
    inputs: Inputs
    options: DiscoverOptions
    found: DiagnosisOutcome


def _case(folder: Path, domain: str, table: Path, walls: Path | None, model: Any) -> Case:
    options = DiscoverOptions(sealed=0.4)
    data = TableOptions(domain=domain, path=str(table), walls=None if walls is None else str(walls))
    inputs = read_inputs(data, folder / "data")
    full = model_options(model, "measured")
    system = build_model(full)
    found = stand_in.diagnose(system, inputs.sequences, options)
    return Case(table, walls, full, inputs, options, found)


@pytest.fixture(scope="session")
def traffic(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Platoons that pass a slow zone."""
    folder = tmp_path_factory.mktemp("traffic")
    table = lane(folder / "lane.csv", sequences=5, seconds=8.0, cars=4)
    return _case(folder, "traffic", table, None, {"term": "lin"})


@pytest.fixture(scope="session")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """People in a wind."""
    folder = tmp_path_factory.mktemp("crowd")
    table, walls = corridor(folder / "walk.csv", sequences=5, seconds=3.0, people=6)
    model = {"term": "social_force", "B": 0.3, "walls": False}
    return _case(folder, "crowd", table, walls, model)
