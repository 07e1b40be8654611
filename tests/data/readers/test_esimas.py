"""Reading the ESIMAS sequences: shapes, names, and files that are not what they should be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from nnode.data.readers.esimas import EsimasOptions, esimas_files, read_esimas
from nnode.errors import ConfigError, DataError
from tests.data.tables import esimas


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    time = 3.0 + 0.2 * np.arange(4)
    x = np.array([[0.0], [30.0], [55.0]]) + 25 * (time - 3)
    return esimas(tmp_path / "sequence_datademo.mat", (x, time), (x[:2, :3], time[:3]))


def test_reads_positions_times_and_names(recording: Path) -> None:
    first, second = read_esimas(recording)
    assert (first.name, second.name, first.recording) == ("demo/000", "demo/001", "demo")
    assert first.x.shape == (4, 3, 1)
    assert second.x.shape == (3, 2, 1)
    np.testing.assert_allclose(first.x[1, :, 0], [5.0, 35.0, 60.0])
    np.testing.assert_allclose(first.time, [3.0, 3.2, 3.4, 3.6])
    assert first.agents == ()


def test_reads_one_struct_array_as_well_as_cells(tmp_path: Path) -> None:
    structs = np.zeros((2,), dtype=[("Xarr", "O"), ("Tarr", "O")])
    for i in range(2):
        structs[i] = (np.array([[0.0, 4.0, 8.0], [30.0, 35.0, 40.0]]), np.array([0.0, 0.2, 0.4]))
    savemat(tmp_path / "sequence_dataown.mat", {"sequences": structs})
    assert [s.x.shape for s in read_esimas(tmp_path / "sequence_dataown.mat")] == [(3, 2, 1)] * 2


def test_holes_cut_and_uneven_times_are_interpolated(tmp_path: Path) -> None:
    time = 0.2 * np.arange(12)
    x = np.array([[0.0], [30.0]]) + 25 * time
    late = time + np.where(np.arange(12) == 5, 0.05, 0.0)
    gone = np.delete(np.arange(12), [5, 6])
    path = esimas(
        tmp_path / "sequence_dataown.mat",
        (x, time),
        (np.array([[0.0], [30.0]]) + 25 * late, late),
        (x[:, gone], time[gone]),
    )
    result = read_esimas(path)
    assert [(s.name, s.n_samples) for s in result] == [
        ("own/000", 12),
        ("own/001", 12),
        ("own/002_000", 5),
        ("own/002_001", 5),
    ]
    assert all(s.agents == () for s in result)
    np.testing.assert_allclose(result[1].x, result[0].x, atol=1e-9)
    uneven, cut = result.notes
    assert "times are uneven" in uneven
    assert "sequence own/002: not all vehicles are there at 2 of 12 times" in cut


@pytest.mark.real
@pytest.mark.parametrize(("family", "total", "fewest"), [(3, 265, 3), (2, 832, 2)])
def test_published_families(real_data: Path, family: int, total: int, fewest: int) -> None:
    files = esimas_files(EsimasOptions(source=str(real_data), min_vehicles=family))
    assert list(files) == [f"{c}-1_{s}" for c in range(1, 6) for s in (1, 2)]
    sequences = [s for path in files.values() for s in read_esimas(path)]
    assert len(sequences) == total
    assert min(s.n_agents for s in sequences) == fewest
    assert len({s.name for s in sequences}) == total
    for s in sequences:
        np.testing.assert_allclose(np.diff(s.time), 0.2, atol=1e-6)


@pytest.mark.real
def test_agrees_with_the_raw_file(real_data: Path) -> None:
    path = real_data / "esimas" / "sequence_data1-1_1.mat"
    raw = loadmat(path, simplify_cells=True)["sequences"]
    for s, cell in zip(read_esimas(path), raw, strict=True):
        np.testing.assert_array_equal(s.x[:, :, 0].T, cell["Xarr"])
        np.testing.assert_array_equal(s.time, cell["Tarr"])


def test_other_recordings_of_a_folder(recording: Path) -> None:
    source = str(recording.parent)
    assert list(esimas_files(EsimasOptions(source=source))) == ["demo"]
    assert list(esimas_files(EsimasOptions(source=source, recording=["demo"]))) == ["demo"]


def test_families_are_not_mixed_up(recording: Path) -> None:
    esimas(recording.with_name("sequence_data_demo.mat"), (np.ones((2, 3)), np.arange(3.0)))
    source = str(recording.parent)
    three = esimas_files(EsimasOptions(source=source))
    two = esimas_files(EsimasOptions(source=source, min_vehicles=2))
    assert three["demo"].name == "sequence_datademo.mat"
    assert two["demo"].name == "sequence_data_demo.mat"
    assert list(three) == list(two) == ["demo"]


def test_unknown_recording_names_the_nearest_first(recording: Path) -> None:
    with pytest.raises(ConfigError, match=r"recording=dem0.*nearest first.*are: demo, .*1-1_1"):
        esimas_files(EsimasOptions(source=str(recording.parent), recording="dem0"))


def test_unknown_family() -> None:
    with pytest.raises(ConfigError, match="min_vehicles=4"):
        esimas_files(EsimasOptions(min_vehicles=4))


@pytest.mark.parametrize("value", [[], {"a": 1}, 1.5])
def test_recording_must_be_names(recording: Path, value: object) -> None:
    with pytest.raises(ConfigError, match="expected 'all', a name or a list of names"):
        esimas_files(EsimasOptions(source=str(recording.parent), recording=value))


@pytest.mark.parametrize("size", [0, 60, 200, 300])
def test_truncated_file(recording: Path, size: int) -> None:
    recording.write_bytes(recording.read_bytes()[:size])
    with pytest.raises(DataError, match=r"sequence_datademo\.mat"):
        read_esimas(recording)


def test_file_of_another_format(tmp_path: Path) -> None:
    path = tmp_path / "sequence_dataown.mat"
    path.write_text("time,x\n0,1\n")
    with pytest.raises(DataError, match="cannot be read as a MATLAB file"):
        read_esimas(path)
    with pytest.raises(DataError, match="there is no file"):
        read_esimas(tmp_path / "sequence_dataother.mat")
    with pytest.raises(DataError, match="expected a file name like"):
        read_esimas(tmp_path / "other.mat")


def test_other_content(tmp_path: Path) -> None:
    path = tmp_path / "sequence_dataown.mat"
    savemat(path, {"data": np.ones(3)})
    with pytest.raises(DataError, match="expected a cell array 'sequences', found data"):
        read_esimas(path)
    savemat(path, {"sequences": np.empty((0, 1), dtype=object)})
    with pytest.raises(DataError, match="is empty"):
        read_esimas(path)
    savemat(path, {"sequences": np.ones((2, 2))})
    with pytest.raises(DataError, match=r"sequence 0: expected a struct"):
        read_esimas(path)
    esimas(path, (np.ones((2, 3)), np.arange(3.0)), (np.ones((2, 3)), np.arange(4.0)))
    with pytest.raises(DataError, match=r"sequence 1: expected Xarr .* found \(2, 3\) and \(4,\)"):
        read_esimas(path)
    esimas(path, (np.array("text"), np.arange(3.0)))
    with pytest.raises(DataError, match="Xarr holds no plain numbers"):
        read_esimas(path)
