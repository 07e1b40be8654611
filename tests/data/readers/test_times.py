"""Times that are no seconds: dates, clock times, durations, and numbers in other units."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode import Calibrator, diagnose, sequences
from nnode.data.readers.columns import Table
from nnode.data.sequence import Sequence, collate
from nnode.data.sequences import Sequences
from nnode.errors import ConfigError, DataError
from tests.data.tables import saved

STEP, SAMPLES = 0.2, 40
START = pd.Timestamp("2020-01-01 08:00")


def tidy() -> pd.DataFrame:
    """Three vehicles, 25 m apart, at about 15 m/s, every 0.2 s."""
    k, n = (axis.ravel() for axis in np.meshgrid(np.arange(SAMPLES), np.arange(3), indexing="ij"))
    x = 25.0 * n + 3.0 * k + 0.3 * np.sin(k / 4 + n)
    time = np.round(STEP * k, 3)
    return pd.DataFrame({"sequence": "s", "time": time, "agent": [f"c{i}" for i in n], "x": x})


def crowd() -> pd.DataFrame:
    table = tidy()
    return table.assign(x=table.x / 10, y=0.0)


def vehicles() -> pd.DataFrame:
    return tidy().drop(columns="sequence").rename(columns={"agent": "vehicle"})


def pairs() -> pd.DataFrame:
    x = tidy().pivot(index="time", columns="agent", values="x")
    return pd.DataFrame({"time": x.index, "x_follower": x.c0.values, "x_leader": x.c1.values})


SOURCES = [tidy, crowd, vehicles, pairs]


def stamps(time: pd.Series) -> pd.Series:
    return START + pd.to_timedelta(time, unit="s")


#: Times of the same rows that say themselves that they are no numbers.
DATES: dict[str, Callable[[pd.Series], pd.Series]] = {
    "datetimes": stamps,
    "with a time zone": lambda t: stamps(t).dt.tz_localize("Europe/Berlin"),
    "microseconds of pandas": lambda t: stamps(t).astype("datetime64[us]"),
    "timedeltas": lambda t: pd.to_timedelta(t, unit="s"),
    "ISO dates": lambda t: stamps(t).dt.strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
    "clock times": lambda t: stamps(t).dt.strftime("%H:%M:%S.%f"),
    "times of Python": lambda t: stamps(t).dt.time,
    "dates of Python": lambda t: pd.Series(
        [START.to_pydatetime() + datetime.timedelta(seconds=s) for s in t], dtype=object
    ),
    "durations as text": lambda t: pd.to_timedelta(t, unit="s").astype(str),
}
UNITS = {"ms": 1e3, "us": 1e6, "ns": 1e9}


@pytest.mark.parametrize("kind", DATES)
@pytest.mark.parametrize("make", SOURCES)
def test_dates_become_seconds_since_the_first(make: Callable[[], pd.DataFrame], kind: str) -> None:
    table = make()
    result = sequences(table.assign(time=DATES[kind](table.time)))
    expected = sequences(table)
    assert result.manifest["dt"] == STEP
    assert len(result) == len(expected)
    for actual, other in zip(result, expected, strict=True):
        np.testing.assert_allclose(actual.time, other.time, rtol=0, atol=1e-9)
        np.testing.assert_allclose(actual.x, other.x, rtol=0, atol=1e-9)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_dates_in_files(tmp_path: Path, suffix: str) -> None:
    table = tidy().assign(time=stamps(tidy().time))
    (result,) = sequences(saved(tmp_path / f"t{suffix}", table))
    np.testing.assert_allclose(result.time, STEP * np.arange(SAMPLES), atol=1e-9)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("make", SOURCES)
def test_epochs_are_recognised_or_refused_with_the_unit_that_reads_them(
    make: Callable[[], pd.DataFrame], unit: str
) -> None:
    table, scale = make(), int(UNITS[unit])
    epoch = table.assign(time=1_577_865_600 * scale + (table.time * scale).round().astype("int64"))
    if make in (vehicles, pairs):
        assert sequences(epoch).manifest["dt"] == pytest.approx(STEP, rel=1e-6)
    else:  # the units of a tidy table are those that are documented, or given
        with pytest.raises(DataError, match=rf"time_unit={unit}"):
            sequences(epoch)
    result = sequences(epoch, time_unit=unit)
    assert result.manifest["dt"] == pytest.approx(STEP, rel=1e-6)
    x = [s.x for s in sequences(table)]
    # the grid of vehicles begins at a whole number of steps since 1970
    shift = 1e-5 if make is vehicles else 1e-9
    for actual, other in zip(result, x, strict=True):
        np.testing.assert_allclose(actual.x, other, rtol=0, atol=shift)


def test_seconds_stay_as_they_are() -> None:
    """Predictions have the times of the table, so that both can be joined."""
    table = tidy().assign(time=1_577_865_600.0 + tidy().time)
    predicted = Calibrator("lin", epochs=1).fit(table).predict(table).to_dataframe()
    assert set(predicted.time) == set(table.time)


def test_short_sequences_since_1970_have_one_interval() -> None:
    """Seconds since 1970 are rounded to 2e-7 s: intervals of 0.02 s would differ by 1e-5."""
    parts = []
    for i in range(20):
        rows = tidy()[tidy().time < 0.5]
        time = rows.time / 10 + 7.31 * i
        parts.append(rows.assign(sequence=f"s{i}", time=time, x=rows.x / 10))
    table = pd.concat(parts)
    epoch = table.assign(time=(1_577_865_600_000 + 1000 * table.time).round().astype("int64"))
    assert len(sequences(epoch, time_unit="ms")) == 20


@pytest.mark.parametrize("scale", [1e3, 1e6, 1e9, 1 / 3600, 1 / 86400])
def test_whatever_takes_data_refuses_times_in_another_unit(scale: float) -> None:
    table = tidy().assign(time=tidy().time * scale)
    read = r"data=table: samples are .* s apart; expected at least 0\.001 s"
    with pytest.raises(DataError, match=read):
        Calibrator("lin").fit(table)
    with pytest.raises(DataError, match=read):
        diagnose(table)
    # sequences of one's own, which no reader has seen
    (good,) = sequences(tidy())
    bad = [Sequence(name=n, recording=n, time=good.time * scale, x=good.x) for n in "abcd"]
    message = r"sequence [abcd]: samples are .* s apart"
    with pytest.raises(DataError, match=message):
        collate(bad)
    with pytest.raises(DataError, match=message):
        Calibrator("lin").fit(bad)
    with pytest.raises(DataError, match=message):
        Sequences(bad)


def test_dates_of_several_files_count_from_one_start(tmp_path: Path) -> None:
    for name, later in (("a", 0.0), ("b", 90.0)):
        pairs().assign(time=stamps(pairs().time + later)).to_csv(tmp_path / f"{name}.csv")
    starts = {s.name: s.time[0] for s in sequences(tmp_path, data="pairs")}
    assert starts == {"pairs/a": 0.0, "pairs/b": 90.0}


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (["2020-01-01 08:00", "noon", "2020-01-01 08:01"], "row 2: .* 'noon'; expected seconds"),
        (["08:00:00", None, "08:00:01"], "row 2: .* holds nothing; expected seconds, or dates"),
        (["31/01/2020 08:00"] * 3, "row 1: .* expected seconds, or dates"),
        (["soon", "later", "never"], "row 1: column 'time' holds 'soon'; expected seconds"),
        (["0.1", "08:00:00", "0.3"], "row 2: column 'time' holds '08:00:00'"),
        (["0001-01-01"] * 3, "holds no dates of our time"),
    ],
)
def test_what_is_no_time_names_its_row(cells: list[str | None], message: str) -> None:
    with pytest.raises(DataError, match=message):
        Table(pd.DataFrame({"time": cells, "x": 1.0})).times("time")


def test_positions_are_no_dates() -> None:
    table = tidy().assign(x=stamps(tidy().time))
    with pytest.raises(DataError, match="column 'x' holds dates or durations; expected numbers"):
        sequences(table, data="table", domain="traffic")


@pytest.mark.parametrize("data", ["table", "pairs"])
def test_an_unknown_unit_lists_the_known_ones(data: str) -> None:
    table = tidy() if data == "table" else pairs()
    options = {"domain": "traffic"} if data == "table" else {}
    with pytest.raises(ConfigError, match="time_unit=h: expected one of s, ms, us, ns"):
        sequences(table, data=data, time_unit="h", **options)
