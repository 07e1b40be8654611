"""Text files of pedestrians: sequences, units, walls, velocities, invalid lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nnode.data.cut import Reading
from nnode.data.readers.juelich import JuelichOptions, Velocity, juelich_files, read_juelich
from nnode.errors import ConfigError, DataError

HEADER = "# framerate: 25 fps\n# id frame x/cm y/cm z/cm\n"


def lines(first: int, last: int, person: int, speed: float = 4.0, y: float = 100.0) -> str:
    """A person who walks ``speed`` cm per frame along x, from -200 cm in frame 0."""
    return "".join(
        f"{person} {f} {-200 + speed * f:.4f} {y:.4f} 176\n" for f in range(first, last + 1)
    )


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def read(path: Path, **options: object) -> Reading:
    return read_juelich(path, JuelichOptions(**options))


@pytest.fixture
def corridor(tmp_path: Path) -> Path:
    text = HEADER + lines(10, 70, 3) + lines(10, 50, 7, y=200) + lines(20, 70, 8, y=300)
    return write(tmp_path / "corridor.txt", text)


def test_consecutive_sequences_share_a_sample(corridor: Path) -> None:
    first, second = read(corridor)
    assert (first.n_samples, second.n_samples) == (26, 26)
    assert first.time[-1] == second.time[0] == pytest.approx(35 / 25)
    assert first.agents == ("3", "7")  # 8 enters later
    assert second.agents == ("3", "8")  # 7 leaves before
    assert (first.name, second.name) == ("corridor/000", "corridor/001")
    np.testing.assert_allclose(first.x[:, 0, 0], -2 + 0.04 * np.arange(10, 36))
    np.testing.assert_allclose(first.x[:, :, 1], np.tile([1.0, 2.0], (26, 1)))
    np.testing.assert_allclose(first.destination, first.x[-1])
    np.testing.assert_allclose(first.velocity()[:, :, 0], 1.0)


def test_metres_without_header(tmp_path: Path) -> None:
    text = "".join(f"1 {f} 0.5 {0.1 * f:.3f} 1.7\r\n" for f in range(17))
    (s,) = read(write(tmp_path / "run.txt", text), frame_rate=16, unit="m", walking_axis="y")
    assert s.dt == pytest.approx(1 / 16)
    np.testing.assert_allclose(s.x[:, 0, 1], 0.1 * np.arange(17))


def test_view_keeps_people_who_stay_inside(corridor: Path) -> None:
    # Person 3 walks from -1.6 m at frame 10 to -0.6 m at frame 35 and +0.4 m at frame 60.
    (s,) = read(corridor, view=[-1.0, 3.0])
    assert s.agents == ("3", "8")
    assert s.time[0] == pytest.approx(35 / 25)


def test_person_with_missing_frames_is_left_out(tmp_path: Path) -> None:
    text = HEADER + lines(0, 10, 1) + lines(12, 25, 1) + lines(0, 25, 2, y=300)
    (s,) = read(write(tmp_path / "gap.txt", text))
    assert s.agents == ("2",)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_corridor_is_left_of_both_walls(tmp_path: Path, axis: str) -> None:
    along, across = (0, 1) if axis == "x" else (1, 0)
    rows = []
    for f in range(26):
        place = [4.0 * f - 50, 150.0]
        rows.append(f"1 {f} {place[along]} {place[across]} 0\n")
    (s,) = read(
        write(tmp_path / "a-300-b.txt", HEADER + "".join(rows)),
        walking_axis=axis,
        walls={"*-300-*": [0.0, 3.0], "other": [1.0, 2.0]},
        view=[-4.0, 4.0],
    )
    begin, end = s.walls[:, :2], s.walls[:, 2:]
    np.testing.assert_allclose(begin[:, across], [0, 3])
    np.testing.assert_allclose(end[:, across], [0, 3])
    assert np.sort([begin[0, along], end[0, along]]).tolist() == [-4, 4]
    for person in s.x[:, 0]:
        d, r = end - begin, person - begin
        assert (d[:, 0] * r[:, 1] - d[:, 1] * r[:, 0] > 0).all()


def test_no_walls_without_a_matching_pattern(corridor: Path) -> None:
    assert read(corridor, walls={"other": [0, 1]})[0].walls is None


@pytest.mark.parametrize("scheme", list(Velocity))
def test_velocities_use_neighbouring_frames(tmp_path: Path, scheme: Velocity) -> None:
    rows = "".join(f"1 {f} {0.01 * f**2:.6f} 0 0\n" for f in range(76))  # cm
    _, middle, last = read(write(tmp_path / "a.txt", HEADER + rows), velocity=scheme)
    k = np.arange(25, 51)
    difference = {
        # x(k+1) - x(k), (x(k+1) - x(k-1)) / 2, x(k) - x(k-1) of 0.01 k²
        Velocity.forward: 2 * k + 1.0,
        Velocity.central: 2.0 * k,
        Velocity.backward: 2 * k - 1.0,
    }[scheme]
    if scheme is Velocity.forward:  # uses no sample after the sequence
        difference[-1] = difference[-2]
    np.testing.assert_allclose(middle.velocity()[:, 0, 0], 0.01 * difference * 25 / 100, atol=1e-6)
    end = 2 * 75 - 1.0  # one-sided, as no frame follows
    assert last.velocity()[-1, 0, 0] == pytest.approx(0.01 * end * 25 / 100, abs=1e-6)


@pytest.mark.real
def test_published_corridor(real_data: Path) -> None:
    options = JuelichOptions(source=str(real_data), walls={"*": [0.0, 4.0]})
    files = juelich_files(options)
    assert list(files) == ["bi_corr_400_b_03"]
    sequences = read_juelich(files["bi_corr_400_b_03"], options)
    assert abs(len(sequences) - 128) <= 1
    assert np.mean([s.n_agents for s in sequences]) == pytest.approx(34, abs=1)
    raw = np.loadtxt(files["bi_corr_400_b_03"])
    s = sequences[40]
    frames = np.round(s.time * 25).astype(int)
    for i, agent in enumerate(s.agents):
        person = raw[(raw[:, 0] == int(agent)) & np.isin(raw[:, 1], frames)]
        np.testing.assert_allclose(s.x[:, i], person[:, 2:4] / 100)


@pytest.mark.real
def test_published_runs_without_header(real_data: Path) -> None:
    options = JuelichOptions(
        name="hermes", source=str(real_data), frame_rate=16, unit="cm", walking_axis="y"
    )
    files = juelich_files(options)
    assert len(files) == 7
    s = read_juelich(files["boa-300-065-105"], options)[10]
    assert s.dt == pytest.approx(1 / 16)
    assert s.n_samples == 17


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"t_seq": 0.5}, r"t_seq=0.5 s is 12.5 frames .* such as t_seq=0.48"),
        ({"t_seq": 0.001}, r"t_seq=0.001 s is 0.025 frames"),
        ({"t_seq": -1.0}, r"t_seq=-1.0: expected a positive number"),
        ({"frame_rate": -25.0}, r"frame_rate=-25.0: expected a positive number"),
        ({"frame_rate": 16.0}, r"frame_rate=16.0, but the header of .*corridor.txt states 25.0"),
        ({"unit": "m"}, r"unit=m, but the header of .*corridor.txt states cm"),
        ({"unit": "ft"}, r"unit=ft: expected one of cm, m"),
        ({"walking_axis": "z"}, r"walking_axis=z: expected one of x, y"),
        ({"view": [3.0, -3.0]}, r"view=\[3.0, -3.0\]: expected \[low, high\]"),
        ({"walls": {"*": [4.0]}}, r"walls.\*=\[4.0\]: expected \[low, high\]"),
        ({"history": -1.0}, "history"),
    ],
)
def test_invalid_options(corridor: Path, options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read(corridor, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"unit": "cm"}, r"no frame rate: set data.frame_rate \(1/s\)"),
        ({"frame_rate": 25}, r"no unit: set data.unit \(cm, m\)"),
    ],
)
def test_files_without_header_need_rate_and_unit(
    tmp_path: Path, options: dict, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        read(write(tmp_path / "run.txt", lines(0, 30, 1)), **options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        (HEADER, "is empty"),
        (HEADER + lines(0, 30, 1) + "1 31 abc 5 0\n", r"line 34: expected 'id frame x y'"),
        (HEADER + "1 0 5\n" * 30, r"line 3: expected"),
        (HEADER + lines(0, 30, 1) + "1 31 nan 5 0\n", r"line 34: expected"),
        (HEADER + lines(0, 30, 1) + "1.5 31 5 5 0\n", r"line 34: expected"),
        (
            HEADER + lines(0, 30, 1) + lines(30, 30, 1),
            "frame 30: agent 1 occurs a second time",
        ),
        (HEADER + lines(0, 10, 1), "no sequence"),
    ],
)
def test_invalid_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(write(tmp_path / "bad.txt", text))


def test_too_few_people(corridor: Path) -> None:
    with pytest.raises(DataError, match="nowhere are 3 people present for 1 s"):
        read(corridor, min_agents=3)


def test_preferred_velocities_precede_a_sequence(tmp_path: Path) -> None:
    # 1 turns round at frame 25; 2 enters at frame 15, 0.4 s before the second sequence
    back = [f"1 {f} {-200 + 4 * (50 - f):.1f} 100 176\n" for f in range(25, 51)]
    text = HEADER + lines(0, 24, 1) + "".join(back) + lines(15, 50, 2, y=200)
    path = write(tmp_path / "turn.txt", text)
    first, second = read(path)
    assert first.preferred is None
    np.testing.assert_allclose(second.preferred, [[1.0, 0.0], [np.nan, np.nan]], atol=1e-9)
    np.testing.assert_allclose(second.velocity()[:, 0], [[-1.0, 0.0]] * 26, atol=1e-9)
    preferred = read(path, history=0.4)[1].preferred
    np.testing.assert_allclose(preferred, [[1.0, 0.0], [1.0, 0.0]], atol=1e-9)
    assert read(path, history=0.0)[1].preferred is None
