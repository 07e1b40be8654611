"""The check of a file: recognised formats, units and rates, and planted faults."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.data.check.examine import Examination, examine
from nnode.data.check.recognise import recognised
from nnode.data.sequence import LENGTH_UNITS, SPEED_UNITS
from nnode.data.units import certainty
from nnode.errors import ConfigError, DataError
from tests.data.check.planted import cars, people, saved, text


def findings(file: Examination, level: str = "error") -> dict[str, str]:
    """The texts of the findings of a level by kind."""
    return {item.kind: item.text for item in file.findings if item.level == level}


def test_correct_table_has_no_findings(tmp_path: Path) -> None:
    file = examine(saved(cars(), tmp_path))
    assert findings(file) == findings(file, "warning") == {}
    assert file.source.group == "vehicles"
    options = file.source.options
    assert options.columns == {"vehicle": "veh", "time": "t", "speed": "v"}
    assert (options.position_unit, options.time_unit, options.speed_unit) == ("m", "s", "m/s")
    assert (options.direction, options.dt) == (1, 0.2)
    assert certainty(file.scale.probability) == "sure"
    (platoon,) = file.sequences
    assert platoon.n_agents == 12
    assert platoon.agents[-1] == "0"  # the leader
    assert file.rows.dt == pytest.approx(0.1)


FEET = {"x": 1 / 0.3048, "length": 1 / 0.3048}


@pytest.mark.parametrize(
    ("scale", "units", "dropped"),
    [
        (FEET, ("ft", "s", "m/s"), []),
        (FEET, ("ft", "s", "m/s"), ["v"]),
        ({"v": 3.6}, ("m", "s", "km/h"), []),
        ({"t": 1000}, ("m", "ms", "m/s"), []),
    ],
)
def test_units_are_recognised(
    tmp_path: Path, scale: dict[str, float], units: tuple[str, ...], dropped: list[str]
) -> None:
    table = cars().drop(columns=dropped)
    for column, factor in scale.items():
        table[column] = (factor * table[column]).round(9)
    file = examine(saved(table, tmp_path))
    assert file.source.group == "vehicles"
    options = file.source.options
    assert (options.position_unit, options.time_unit, options.speed_unit) == units
    assert findings(file) == {}
    assert np.ptp(file.rows.x) == pytest.approx(np.ptp(cars()["x"]), rel=1e-9)


def test_frame_rate_follows_from_speeds(tmp_path: Path) -> None:
    table = cars(dt=0.04)
    table["frame"] = (table.pop("t") / 0.04).round().astype(int)
    file = examine(saved(table, tmp_path))
    assert file.source.group == "vehicles"
    options = file.source.options
    assert (options.time_unit, options.frame_rate) == ("frame", 25.0)
    assert options.columns["time"] == "frame"
    assert findings(file) == {}
    assert file.rows.dt == pytest.approx(0.04)


@pytest.mark.parametrize("factor", [0.6, 1.5, 0.25])
def test_wrong_clock_is_detected_by_speeds(tmp_path: Path, factor: float) -> None:
    file = examine(saved(cars().assign(t=lambda table: factor * table.t), tmp_path))
    message = findings(file)["time_scale"]
    (speed,) = re.findall(r"by their positions vehicles drive ([\d.]+) m/s", message)
    assert float(speed) == pytest.approx(12 / factor, rel=0.01)
    assert f"times multiplied by {1 / factor:.3g} would agree" in message


def test_reversed_direction_is_recognised(tmp_path: Path) -> None:
    file = examine(saved(cars().assign(x=lambda t: -t["x"]), tmp_path))
    assert file.source.options.direction == -1
    assert "data.direction=-1" in findings(file, "warning")["direction"]
    assert findings(file) == {}


def test_circular_road_is_recognised(tmp_path: Path) -> None:
    table = cars()
    table["x"] %= 200.0
    message = findings(examine(saved(table, tmp_path)))["circular_road"]
    assert "numpy.unwrap" in message
    found = re.search(r"after about ([\d.]+) m", message)
    assert found is not None
    assert float(found[1]) == pytest.approx(200, rel=0.02)
    unwrapped = table.assign(x=table.groupby("veh")["x"].transform(np.unwrap, period=200.0))
    assert "circular_road" not in findings(examine(saved(unwrapped, tmp_path)))
    # a faulty position is no new round
    table = cars()
    table.loc[table.index[[50, 500, 900]], "x"] = -5000.0
    assert "circular_road" not in findings(examine(saved(table, tmp_path)))


@pytest.mark.parametrize(
    ("rows", "column", "change", "level", "kind", "message"),
    [
        (
            "veh < 3",
            "x",
            lambda x: -x,
            "error",
            "direction",
            "both ways in lane 1: 25% of 12 towards smaller positions",
        ),
        (
            "t > 20 and 3 <= veh <= 4",
            "veh",
            lambda veh: 7 - veh,
            "error",
            "identity_swap",
            r"at 20.*the path of car .*\(id 4\) carries on as car 8 \(id 3\)",
        ),
        (
            "t > 20 and veh == 5",
            "veh",
            lambda veh: 94 + veh,
            "warning",
            "broken",
            r"1 agents appear and 1 vanish.*1 of those who appear carry on .* \(such as 5 as 99\)",
        ),
        ("veh == 3", "x", lambda x: x - 27.0, "error", "overlap", "m apart at"),
        ("veh == 3", "length", lambda length: length + 195, "error", "overlap", "long, at"),
    ],
)
def test_planted_fault_is_found(
    tmp_path: Path,
    rows: str,
    column: str,
    change: Callable[[pd.Series], pd.Series],
    level: str,
    kind: str,
    message: str,
) -> None:
    table = cars()
    selected = table.eval(rows)
    table.loc[selected, column] = change(table.loc[selected, column])
    file = examine(saved(table, tmp_path))
    assert re.search(message, findings(file, level)[kind])
    # a swap is not reported as a jump or an overlap in addition
    assert kind != "identity_swap" or set(findings(file)) == {kind}


@pytest.mark.parametrize("has_sequences", [True, False])
def test_sequence_boundaries_are_not_broken_tracks(has_sequences: bool, tmp_path: Path) -> None:
    """The second of three consecutive sequences begins and ends between the others."""
    table = cars()
    parts = [
        table.assign(
            sequence=k, t=table.t + 100 * k, x=table.x + 300 * (k == 1), veh=table.veh + k * 100
        )
        for k in range(3)
    ]
    table = pd.concat(parts)
    file = examine(saved(table if has_sequences else table.drop(columns="sequence"), tmp_path))
    assert ("broken" in {item.kind for item in file.findings}) is not has_sequences


def test_invalid_cells_duplicate_rows_and_holes(tmp_path: Path) -> None:
    table = cars().astype({"x": object})
    table.loc[100, "x"] = "oops"
    table.loc[101, "x"] = None
    table = pd.concat([table, table.iloc[[7, 7]]]).drop(index=range(600, 640))
    file = examine(saved(table, tmp_path))
    errors, notes = findings(file), findings(file, "note")
    # the empty cell is a missing sample
    assert "column 'x' (x) holds no number in 1 of" in errors["cells"]
    assert "first 'oops' in line 102" in errors["cells"]
    duplicates = "2 rows repeat the agent and the time of an earlier row (2 of them"
    assert duplicates in errors["duplicates"]
    assert "refuses it" in errors["reader"]
    assert "the longest of 4.1 s" in notes["holes"]
    assert "readers sort them" in notes["unsorted"]


def test_header_states_rate_and_unit(tmp_path: Path) -> None:
    header = "# framerate: 16 fps\n# id frame x/cm y/cm z/cm\n"
    file = examine(text(people(), tmp_path, header, 100.0))
    assert findings(file) == findings(file, "warning") == {}
    assert file.source.group == "pedpy"
    assert (file.source.options.frame_rate, file.source.options.unit) == (None, None)
    notes = findings(file, "note")
    assert "right to about a tenth" in notes["gait"]
    assert "50% of them towards larger values" in notes["direction"]


def test_missing_rate_is_estimated_from_gait(tmp_path: Path) -> None:
    file = examine(text(people(), tmp_path, "", 100.0))
    assert file.source.options.unit == "cm"
    assert file.source.options.frame_rate == pytest.approx(16, rel=0.15)
    warning = findings(file, "warning")["units"]
    assert "whose rate the file does not state" in warning
    assert " 16" in warning
    with_rate = examine(file.path, rate=16.0)
    assert findings(with_rate, "warning") == {}
    assert with_rate.source.options.frame_rate == 16.0


def test_wrong_rate_is_detected_by_gait(tmp_path: Path) -> None:
    header = "# framerate: 30 fps\n# id frame x/m y/m z/m\n"
    message = findings(examine(text(people(), tmp_path, header)))["time_scale"]
    (speed,) = re.findall(r"at the stated 30 frames/s, people walk ([\d.]+) m/s", message)
    assert float(speed) == pytest.approx(1.3 * 30 / 16, rel=0.1)
    assert re.search("1[56] frames/s fit", message)


def test_eth_data_with_a_wrong_rate(tmp_path: Path) -> None:
    """The file has velocities and counts 15 frames per second; the given rate is 25 frames/s."""
    table = people(rate=2.5, length=16.0, number=60)
    table["frame"] *= 6  # every sixth of 15 frames per second
    table[["x", "vx"]] *= 1.47 / table["vx"].abs().median()
    rows = table.assign(a=0.0, b=0.0)[["frame", "id", "x", "a", "y", "vx", "b", "vy"]]
    path = tmp_path / "obsmat.txt"
    path.write_text(rows.sort_values("frame").to_csv(sep=" ", header=False, index=False))
    file = examine(path, rate=25.0)
    assert file.meanings["agent"].column == "column 2"
    assert file.meanings["y"].column == "column 5"
    message = findings(file)["time_scale"]
    assert "at the stated 25 frames/s, people walk 2.4" in message
    assert "its own velocities say 1.4" in message
    assert "15 frames/s fit" in message
    assert file.source.group == "pedpy"
    speed = [np.linalg.norm(np.diff(s.x, axis=0), axis=-1).ravel() / s.dt for s in file.sequences]
    assert np.median(np.concatenate(speed)) == pytest.approx(1.47, rel=0.05)


def test_pairs_with_positions(tmp_path: Path) -> None:
    leader, follower = pair()
    table = pd.DataFrame({"t": leader["t"], "xFollower": follower["x"], "x_leader": leader["x"]})
    table = table.assign(v_follower=follower["v"], v_leader=leader["v"])
    file = examine(saved(table, tmp_path))
    assert file.source.group == "pairs"
    assert findings(file) == {}
    assert len(file.sequences) == 1


def tidy() -> pd.DataFrame:
    """The cars as a tidy table of positions."""
    table = cars().rename(columns={"veh": "agent", "t": "time"}).assign(sequence=0)
    return table[["sequence", "time", "agent", "x"]]


def test_tidy_table(tmp_path: Path) -> None:
    file = examine(saved(tidy(), tmp_path))
    assert file.source.group == "table"
    assert len(file.sequences) == 1


def pair() -> tuple[pd.DataFrame, ...]:
    """A leader and its follower."""
    table = cars(2)
    return tuple(table[table["veh"] == i].reset_index() for i in (0, 1))


def spaced(position: float = 1.0, speed: float = 1.0) -> pd.DataFrame:
    """Four pairs of spacings and speeds, numbered from 0 in both parts of a division.

    Args:
        position, speed: units, m and m/s.
    """
    leader, follower = pair()
    table = pd.DataFrame(
        {
            "t": leader["t"],
            "spacing": (leader["x"] - follower["x"] - 4.5) / position,
            "speed": follower["v"] / speed,
            "leader_speed": leader["v"] / speed,
        }
    )
    return pd.concat(
        table.assign(event=i, split=part) for i in range(2) for part in ("train", "test")
    )


@pytest.mark.parametrize("position", ["m", "ft"])
@pytest.mark.parametrize("speed", ["m/s", "km/h"])
def test_units_of_pairs_without_positions(tmp_path: Path, position: str, speed: str) -> None:
    """The changes of the spacings and the speeds determine each other's units."""
    file = examine(saved(spaced(LENGTH_UNITS[position], SPEED_UNITS[speed]), tmp_path))
    assert findings(file) == findings(file, "warning") == {}
    assert (file.scale.position, file.scale.speed) == (position, speed)
    assert file.source.group == "pairs"
    assert file.source.options.columns == {
        "time": "t",
        "pair": "event",
        "run": "split",
        "v_follower": "speed",
        "v_leader": "leader_speed",
    }
    assert {s.name for s in file.sequences} == {"train/0", "train/1", "test/0", "test/1"}
    first = file.sequences[0]
    assert np.abs(np.gradient(first.x[:, 0, 0], 0.1) - first.velocity()[:, 0, 0]).max() < 0.5


