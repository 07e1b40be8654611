"""The ESIMAS sequences: shapes, names, and invalid files."""

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


def test_positions_times_and_names(recording: Path) -> None:
    first, second = read_esimas(recording)
    assert (first.name, second.name, first.recording) == ("demo/000", "demo/001", "demo")
    assert first.x.shape == (4, 3, 1)
    assert second.x.shape == (3, 2, 1)
    np.testing.assert_allclose(first.x[1, :, 0], [5.0, 35.0, 60.0])
    np.testing.assert_allclose(first.time, [3.0, 3.2, 3.4, 3.6])
    assert first.agents == ()


def test_struct_array_without_cells(tmp_path: Path) -> None:
    structs = np.zeros((2,), dtype=[("Xarr", "O"), ("Tarr", "O")])
    for i in range(2):
        structs[i] = (np.array([[0.0, 4.0, 8.0], [30.0, 35.0, 40.0]]), np.array([0.0, 0.2, 0.4]))
    savemat(tmp_path / "sequence_datax.mat", {"sequences": structs})
    assert [s.x.shape for s in read_esimas(tmp_path / "sequence_datax.mat")] == [(3, 2, 1)] * 2


def test_holes_and_uneven_times(tmp_path: Path) -> None:
    """A hole divides a platoon; uneven times are interpolated."""

    def platoon(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([[0.0], [30.0]]) + 25 * time, time

    time = 0.2 * np.arange(12)
    uneven = time + 0.05 * (np.arange(12) == 5)
    times = (time, uneven, np.delete(time, [5, 6]))
    result = read_esimas(esimas(tmp_path / "sequence_datax.mat", *map(platoon, times)))
    sizes = {s.name: s.n_samples for s in result}
    assert sizes == {"x/000": 12, "x/001": 12, "x/002_000": 5, "x/002_001": 5}
    assert all(s.agents == () for s in result)
    np.testing.assert_allclose(result[1].x, result[0].x, atol=1e-9)
    interpolated, divided = result.notes
    assert "times are uneven" in interpolated
    assert "sequence x/002: not all vehicles are there at 2 of 12 times" in divided


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


@pytest.mark.parametrize("options", [{}, {"recording": ["demo"]}])
def test_recordings_of_a_folder(recording: Path, options: dict[str, list[str]]) -> None:
    assert list(esimas_files(EsimasOptions(source=str(recording.parent), **options))) == ["demo"]


def test_families_are_kept_apart(recording: Path) -> None:
    esimas(recording.with_name("sequence_data_demo.mat"), (np.ones((2, 3)), np.arange(3.0)))
    for size, name in ((3, "sequence_datademo.mat"), (2, "sequence_data_demo.mat")):
        files = esimas_files(EsimasOptions(source=str(recording.parent), min_vehicles=size))
        assert {key: path.name for key, path in files.items()} == {"demo": name}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"min_vehicles": 4}, "min_vehicles=4"),
        ({"recording": "dem0"}, r"recording=dem0.*nearest first.*are: demo, .*1-1_1"),
        *(
            ({"recording": value}, "expected 'all', a name or a list of names")
            for value in ([], {"a": 1}, 1.5)
        ),
    ],
)
def test_invalid_options(recording: Path, options: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        esimas_files(EsimasOptions(source=str(recording.parent), **options))


@pytest.mark.parametrize("size", [0, 60, 200, 300])
def test_truncated_file(recording: Path, size: int) -> None:
    recording.write_bytes(recording.read_bytes()[:size])
    with pytest.raises(DataError, match=r"sequence_datademo\.mat"):
        read_esimas(recording)


def test_other_format_and_other_names(tmp_path: Path) -> None:
    (tmp_path / "sequence_datax.mat").write_text("time,x\n0,1\n")
    for name, message in (
        ("sequence_datax.mat", "cannot be read as a MATLAB file"),
        ("sequence_dataother.mat", "there is no file"),
        ("other.mat", "expected a file name like"),
    ):
        with pytest.raises(DataError, match=message):
            read_esimas(tmp_path / name)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"data": np.ones(3)}, "expected a cell array 'sequences', found data"),
        ({"sequences": np.empty((0, 1), dtype=object)}, "is empty"),
        ({"sequences": np.ones((2, 2))}, "sequence 0: expected a struct"),
    ],
)
def test_invalid_content(tmp_path: Path, content: dict[str, np.ndarray], message: str) -> None:
    path = tmp_path / "sequence_datax.mat"
    savemat(path, content)
    with pytest.raises(DataError, match=message):
        read_esimas(path)


def test_invalid_platoons(tmp_path: Path) -> None:
    path = tmp_path / "sequence_datax.mat"
    time = np.arange(3.0)
    esimas(path, (np.ones((2, 3)), time), (np.ones((2, 3)), np.arange(4.0)))
    with pytest.raises(DataError, match=r"sequence 1: expected Xarr .* found \(2, 3\) and \(4,\)"):
        read_esimas(path)
    esimas(path, (np.array("text"), time))
    with pytest.raises(DataError, match="Xarr holds no plain numbers"):
        read_esimas(path)
