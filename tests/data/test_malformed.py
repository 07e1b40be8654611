"""Files that once led to crashes, endless work or foreign errors."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from nnode.data.readers import matlab
from nnode.data.readers.esimas import read_esimas
from nnode.data.readers.juelich import JuelichOptions, read_juelich
from nnode.data.readers.matlab import Other, read_matlab
from nnode.data.readers.table import TableOptions, read_table
from nnode.data.readers.vehicles import VehicleTableOptions, read_vehicles
from nnode.errors import DataError, NNodeError


def saved(path: Path, *, packed: bool, **values: object) -> Path:
    savemat(path, values, do_compression=packed)
    return path


def cells() -> np.ndarray:
    found = np.empty((1, 2), dtype=object)
    for i in range(2):
        found[0, i] = {"Xarr": np.arange(6.0).reshape(2, 3) + i, "Tarr": np.arange(3)[None]}
    return found


@pytest.mark.parametrize("packed", [False, True])
def test_matlab_values_of_all_kinds(tmp_path: Path, packed: bool) -> None:
    path = saved(
        tmp_path / "a.mat",
        packed=packed,
        cells=cells(),
        small=np.array([[1, 2]], np.uint8),
        one=np.array([(1.0, 2)], dtype=[("a", "f8"), ("b", "i4")]),
        text="words",
        z=np.array([1j]),
        many=np.array([(1.0,), (2.0,)], dtype=[("a", "f8")]),
        empty=np.zeros((0, 3)),
    )
    found = read_matlab(path)
    for i in range(2):
        np.testing.assert_array_equal(
            found["cells"][i]["Xarr"], np.arange(6.0).reshape(2, 3) + i, strict=True
        )
    np.testing.assert_array_equal(found["small"], [[1, 2]])
    assert found["one"] == {"a": [[1.0]], "b": [[2]]}
    assert [one["a"].item() for one in found["many"]] == [1.0, 2.0]
    assert found["empty"].shape == (0, 3)
    assert isinstance(found["text"], Other)
    assert isinstance(found["z"], Other)


@pytest.mark.thorough
@pytest.mark.parametrize("packed", [False, True])
def test_single_bits_of_a_matlab_file_is_read_or_refused(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "sequence_datax.mat"
    sound = saved(path, packed=packed, sequences=cells()).read_bytes()
    refused = 0
    for bit in range(8 * 124, 8 * len(sound), 1 if packed else 7):  # 7: in every byte
        data = bytearray(sound)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        try:
            read_esimas(path)
        except DataError:
            refused += 1
    assert refused > 100


def test_a_matlab_file_that_swells_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matlab, "MOST_BYTES", 1 << 20)
    path = tmp_path / "sequence_datax.mat"
    head = saved(path, packed=False, sequences=cells()).read_bytes()[:128]
    bomb = zlib.compress(bytes(1 << 24))
    path.write_bytes(head + struct.pack("<II", 15, len(bomb)) + bomb)
    with pytest.raises(DataError, match="truncated, or has more than 1048576 bytes"):
        read_esimas(path)


def test_a_frame_far_away_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "corridor.txt"
    path.write_text("# framerate: 16\n1 1 0 0 0\n1 2 1 0 0\n2 4000000000000 1 0 0\n")
    with pytest.raises(DataError, match=r"3 rows stand in frames 1 to 4000000000000"):
        read_juelich(path, JuelichOptions(unit="m"))


@pytest.mark.parametrize("rate", ["1e308", "1e9", "inf", "-16", "0"])
def test_a_frame_rate_of_no_camera_is_refused(tmp_path: Path, rate: str) -> None:
    path = tmp_path / "corridor.txt"
    path.write_text(f"# framerate: {rate}\n1 1 0 0 0\n1 2 1 0 0\n")
    with pytest.raises(NNodeError, match="frame rate"):
        read_juelich(path, JuelichOptions(unit="m"))


def test_more_cells_than_names_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("sequence,time,agent,x\n" + "".join(f"s,{k},a,{k},9\n" for k in range(3)))
    with pytest.raises(DataError, match="more cells in its rows than names"):
        read_table(path, TableOptions(domain="traffic"))


def test_times_and_agents_of_a_sequence_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nnode.data.cut.MOST_CELLS", 100)
    path = tmp_path / "t.csv"
    path.write_text("sequence,time,agent,x\n" + "".join(f"s,{k},a{k},{k}\n" for k in range(11)))
    with pytest.raises(DataError, match="11 times and 11 agents in 11 rows, expected at most"):
        read_table(path, TableOptions(domain="traffic"))


def cars(path: Path, *times: float, vehicle: str = "1") -> Path:
    rows = [f"{n},{t},{20 * n + 10 * t}" for n in (1, 2, 3) for t in times]
    path.write_text("vehicle,time,x\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize("time", ["1e308", "-1e300", "1e17"])
def test_times_that_no_step_counts_are_refused(tmp_path: Path, time: str) -> None:
    path = cars(tmp_path / "c.csv", 0.0, 0.2, 0.4)
    path.write_text(path.read_text() + f"1,{time},0\n")
    with pytest.raises(DataError, match=r"line 11: the time is .* cannot count"):
        read_vehicles(path, VehicleTableOptions())


def test_windows_between_two_stays_far_apart_take_no_time(tmp_path: Path) -> None:
    near = [0.0, 0.2, 0.4, 0.6, 0.8]
    path = cars(tmp_path / "c.csv", *near, *(1e9 + t for t in near))
    found = read_vehicles(path, VehicleTableOptions(window=0.4))
    assert [s.n_samples for s in found] == [3, 3, 3, 3]
    assert found[-1].time[-1] == pytest.approx(1e9 + 0.8)


def test_huge_whole_numbers_are_names(tmp_path: Path) -> None:
    path = cars(tmp_path / "c.csv", 0.0, 0.2, 0.4)
    path.write_text(path.read_text() + "".join(f"1e300,{t},{90 + t}\n" for t in (0, 0.2, 0.4)))
    assert "1e+300" in read_vehicles(path, VehicleTableOptions())[0].agents


def test_damaged_notes_of_pandas_in_parquet_are_refused(tmp_path: Path) -> None:
    table = pa.table({"sequence": ["s"], "time": [0.0], "agent": ["a"], "x": [1.0]})
    notes = b'{"columns": [{"name": "x", "pandas_type": "float64"}], "index_columns": []}'
    path = tmp_path / "t.parquet"
    pq.write_table(table.replace_schema_metadata({b"pandas": notes}), path)
    with pytest.raises(DataError, match="cannot be read as a Parquet table"):
        read_table(path, TableOptions(domain="traffic"))