def test_omitted_pairs_are_found(tmp_path: Path) -> None:
    table = spaced()
    short = table[(table["event"] == 0) & (table["split"] == "test")].iloc[:2].assign(event=7)
    warnings = findings(examine(saved(pd.concat([table, short]), tmp_path)), "warning")
    assert warnings["left_out"] == (
        "records that are left out, as there is no sequence of them: 1 (fewer than "
        "data.min_samples=3 times in 1; first test/7)"
    )


EPOCH = 1_577_865_600
DATES = {
    "dates": lambda t: (pd.Timestamp("2020-01-01 23:00") + pd.to_timedelta(t, unit="s")).astype(
        str
    ),
    "durations": lambda t: pd.to_timedelta(t, unit="s").astype(str),
    "ms": lambda t: EPOCH * 10**3 + (1e3 * t).round().astype("int64"),
    "us": lambda t: EPOCH * 10**6 + (1e6 * t).round().astype("int64"),
    "ns": lambda t: EPOCH * 10**9 + (1e9 * t).round().astype("int64"),
}


@pytest.mark.parametrize(
    ("group", "kind"),
    [*(("vehicles", kind) for kind in DATES), ("table", "dates"), ("table", "us"), ("pairs", "ns")],
)
def test_dates_and_epochs_are_recognised(tmp_path: Path, group: str, kind: str) -> None:
    table = {"vehicles": cars, "table": tidy, "pairs": spaced}[group]()
    time = "time" if group == "table" else "t"
    table[time] = DATES[kind](table[time])
    file = examine(saved(table, tmp_path))
    assert findings(file) == {}
    assert file.source.group == group
    assert file.scale.time == (kind if kind in ("ms", "us", "ns") else "s")
    assert file.source.options.time_unit == file.scale.time
    assert file.rows.dt == pytest.approx(0.1, abs=1e-6)
    assert file.sequences


