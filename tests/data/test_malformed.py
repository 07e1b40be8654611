"""Files that formerly caused crashes, long run times or errors of other packages."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from nnode.data.cut import Reading
from nnode.data.options import DataOptions
from nnode.data.prepare import FORMATS
from nnode.data.readers import matlab
from nnode.data.readers.esimas import read_esimas
from nnode.data.readers.juelich import JuelichOptions
from nnode.data.readers.matlab import Other, read_matlab
from nnode.data.readers.table import TableOptions, read_table
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.errors import DataError, NNodeError
from tests.data.tables import esimas

PLATOONS = [(np.arange(6.0).reshape(2, 3) + i, np.arange(3)[None]) for i in range(2)]


@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_values_of_all_kinds(tmp_path: Path, compressed: bool) -> None:
    cells = np.empty((1, 2), dtype=object)
    cells[0] = [{"x": x, "time": time} for x, time in PLATOONS]
    values = {
        "cells": cells,
        "small": np.array([[1, 2]], np.uint8),
        "pair": np.array([(1.0, 2)], dtype=[("a", "f8"), ("b", "i4")]),
        "text": "words",
        "z": np.array([1j]),
        "many": np.array([(1.0,), (2.0,)], dtype=[("a", "f8")]),
        "empty": np.zeros((0, 3)),
    }
    savemat(tmp_path / "a.mat", values, do_compression=compressed)
    result = read_matlab(tmp_path / "a.mat")
    for cell, (x, time) in zip(result["cells"], PLATOONS, strict=True):
        np.testing.assert_array_equal(cell["x"], x, strict=True)
        np.testing.assert_array_equal(cell["time"], time)
    np.testing.assert_array_equal(result["small"], [[1, 2]])
    assert result["pair"] == {"a": [[1.0]], "b": [[2]]}
    assert [element["a"].item() for element in result["many"]] == [1.0, 2.0]
    assert result["empty"].shape == (0, 3)
    assert isinstance(result["text"], Other)
    assert isinstance(result["z"], Other)


@pytest.mark.thorough
@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_file_with_a_flipped_bit_is_read_or_refused(
    tmp_path: Path, compressed: bool
) -> None:
    path = tmp_path / "sequence_datax.mat"
    content = esimas(path, *PLATOONS, packed=compressed).read_bytes()
    refused = 0
    for bit in range(8 * 124, 8 * len(content), 1 if compressed else 7):  # 7: in every byte
        data = bytearray(content)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        try:
            read_esimas(path)
        except DataError:
            refused += 1
    assert refused > 100


def test_large_decompressed_matlab_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matlab, "MOST_BYTES", 1 << 20)
    path = tmp_path / "sequence_datax.mat"
    header = esimas(path, *PLATOONS).read_bytes()[:128]
    bomb = zlib.compress(bytes(1 << 24))
    path.write_bytes(header + struct.pack("<II", 15, len(bomb)) + bomb)
    with pytest.raises(DataError, match="truncated, or has more than 1048576 bytes"):
        read_esimas(path)


TIDY, CARS = "sequence,time,agent,x\n", "vehicle,time,x\n"
PLATOON = CARS + "".join(f"{n},{t},{20 * n + 10 * t}\n" for n in (1, 2, 3) for t in (0, 0.2, 0.4))


def read(path: Path, options: DataOptions, text: str) -> Reading:
    path.write_text(text)
    return FORMATS[type(options)].read({"table": path}, options)


@pytest.mark.parametrize(
    ("options", "text", "message"),
    [
        # a distant frame needs no memory
        (
            JuelichOptions(unit="m"),
            "# framerate: 16\n1 1 0 0 0\n1 2 1 0 0\n2 4000000000000 1 0 0\n",
            "3 rows stand in frames 1 to 4000000000000",
        ),
        *(
            (
                JuelichOptions(unit="m"),
                f"# framerate: {rate}\n1 1 0 0 0\n1 2 1 0 0\n",
                "frame rate",
            )
            for rate in ("1e308", "1e9", "inf", "-16", "0")
        ),
        (
            TableOptions(domain="traffic"),
            TIDY + "".join(f"s,{k},a,{k},9\n" for k in range(3)),
            "more cells in its rows than names",
        ),
        # times too large for the step
        *(
            (VehicleTableOptions(), f"{PLATOON}1,{time},0\n", r"line 11: the time .* cannot count")
            for time in ("1e308", "-1e300", "1e17")
        ),
    ],
)
def test_invalid_files(tmp_path: Path, options: DataOptions, text: str, message: str) -> None:
    with pytest.raises(NNodeError, match=message):
        read(tmp_path / "file.txt", options, text)


def test_size_of_a_sequence_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nnode.data.cut.MOST_CELLS", 100)
    text = TIDY + "".join(f"s,{k},a{k},{k}\n" for k in range(11))
    with pytest.raises(DataError, match="11 times and 11 agents in 11 rows, expected at most"):
        read(tmp_path / "t.csv", TableOptions(domain="traffic"), text)


def test_windows_of_intervals_far_apart(tmp_path: Path) -> None:
    start = 0.2 * np.arange(5)
    times = [*start, *(1e9 + start)]
    text = CARS + "".join(f"{n},{t},{20 * n + 10 * t}\n" for n in (1, 2, 3) for t in times)
    result = read(tmp_path / "c.csv", VehicleTableOptions(window=0.4), text)
    assert [s.n_samples for s in result] == [3, 3, 3, 3]
    assert result[-1].time[-1] == pytest.approx(1e9 + 0.8)


def test_large_numbers_as_names(tmp_path: Path) -> None:
    text = PLATOON + "".join(f"1e300,{t},{90 + t}\n" for t in (0, 0.2, 0.4))
    assert "1e+300" in read(tmp_path / "c.csv", VehicleTableOptions(), text)[0].agents


def test_invalid_pandas_metadata_in_parquet(tmp_path: Path) -> None:
    table = pa.table({"sequence": ["s"], "time": [0.0], "agent": ["a"], "x": [1.0]})
    metadata = b'{"columns": [{"name": "x", "pandas_type": "float64"}], "index_columns": []}'
    path = tmp_path / "t.parquet"
    pq.write_table(table.replace_schema_metadata({b"pandas": metadata}), path)
    with pytest.raises(DataError, match="cannot be read as a Parquet table"):
        read_table(path, TableOptions(domain="traffic"))
