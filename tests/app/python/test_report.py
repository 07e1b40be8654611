"""A diagnosis in Python is an object to look at."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

import nnode
from nnode.app import discover as app
from nnode.app import nearest_law
from nnode.errors import ConfigError
from nnode.model.extend import effects_of
from tests.app.following import table
from tests.discover import stand_in
from tests.discover.platoons import platoons
from tests.discover.recorded import lane

#: No other law beside it, and no page.
ALONE = app.DiscoverOptions(page=False, compare=[])


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> nnode.Report:
    """Of results made by hand."""
    monkeypatch.setattr(nearest_law, "diagnose", stand_in.diagnose)
    table = lane(tmp_path / "lane.csv", sequences=4, seconds=3.0, cars=3)
    return nnode.diagnose(table, options=ALONE)


def test_what_was_named_is_a_table(found: nnode.Report) -> None:
    assert found.verdict == "named"
    rows = found.to_dataframe()
    assert set(rows.effect) == {effect.name for effect in [*found.effects, *found.leads]}
    first = found.effects[0]
    (name, value), *_ = first.coefficients.items()
    row = rows[(rows.effect == first.name) & (rows.coefficient == name)].iloc[0]
    assert (row.estimate, row.lower, row.upper, row.unit) == (
        value.value,
        value.low,
        value.high,
        value.unit,
    )
    assert row.named
    assert [effect.name for effect in effects_of(found.model)] == [e.name for e in found.effects]
    assert found.plain()["verdict"] == "named"


def test_a_notebook_shows_the_sentence_and_the_table(found: nnode.Report) -> None:
    page = found._repr_html_()
    assert "<b>named</b>: The model lin lacks" in page
    assert f"<td>{found.effects[0].name}</td>" in page
    assert repr(found).startswith("named: The model lin lacks")


def test_coefficients_are_a_labelled_array(found: nnode.Report) -> None:
    pytest.importorskip("xarray")
    told = found.to_xarray()
    row = found.to_dataframe().iloc[0]
    assert float(told.estimate.sel(coefficient=f"{row.effect}.{row.coefficient}")) == row.estimate
    assert told.attrs["verdict"] == "named"


def made_up(number: int, seconds: float) -> pd.DataFrame:
    """A tidy table of platoons that follow ``lin``."""
    rows = [
        (f"s{b}", time, f"{b}/{i}", x)
        for b, s in enumerate(platoons(number=number, seconds=seconds))
        for k, time in enumerate(s.time)
        for i, x in enumerate(s.x[k, :, 0])
    ]
    return pd.DataFrame(rows, columns=["sequence", "time", "agent", "x"])


def test_nothing_missing_is_an_empty_table() -> None:
    frame = made_up(14, 8.0)
    found = nnode.diagnose(frame, "traffic", model="lin", options=ALONE)
    assert found.verdict == "none"
    assert found.effects == []
    assert found.to_dataframe().empty
    assert "<table" not in found._repr_html_()
    (panel, *_) = found.plot().axes
    assert panel.get_ylabel() == "position along the lane (m)"


def test_the_order_of_rows_and_sequences_changes_no_diagnosis() -> None:
    frame = made_up(12, 6.0)
    shuffled = frame.sample(frac=1.0, random_state=3)
    assert shuffled.sequence.iloc[0] != "s0"
    told = []
    for given in (frame, shuffled, nnode.sequences(frame, faults="keep")[::-1]):
        plain = nnode.diagnose(given, model="lin", options=ALONE).plain()
        del plain["seconds"]
        told.append(json.dumps(plain, sort_keys=True))
    assert told[0] == told[1] == told[2]


@pytest.mark.usefixtures("found")
def test_sequences_and_data_frames_are_diagnosed_alike(tmp_path: Path) -> None:
    tidy = table(platoons=4, seconds=4.0)
    of_frame = nnode.diagnose(tidy, options=ALONE).plain()
    of_sequences = nnode.diagnose(nnode.sequences(tidy, faults="keep"), options=ALONE).plain()
    assert of_frame["split"] == of_sequences["split"]
    written = nnode.diagnose(tidy, folder=tmp_path / "run", options=ALONE)
    assert written.plain()["split"] == of_frame["split"]
    # a data frame is kept as a table, for the commands that the report tells
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "run" / "table.parquet"), tidy)


def test_a_report_is_summarised(found: nnode.Report) -> None:
    text = found.summary()
    assert text.splitlines()[0] == found.sentence
    for effect in found.effects:
        assert all(f"{effect.name}.{name}" in text for name in effect.coefficients)


def test_a_report_draws_its_figures(found: nnode.Report) -> None:
    assert found.plot("coefficients").axes
    with pytest.raises(ConfigError, match="there is no figure 'heat'; this diagnosis has "):
        found.plot("heat")