@pytest.mark.parametrize("dates", [True, False])
def test_semicolons_and_decimal_commas(tmp_path: Path, dates: bool) -> None:
    path = tmp_path / "t.csv"
    table = cars()
    table["t"] = DATES["dates"](table["t"]) if dates else table["t"]
    table.to_csv(path, index=False, sep=";", decimal=",")
    file = examine(path)
    assert file.source.group == "vehicles"
    (platoon,) = file.sequences
    assert platoon.n_agents == 12
    assert platoon.time[0] == 0.0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b" \n\n", "is empty"),
        (bytes(range(256)) * 20, "is no text"),
        (b"veh,t,x,lane\n", "has no rows below"),
        (b"veh,t,x,lane\n1,0,5,1\n", "1 row, in which no agent"),
        (b"just some message in a letter\nand more of them\n", "no column was recognised"),
        (b"# only\n# comments\n", "no rows below its comments"),
        (b"a,b\n1,2\n", "is no table of trajectories"),
        (b"<html><body></body></html>", "expected the root element <fcd-export>"),
        (b"PAR1 and then nothing", "give it a name that ends in .parquet"),
        (b"SQLite format 3\0 nothing", "cannot be read as a JuPedSim database"),
        (b"1 2 nan nan 0\n1 3 nan nan 0\n", "no column was|in which no agent"),
        ("veh,t,x\n".encode("utf-16"), "UTF-16"),
    ],
)
def test_invalid_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "file.csv"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        examine(path)


