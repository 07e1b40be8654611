"""Unexpected cells and columns, in files and in data frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.data.options import DataOptions
from nnode.data.readers.columns import Table, floats
from nnode.data.readers.ngsim import NgsimOptions
from nnode.data.readers.openacc import OpenAccOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.readers.recordings import reading
from nnode.data.readers.sumo import SumoOptions
from nnode.data.readers.table import TableOptions
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.errors import ConfigError, DataError
from tests.data.tables import read, saved, tidy


def lane() -> pd.DataFrame:
    return tidy(20, 3).assign(note="-", agent=lambda t: "c" + t.agent.astype(str))


def cells(value: Any) -> pd.Series:
    return pd.Series([value] * 60, dtype=object)


def test_duplicate_column_names() -> None:
    table = lane()
    with pytest.raises(DataError, match="2 columns 'x'; give every column a name of its own"):
        nnode.sequences(pd.concat([table, table[["x"]]], axis=1))


@pytest.mark.parametrize(
    ("column", "value", "shown"),
    [
        ("x", 10**400, "'1000000"),
        pytest.param("x", 10**5000, "too large", id="huge"),
        ("x", 1j, "'1j'"),
        ("x", [1, 2], r"'\[1, 2\]'"),
        ("x", np.array([1.0, 2.0]), r"'\[1\. 2\.\]'"),
        ("agent", b"a\xff", r"b'a\\xff'|b'a\\\\xff'"),
    ],
)
def test_invalid_numbers_and_names(column: str, value: Any, shown: str) -> None:
    with pytest.raises(DataError, match=rf"table, row 1: column '{column}' holds .*{shown}"):
        nnode.sequences(lane().assign(**{column: cells(value)}))


def test_complex_numbers_are_not_numbers() -> None:
    assert np.isnan(floats(pd.Series([1 + 2j]))).all()


@pytest.mark.parametrize("value", [{}, [1], np.array([1, 2]), b"a\xff", 10**400], ids=str)
def test_cells_of_other_columns_are_ignored(value: Any) -> None:
    assert len(nnode.sequences(lane().assign(note=cells(value)))) == 1


def test_null_characters_in_names_are_removed(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    lane().to_csv(path, index=False)
    path.write_bytes(path.read_bytes().replace(b"c1,", b"c1\0,", 1))
    assert set(Table(path).names("agent")) == {"c0", "c1", "c2"}


def test_names_with_invalid_encoding(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    lane().replace({"agent": {"c1": "zzqq"}}).to_parquet(path, compression=None)
    path.write_bytes(path.read_bytes().replace(b"zzqq", b"\xffzqq"))
    with pytest.raises(DataError, match=r"column 'agent' holds .*; expected a name or number"):
        Table(path).names("agent")


def test_unexpected_error_names_the_file() -> None:
    with (
        pytest.raises(DataError, match=r"a\.csv cannot be read \(KeyError: 'q'\)"),
        reading("a.csv"),
    ):
        raise KeyError("q")
    with pytest.raises(ConfigError, match=r"^message$"), reading("a.csv"):
        raise ConfigError("message")


@pytest.mark.parametrize("length", [0.0, -4.5])
@pytest.mark.parametrize(
    ("kind", "column"),
    [
        (TableOptions, "length"),
        (VehicleTableOptions, "length"),
        (PairOptions, "leader_length"),
        (PairOptions, "follower_length"),
    ],
)
def test_lengths_must_be_positive(
    tmp_path: Path, kind: type[DataOptions], column: str, length: float
) -> None:
    table = tidy(4, 2).assign(vehicle=0, x_follower=0.0, x_leader=30.0).assign(**{column: length})
    path = saved(tmp_path / "t.csv", table)
    with pytest.raises(DataError, match=f"line 2: column '{column}' holds .*expected a positive"):
        read(kind, path, domain="traffic")


PLATOON = "run,position,t,v,gap\n" + "".join(
    f"r,{p},{0.1 * i:.1f},10,15\n" for p in (1, 2, 3) for i in range(12)
)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        *(
            (f"r,{position},0.5,10,15\n", "line 38: position is .* whole number from 1 to 1000")
            for position in ("2147483648", "1001", "-4", "0", "1.5", "1e300")
        ),
        # times that would need a large table
        ("".join(f"r,{p},90000.0,10,15\n" for p in range(4, 16)), "wrong, or cut the file"),
    ],
)
def test_invalid_positions_and_times_of_a_platoon(tmp_path: Path, rows: str, message: str) -> None:
    path = tmp_path / "flat.csv"
    path.write_text(PLATOON + rows)
    with pytest.raises(DataError, match=message):
        read(OpenAccOptions, path, min_duration=0.3)


@pytest.mark.parametrize("encoding", ["inf", "utf-7", "shift_jis", "idna"])
def test_unsupported_xml_encodings(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.xml"
    path.write_text(
        f'<?xml version="1.0" encoding="{encoding}"?>\n<fcd-export>\n<timestep time="0">'
        '<vehicle id="a" lane="e_0" pos="1" speed="1"/></timestep>\n</fcd-export>\n'
    )
    with pytest.raises(DataError):
        read(SumoOptions, path)


def test_ngsim_clock_out_of_range(tmp_path: Path) -> None:
    from benchmarks.fault_injection.targets import CORPUS

    path, content = tmp_path / "a.csv", (CORPUS / "ngsim.csv").read_bytes()
    path.write_bytes(content.replace(b",1113433135100,", b",1e308,", 1))
    with pytest.raises(DataError, match=r"line 2: Global_Time and Frame_ID put frame 0 at 1e\+308"):
        read(NgsimOptions, path)


def test_error_message_shortens_long_cells(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("vehicle,time,x\n" + "".join(f"{n},0,{'9' * 5000}\n" for n in range(4)))
    with pytest.raises(DataError, match="holds") as error:
        read(VehicleTableOptions, path)
    assert len(str(error.value)) <= 2000
