"""Simulated data and their diagnoses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from nnode.app.python.inputs import model_options
from nnode.data.readers.table import TableOptions
from nnode.data.sequence import Sequence
from nnode.diagnosis.inputs import Inputs, read_inputs
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.single_law import diagnose_law
from nnode.model import build_model
from tests.diagnosis import stand_in
from tests.diagnosis.platoons import lin, platoons, relative_speed
from tests.diagnosis.recorded import corridor, lane

#: Sixteen clusters, five of which confirm effects.
MANY: dict[str, Any] = {"number": 16, "seconds": 12.0, "driver": 0.1}
#: Reaction of the followers of :func:`hidden_reaction` to the speed ahead.
KAPPA = 0.4


@dataclass
class Case:
    """A made diagnosis (:mod:`tests.diagnosis.stand_in`) of simulated data."""

    model: dict[str, Any]
    inputs: Inputs
    options: DiscoverOptions
    found: DiagnosisOutcome


def _case(folder: Path, model: dict[str, Any], **data: Any) -> Case:
    options = DiscoverOptions(confirmation=0.4)
    inputs = read_inputs(TableOptions(**data), folder / "data")
    model = model_options(model, "measured")
    outcome = stand_in.diagnose(build_model(model), inputs.sequences, options)
    return Case(model, inputs, options, outcome)


@pytest.fixture(scope="session")
def traffic(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Platoons that pass a zone of low speed."""
    folder = tmp_path_factory.mktemp("traffic")
    table = lane(folder / "lane.csv", sequences=5, seconds=8.0, cars=4)
    return _case(folder, {"term": "lin"}, domain="traffic", path=str(table))


@pytest.fixture(scope="session")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """People with a constant additional acceleration."""
    folder = tmp_path_factory.mktemp("crowd")
    table, walls = corridor(folder / "walk.csv", sequences=5, seconds=3.0, people=6)
    model = {"term": "social_force", "B": 0.3, "walls": False}
    return _case(folder, model, domain="crowd", path=str(table), walls=str(walls))


@pytest.fixture(scope="session")
def hidden_reaction() -> tuple[list[Sequence], DiscoverOptions, DiagnosisOutcome]:
    """Platoons whose followers react to the speed ahead, diagnosed with a law without it."""
    sequences = platoons(relative_speed(KAPPA), **MANY)
    options = DiscoverOptions(effects=["relative_speed", "speed_zone"])
    law = lin(v0=25.0, length=7.0)
    before = {name: value.clone() for name, value in law.state_dict().items()}
    outcome = diagnose_law(law, sequences, options)
    # a diagnosis does not change its argument
    assert all(torch.equal(before[name], value) for name, value in law.state_dict().items())
    return sequences, options, outcome