@pytest.mark.parametrize(
    ("name", "message"), [("absent.csv", "there is no file"), ("", "is a folder")]
)
def test_missing_file_and_folder_are_refused(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        examine(tmp_path / name)


REAL = {
    "esimas/sequence_data1-1_1.mat": ("esimas", "traffic"),
    "juelich/bi_corr_400_b_03.txt": ("pedpy", "crowd"),
    "juelich/bo-360-090-090.txt": ("pedpy", "crowd"),
    "ngsim/i80_lanes_1_2.csv": ("vehicles", "traffic"),
    "ngsim_pairs/i80_pairs.parquet": ("pairs", "traffic"),
    "ngsim_events/events.parquet": ("pairs", "traffic"),
    "tgsim/pairs.parquet": ("pairs", "traffic"),
    "waymo_pairs/hv_av_2.parquet": ("pairs", "traffic"),
    "openacc/astazero.parquet": ("astazero", "traffic"),
    "openacc/zalazone/mixed_dynamic_part7.csv": ("openacc", "traffic"),
}


@pytest.mark.thorough
@pytest.mark.real
@pytest.mark.parametrize("name", REAL)
def test_real_files_are_recognised(real_data: Path, name: str) -> None:
    file = examine(real_data / name)
    assert (file.source.group, file.scale.domain) == REAL[name]
    assert file.sequences
    assert "time_scale" not in findings(file)
    assert "reader" not in findings(file)


@pytest.mark.real
@pytest.mark.parametrize(("rate", "wrong"), [(16.0, False), (25.0, True), (10.0, True)])
def test_wrong_rate_of_real_people(real_data: Path, rate: float, wrong: bool) -> None:
    """The rate of HERMES is 16 frames/s; only its archive states it."""
    file = examine(real_data / "juelich" / "bo-360-050-050.txt", rate=rate)
    assert ("time_scale" in findings(file)) == wrong


def test_random_damage_gives_findings_or_an_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    files = [saved(cars(3, 3.0), tmp_path), text(people(4), tmp_path, "# framerate: 16 fps\n")]
    contents = [path.read_bytes() for path in files]
    path, n_examined = tmp_path / "damaged.csv", 0
    for trial in range(60):
        content = bytearray(contents[trial % 2])
        for _ in range(int(rng.integers(1, 8))):
            at = int(rng.integers(0, len(content)))
            match int(rng.integers(0, 5)):
                case 0:
                    content[at] = int(rng.integers(0, 256))
                case 1:
                    del content[at : at + int(rng.integers(1, 200))]
                case 2:
                    content[at:at] = rng.choice([b",", b"\n", b"nan", b"-", b"1e400", b"x"])
                case 3:
                    content[at:at] = content[: int(rng.integers(1, 400))]
                case _:
                    content = content[: max(at, 1)]
        path.write_bytes(content)
        try:
            n_examined += bool(examine(path).findings)
        except DataError as error:
            assert str(path) in str(error)  # noqa: PT017
    assert n_examined > 10


def test_stated_rate_is_kept_on_an_oval(tmp_path: Path) -> None:
    """On a closed course no sway is perpendicular to the line from start to end."""
    k = np.arange(1200)
    parts = []
    for i in range(4):
        angle = 2 * np.pi * (k / 25 / 15 + i / 4)
        x, y = 2.4 * np.cos(angle), 2.4 * np.sin(angle) + 0.02 * np.sin(2 * np.pi * 1.7 * k / 25)
        parts.append(pd.DataFrame({"id": i, "frame": k, "x": x, "y": y}))
    header = "# framerate: 25 fps\n# id frame x/m y/m z/m\n"
    file = examine(text(pd.concat(parts), tmp_path, header))
    assert "time_scale" not in findings(file)
    assert file.scale.rate == 25.0


def test_times_as_frame_numbers(tmp_path: Path) -> None:
    table = people(rate=2.5).rename(columns={"id": "ped"}).drop(columns=["vx", "vy"])
    file = examine(saved(table.assign(timestamp=table.frame), tmp_path))
    options = file.source.options
    assert (options.time_unit, options.frame_rate) == ("frame", 2.5)
    assert options.columns == {"agent": "ped", "time": "frame"}
    assert file.sequences[0].dt == pytest.approx(0.4)


def test_coarse_samples_do_not_determine_the_rate(tmp_path: Path) -> None:
    """At 2.5 samples per second the sway is not resolved; only slow turns of the path remain."""
    k = np.arange(60)
    y = 0.5 * np.sin(2 * np.pi * 0.06 * 0.4 * k)
    parts = [
        pd.DataFrame({"id": i, "frame": k + 10 * i, "x": 0.4 * 1.3 * k, "y": i + y})
        for i in range(12)
    ]
    file = examine(saved(pd.concat(parts), tmp_path), domain="crowd", rate=2.5)
    assert "time_scale" not in findings(file)
    assert file.scale.rate == 2.5


def tabbed(table: pd.DataFrame, folder: Path, header: str) -> Path:
    """Write people as text, separated by tabs, below comments."""
    rows = table[["id", "frame", "x", "y"]].to_csv(sep="\t", header=False, index=False)
    path = folder / "people.txt"
    path.write_text(header + rows)
    return path


def test_column_names_in_the_last_comment(tmp_path: Path) -> None:
    file = examine(tabbed(people(12), tmp_path, "#framerate: 16\n#ID\tFR\tX\tY\n"))
    columns = {meaning: item.column for meaning, item in file.meanings.items()}
    assert columns == {"agent": "ID", "frame": "FR", "x": "X", "y": "Y"}
    options = file.source.options
    assert (options.time_unit, options.frame_rate) == ("frame", 16.0)
    assert {name for s in file.sequences for name in s.agents} <= set(map(str, range(1, 13)))


def test_wrong_stated_rate_is_used_and_reported(tmp_path: Path) -> None:
    """People recorded at 16 frames/s in a file that states 30 frames/s."""
    path = tabbed(people(), tmp_path, "#framerate: 30\n#id\tframe\tx\ty\n")
    file = examine(path)
    assert "time_scale" in findings(file)
    assert file.source.options.frame_rate == 30.0
    assert file.sequences[0].dt == pytest.approx(1 / 30)
    line = recognised(path).line
    assert "times in frames of 1/30 s" in line
    assert re.search(r"as stated in the file; 1[56] frames/s fit", line)


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "agent"), [("single_file/oval/UX_24_1.txt", "ID"), ("eth_ucy/eth_hotel.parquet", "id")]
)
def test_public_tables_of_people(real_data: Path, name: str, agent: str) -> None:
    if not (real_data / name).is_file():
        pytest.skip(f"there is no {name}")
    file = examine(real_data / name)
    assert file.source.options.columns["agent"] == agent
    assert file.source.options.time_unit == "frame"
    assert file.sequences


def test_suggested_window_smooths_noise(tmp_path: Path) -> None:
    table = cars(4)
    noisy = table.assign(x=table.x + 0.3 * np.random.default_rng(2).standard_normal(len(table)))
    path = saved(noisy.drop(columns="v"), tmp_path)
    message = findings(examine(path), "warning")["noise"]
    (window,) = re.findall(r"data\.smooth=([\d.]+) \(s\)", message)
    speed = table[table.veh == 0].set_index("t").v  # the leader, the last in its platoon
    columns = {"vehicle": "veh", "time": "t"}
    for smooth, low, high in ((None, 1.0, np.inf), (float(window), 0.0, 0.25)):
        s = nnode.sequences(path, data="vehicles", columns=columns, smooth=smooth)[0]
        error = s.velocity()[5:-5, -1, 0] - speed.loc[s.time[5:-5].round(6)].to_numpy()
        assert low < np.std(error) < high
