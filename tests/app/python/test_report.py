"""The object that ``nnode.diagnose`` returns."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

import nnode
from nnode.app import discover as app
from nnode.diagnosis import diagnose
from nnode.errors import ConfigError
from nnode.model.extend import effects_of
from tests.app.following import table
from tests.builders import as_table
from tests.diagnosis import stand_in
from tests.diagnosis.platoons import platoons
from tests.diagnosis.recorded import lane

#: No comparison with other laws, and no page.
ALONE = app.DiscoverOptions(page=False, compare=[])


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> nnode.Report:
    """A report with substituted results."""
    table = lane(tmp_path_factory.mktemp("lane") / "lane.csv", sequences=4, seconds=3.0, cars=3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnose, "diagnose_law", stand_in.diagnose)
        return nnode.diagnose(table, options=ALONE)


def test_effects_convert_to_a_data_frame(result: nnode.Report) -> None:
    assert result.verdict == "named"
    rows = result.to_dataframe()
    assert set(rows.effect) == {effect.name for effect in [*result.effects, *result.hypotheses]}
    first = result.effects[0]
    (name, c), *_ = first.coefficients.items()
    row = rows[(rows.effect == first.name) & (rows.coefficient == name)].iloc[0]
    assert (row.estimate, row.lower, row.upper, row.unit) == (c.value, c.low, c.high, c.unit)
    assert row.named
    assert [effect.name for effect in effects_of(result.model)] == [e.name for e in result.effects]
    assert result.plain()["verdict"] == "named"


def test_display_in_a_notebook(result: nnode.Report) -> None:
    page = result._repr_html_()
    assert "<b>named</b>: The model lin lacks" in page
    assert f"<td>{result.effects[0].name}</td>" in page
    assert repr(result).startswith("named: The model lin lacks")


def test_coefficients_convert_to_xarray(result: nnode.Report) -> None:
    pytest.importorskip("xarray")
    dataset = result.to_xarray()
    row = result.to_dataframe().iloc[0]
    assert (
        float(dataset.estimate.sel(coefficient=f"{row.effect}.{row.coefficient}")) == row.estimate
    )
    assert dataset.attrs["verdict"] == "named"


@pytest.mark.thorough
def test_complete_law_gives_an_empty_table() -> None:
    frame = as_table(platoons(number=14, seconds=8.0))
    result = nnode.diagnose(frame, "traffic", model="lin", options=ALONE)
    assert result.verdict == "none"
    assert result.effects == []
    assert result.to_dataframe().empty
    assert "<table" not in result._repr_html_()
    (panel, *_) = result.plot().axes
    assert panel.get_ylabel() == "position along the lane (m)"


@pytest.mark.thorough
def test_diagnosis_is_independent_of_order() -> None:
    frame = as_table(platoons(number=12, seconds=6.0))
    shuffled = frame.sample(frac=1.0, random_state=3)
    assert shuffled.sequence.iloc[0] != frame.sequence.iloc[0]
    reports = []
    for data in (frame, nnode.sequences(shuffled, faults="keep")[::-1]):
        report = nnode.diagnose(data, model="lin", options=ALONE).plain()
        del report["seconds"]
        reports.append(json.dumps(report, sort_keys=True))
    assert reports[0] == reports[1]


def test_data_frame_is_saved_for_the_printed_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnose, "diagnose_law", stand_in.diagnose)
    frame = table(platoons=4, seconds=4.0)
    nnode.diagnose(frame, folder=tmp_path, options=ALONE)
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "table.parquet"), frame)


def test_summary_has_all_coefficients(result: nnode.Report) -> None:
    text = result.summary()
    assert text.splitlines()[0] == result.sentence
    for effect in result.effects:
        assert all(f"{effect.name}.{name}" in text for name in effect.coefficients)


def test_figures_of_a_report(result: nnode.Report) -> None:
    assert result.plot("coefficients").axes
    with pytest.raises(ConfigError, match="there is no figure 'heat'; this diagnosis has "):
        result.plot("heat")
