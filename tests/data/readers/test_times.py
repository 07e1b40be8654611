"""Times other than seconds: dates, clock times, durations, and numbers in other units."""

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


#: The same times as dates, clock times and durations.
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


def assert_equal_paths(
    result: Sequences, expected: Sequences, *, times: bool = False, atol: float = 1e-9
) -> None:
    assert len(result) == len(expected)
    for actual, desired in zip(result, expected, strict=True):
        np.testing.assert_allclose(actual.x, desired.x, rtol=0, atol=atol)
        if times:
            np.testing.assert_allclose(actual.time, desired.time, rtol=0, atol=atol)


@pytest.mark.parametrize("kind", DATES)
@pytest.mark.parametrize("make", SOURCES)
def test_dates_become_seconds(make: Callable[[], pd.DataFrame], kind: str) -> None:
    table = make()
    result = sequences(table.assign(time=DATES[kind](table.time)))
    assert result.manifest["dt"] == STEP
    assert_equal_paths(result, sequences(table), times=True)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_dates_in_files(tmp_path: Path, suffix: str) -> None:
    table = tidy().assign(time=stamps(tidy().time))
    (result,) = sequences(saved(tmp_path / f"t{suffix}", table))
    np.testing.assert_allclose(result.time, STEP * np.arange(SAMPLES), atol=1e-9)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("make", SOURCES)
def test_epochs_are_recognised_or_refused(make: Callable[[], pd.DataFrame], unit: str) -> None:
    """The error of a refused table states the unit."""
    table, scale = make(), int(UNITS[unit])
    epoch = table.assign(time=1_577_865_600 * scale + (table.time * scale).round().astype("int64"))
    if make in (vehicles, pairs):
        assert sequences(epoch).manifest["dt"] == pytest.approx(STEP, rel=1e-6)
    else:
        with pytest.raises(DataError, match=rf"time_unit={unit}"):
            sequences(epoch)
    result = sequences(epoch, time_unit=unit)
    assert result.manifest["dt"] == pytest.approx(STEP, rel=1e-6)
    # the time grid of vehicles starts at a multiple of the step since 1970
    assert_equal_paths(result, sequences(table), atol=1e-5 if make is vehicles else 1e-9)


def test_seconds_are_kept() -> None:
    """Predictions have the times of the table, so that the two can be joined."""
    table = tidy()
    table["time"] += 1_577_865_600.0
    predicted = Calibrator("lin", epochs=1).fit(table).predict(table).to_dataframe()
    assert set(predicted.time) == set(table.time)


def test_epochs_of_short_sequences_have_one_interval() -> None:
    """Seconds since 1970 are rounded to 2e-7 s, which is 1e-5 of an interval of 0.02 s."""
    rows = tidy()[tidy().time < 0.5]
    parts = [
        rows.assign(sequence=f"s{i}", time=rows.time / 10 + 7.31 * i, x=rows.x / 10)
        for i in range(20)
    ]
    table = pd.concat(parts)
    epoch = table.assign(time=(1_577_865_600_000 + 1000 * table.time).round().astype("int64"))
    assert len(sequences(epoch, time_unit="ms")) == 20


@pytest.mark.parametrize("scale", [1e3, 1e6, 1e9, 1 / 3600, 1 / 86400])
def test_times_in_another_unit_are_refused(scale: float) -> None:
    table = tidy().assign(time=tidy().time * scale)
    (valid,) = sequences(tidy())
    items = [Sequence(name=n, recording=n, time=valid.time * scale, x=valid.x) for n in "abcd"]
    for function, data, subject in (
        (Calibrator("lin").fit, table, "data=table"),
        (diagnose, table, "data=table"),
        # sequences that no reader has checked
        (collate, items, "sequence [abcd]"),
        (Calibrator("lin").fit, items, "sequence [abcd]"),
        (Sequences, items, "sequence [abcd]"),
    ):
        with pytest.raises(DataError, match=rf"{subject}: samples are .* s apart") as error:
            function(data)
        assert data is items or r"expected at least 0.001 s" in str(error.value)


def test_dates_of_several_files_have_one_origin(tmp_path: Path) -> None:
    for name, delay in (("a", 0.0), ("b", 90.0)):
        pairs().assign(time=stamps(pairs().time + delay)).to_csv(tmp_path / f"{name}.csv")
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
def test_invalid_times(cells: list[str | None], message: str) -> None:
    with pytest.raises(DataError, match=message):
        Table(pd.DataFrame({"time": cells, "x": 1.0})).times("time")


def test_dates_as_positions_are_refused() -> None:
    table = tidy().assign(x=stamps(tidy().time))
    with pytest.raises(DataError, match="column 'x' holds dates or durations; expected numbers"):
        sequences(table, data="table", domain="traffic")


@pytest.mark.parametrize(
    ("make", "options"),
    [(tidy, {"data": "table", "domain": "traffic"}), (pairs, {"data": "pairs"})],
)
def test_unknown_time_unit(make: Callable[[], pd.DataFrame], options: dict[str, str]) -> None:
    with pytest.raises(ConfigError, match="time_unit=h: expected one of s, ms, us, ns"):
        sequences(make(), time_unit="h", **options)
