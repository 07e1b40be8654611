"""Headline, tables, figures, player and JSON state the same errors of the shown simulations."""

from __future__ import annotations

import json
import re
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from nnode.app.python.inputs import model_options
from nnode.data.sequence import Sequence
from nnode.diagnosis.inputs import Inputs
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.report.files import amount, plain_report, verdict, write_report
from nnode.diagnosis.report.page import draw
from nnode.diagnosis.single_law import diagnose_law
from nnode.model import build_model
from tests.diagnosis import walkers
from tests.diagnosis.report.test_page import CONFIG
from tests.pages.test_replay import unpacked


@dataclass
class Run:
    """A diagnosis and the folder of its report."""

    outcome: DiagnosisOutcome
    sequences: list[Sequence]
    folder: Path

    @property
    def page(self) -> str:
        return (self.folder / "report.html").read_text()

    @property
    def report(self) -> dict[str, Any]:
        report: dict[str, Any] = json.loads((self.folder / "report.json").read_text())
        return report


@pytest.fixture(scope="module", params=["traffic", "crowd"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "traffic":
        sequences, options, outcome = request.getfixturevalue("hidden_reaction")
        outcome = deepcopy(outcome)
    else:
        sequences = walkers.crowd(walkers.wind(0.0, 0.35), sequences=17, samples=40)
        options = DiscoverOptions(effects=["side_preference"], structure=False)
        model = {"term": "social_force", "A": walkers.A, "B": walkers.B}
        outcome = diagnose_law(build_model(model_options(model, "measured")), sequences, options)
    outcome.diagnosis.model = "base"
    inputs = Inputs(
        domain=request.param, sequences=sequences, faulty=[], faults={}, data_faults=[], manifest={}
    )
    draw(inputs, outcome, options, CONFIG, [], folder)()
    write_report(plain_report(outcome.diagnosis), folder / "report.json")
    return Run(outcome, sequences, folder)


@pytest.mark.thorough
def test_errors_of_shown_simulations(run: Run) -> None:
    rows = run.outcome.diagnosis.confirmation_errors
    assert len(rows) == len(run.outcome.simulated) > 3
    for row, pair in zip(rows, run.outcome.simulated, strict=True):
        for key, simulation in zip(("before", "after"), pair, strict=True):
            assert simulation is not None
            sequence = simulation.sequence
            error = (sequence.x - simulation.x)[simulation.skip :]
            if error.shape[2] == 1:
                assert np.isnan(error[:, -1]).all()  # the leader is an input
                error = error[:, :-1]
            assert np.mean((error**2).sum(-1)) == pytest.approx(row[key], rel=1e-9)
            measured = next(s for s in run.sequences if s.name == sequence.name)
            at = np.searchsorted(measured.time, sequence.time - 1e-6)
            np.testing.assert_array_equal(measured.x[at], sequence.x)


def test_errors_of_headline_tables_and_json(run: Run) -> None:
    d, report = run.outcome.diagnosis, run.report
    rows, table = report["confirmation_errors"], pd.read_csv(run.folder / "confirmation.csv")
    words = []
    for key in ("before", "after"):
        errors = [row[key] for row in rows]
        assert report["gap"][key] == pytest.approx(np.mean(errors))
        assert list(table[key]) == pytest.approx(errors)
        words.append(amount(np.mean(errors)))
    if d.verdict == "named":
        assert f"from {words[0]} to {words[1]} m²" in verdict(d)
    assert verdict(d) in run.page.replace("&#39;", "'")
    gap = pd.read_csv(run.folder / "gap.csv", dtype=str)
    shown = gap[gap.iloc[:, 0].isin(["base", "base with effects"])]
    assert list(shown.iloc[:, 1]) == (words if d.effects else words[:1])


def test_definition_of_error_is_stated_once(run: Run) -> None:
    definition = run.report["gap"]["definition"]
    assert definition.startswith("The error is the mean square distance")
    page = run.page.replace("&#39;", "'")
    assert page.count(definition) == 1
    # no other root mean square of positions is stated
    assert not re.search(r"\d m rms", page)
    assert ("the last 40 %" in definition) == any(a.named for a in run.outcome.diagnosis.agents)


def test_errors_of_player_and_paths(run: Run) -> None:
    rows = {row["name"]: row for row in run.report["confirmation_errors"]}
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', run.page, re.S)
    player = json.loads(text)
    scenes = player["scenes"]
    assert len(scenes) > 3
    keys = ["before", "after"][: len(scenes[0]["simulated"])]
    for scene in scenes:
        row, measured = rows[scene["name"]], unpacked(scene["measured"])
        for key, simulated in zip(keys, scene["simulated"], strict=True):
            assert simulated["note"] == f"error {amount(row[key])} m²"
            error = measured - unpacked(simulated["x"])
            if scene["dims"] == 1:
                error = error[1:]
            square = np.nanmean(error**2) * scene["dims"]
            # positions are rounded to the centimetre
            assert np.sqrt(square) == pytest.approx(np.sqrt(row[key]), abs=0.008)
    first = rows[scenes[player["first"]]["name"]]
    alts = re.findall(r'alt="Paths of the sequence ([^;]*); ([^"]*)"', run.page)
    words = [f"error {amount(first[key])} m²" for key in keys]
    assert alts == [(first["name"], alts[0][1])]
    assert all(word in alts[0][1] for word in words)
