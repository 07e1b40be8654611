"""One definition of the error: headline, tables, figures, player and JSON state the same numbers,
which follow from the simulations that are shown."""

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
    """A diagnosis and what was written of it."""

    found: DiagnosisOutcome
    sequences: list[Sequence]
    folder: Path

    @property
    def page(self) -> str:
        return (self.folder / "report.html").read_text()

    @property
    def report(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.folder / "report.json").read_text())
        return found


@pytest.fixture(scope="module", params=["traffic", "crowd"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "traffic":
        sequences, options, found = request.getfixturevalue("hidden_reaction")
        found = deepcopy(found)
    else:
        sequences = walkers.crowd(walkers.wind(0.0, 0.35), sequences=17, samples=40)
        options = DiscoverOptions(effects=["side_preference"], structure=False)
        model = {"term": "social_force", "A": walkers.A, "B": walkers.B}
        found = diagnose_law(build_model(model_options(model, "measured")), sequences, options)
    found.diagnosis.model = "base"
    inputs = Inputs(
        domain=request.param, sequences=sequences, faulty=[], faults={}, data_faults=[], manifest={}
    )
    draw(inputs, found, options, CONFIG, [], folder)()
    write_report(plain_report(found.diagnosis), folder / "report.json")
    return Run(found, sequences, folder)


@pytest.mark.thorough
def test_errors_are_those_of_the_simulations_that_are_shown(run: Run) -> None:
    rows = run.found.diagnosis.confirmation_errors
    assert len(rows) == len(run.found.simulated) > 3
    for row, pair in zip(rows, run.found.simulated, strict=True):
        for key, one in zip(("before", "after"), pair, strict=True):
            assert one is not None
            away = (one.sequence.x - one.x)[one.skip :]
            if one.x.shape[2] == 1:
                assert np.isnan(away[:, -1]).all()  # the leader is given
                away = away[:, :-1]
            assert np.mean((away**2).sum(-1)) == pytest.approx(row[key], rel=1e-9)
            measured = next(s for s in run.sequences if s.name == one.sequence.name)
            at = np.searchsorted(measured.time, one.sequence.time - 1e-6)
            np.testing.assert_array_equal(measured.x[at], one.sequence.x)


def test_headline_tables_and_json_state_the_same_errors(run: Run) -> None:
    d, report = run.found.diagnosis, run.report
    before, after = (
        np.mean([row[key] for row in report["confirmation_errors"]]) for key in ("before", "after")
    )
    assert report["gap"]["before"] == pytest.approx(before)
    assert report["gap"]["after"] == pytest.approx(after)
    words = [amount(before), amount(after)]
    if d.verdict == "named":
        assert f"from {words[0]} to {words[1]} m²" in verdict(d)
    assert verdict(d) in run.page.replace("&#39;", "'")
    table = pd.read_csv(run.folder / "gap.csv", dtype=str)
    shown = table[table.iloc[:, 0].isin(["base", "base with effects"])]
    assert list(shown.iloc[:, 1]) == (words if d.effects else words[:1])
    each = pd.read_csv(run.folder / "confirmation.csv")
    assert list(each["before"]) == pytest.approx(
        [row["before"] for row in report["confirmation_errors"]]
    )
    assert list(each["after"]) == pytest.approx(
        [row["after"] for row in report["confirmation_errors"]]
    )


def test_the_definition_stands_once_on_the_page_and_in_the_report(run: Run) -> None:
    told = run.report["gap"]["definition"]
    assert told.startswith("The error is the mean square distance")
    page = run.page.replace("&#39;", "'")
    assert page.count(told) == 1
    # no other root mean square of positions is stated
    assert not re.search(r"\d m rms", page)
    assert ("the last 40 %" in told) == any(a.named for a in run.found.diagnosis.agents)


def test_player_and_paths_show_the_errors_of_the_table(run: Run) -> None:
    rows = {row["name"]: row for row in run.report["confirmation_errors"]}
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', run.page, re.S)
    player = json.loads(text)
    scenes = player["scenes"]
    assert len(scenes) > 3
    keys = ["before", "after"][: len(scenes[0]["simulated"])]
    for scene in scenes:
        row, real = rows[scene["name"]], unpacked(scene["measured"])
        for key, one in zip(keys, scene["simulated"], strict=True):
            assert one["note"] == f"error {amount(row[key])} m²"
            away = real - unpacked(one["x"])
            if scene["dims"] == 1:
                away = away[1:]
            square = np.nanmean(away**2) * scene["dims"]
            # positions are rounded to the centimetre
            assert np.sqrt(square) == pytest.approx(np.sqrt(row[key]), abs=0.008)
    first = rows[scenes[player["first"]]["name"]]
    alts = re.findall(r'alt="Paths of the sequence ([^;]*); ([^"]*)"', run.page)
    words = [f"error {amount(first[key])} m²" for key in keys]
    assert alts == [(first["name"], alts[0][1])]
    assert all(word in alts[0][1] for word in words)
