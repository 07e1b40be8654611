"""Files with planted faults, and files that are right: what is said of them, what reads them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.data.check.examine import Examination, examine
from nnode.data.check.recognise import recognised
from nnode.data.readers.jupedsim import WalkwayOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.data.sequence import LENGTH_UNITS, SPEED_UNITS
from nnode.data.units import certainty
from nnode.errors import ConfigError, DataError
from tests.data.check.planted import cars, people, saved, text


def said(file: Examination, level: str = "error") -> dict[str, str]:
    """Findings of a level by kind."""
    return {item.kind: item.text for item in file.findings if item.level == level}


def vehicles(file: Examination) -> VehicleTableOptions:
    assert file.source.group == "vehicles"
    return cast(VehicleTableOptions, file.source.options)


def test_a_sound_table_is_read_with_the_options_that_are_told(tmp_path: Path) -> None:
    file = examine(saved(cars(), tmp_path))
    assert said(file) == {}
    assert said(file, "warning") == {}
    options = vehicles(file)
    assert options.columns == {"vehicle": "veh", "time": "t", "speed": "v"}
    assert (options.position_unit, options.time_unit, options.speed_unit) == ("m", "s", "m/s")
    assert (options.direction, options.dt) == (1, 0.2)
    assert certainty(file.scale.probability) == "sure"
    (platoon,) = file.sequences
    assert platoon.n_agents == 12
    assert platoon.agents[-1] == "0"  # the leader
    assert file.rows.dt == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("scale", "units", "lacking"),
    [
        ({"x": 1 / 0.3048, "length": 1 / 0.3048}, ("ft", "s", "m/s"), []),
        ({"x": 1 / 0.3048, "length": 1 / 0.3048}, ("ft", "s", "m/s"), ["v"]),
        ({"v": 3.6}, ("m", "s", "km/h"), []),
        ({"t": 1000}, ("m", "ms", "m/s"), []),
    ],
)
def test_other_units(
    tmp_path: Path, scale: dict[str, float], units: tuple[str, ...], lacking: list[str]
) -> None:
    table = cars().drop(columns=lacking)
    for column, factor in scale.items():
        table[column] = (factor * table[column]).round(9)
    file = examine(saved(table, tmp_path))
    options = vehicles(file)
    assert (options.position_unit, options.time_unit, options.speed_unit) == units
    assert said(file) == {}
    assert np.ptp(file.rows.x) == pytest.approx(np.ptp(cars()["x"]), rel=1e-9)


def test_the_rate_of_frames_follows_from_speeds_in_the_file(tmp_path: Path) -> None:
    table = cars(dt=0.04)
    table["frame"] = (table.pop("t") / 0.04).round().astype(int)
    file = examine(saved(table, tmp_path))
    options = vehicles(file)
    assert (options.time_unit, options.frame_rate) == ("frame", 25.0)
    assert options.columns["time"] == "frame"
    assert said(file) == {}
    assert file.rows.dt == pytest.approx(0.04)


@pytest.mark.parametrize("factor", [0.6, 1.5, 0.25])
def test_a_clock_that_is_wrong_is_told_by_speeds_in_the_file(tmp_path: Path, factor: float) -> None:
    table = cars()
    table["t"] *= factor
    file = examine(saved(table, tmp_path))
    text = said(file)["time_scale"]
    (speed,) = re.findall(r"by their positions vehicles drive ([\d.]+) m/s", text)
    assert float(speed) == pytest.approx(12 / factor, rel=0.01)
    assert f"times multiplied by {1 / factor:.3g} would agree" in text


def test_a_mirrored_direction_is_turned(tmp_path: Path) -> None:
    file = examine(saved(cars().assign(x=lambda t: -t["x"]), tmp_path))
    assert vehicles(file).direction == -1
    assert "data.direction=-1" in said(file, "warning")["direction"]
    assert said(file) == {}


@pytest.mark.parametrize(
    ("rows", "column", "change", "level", "kind", "words"),
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
def test_a_planted_fault_is_a_finding(
    tmp_path: Path,
    rows: str,
    column: str,
    change: Callable[[pd.Series], pd.Series],
    level: str,
    kind: str,
    words: str,
) -> None:
    table = cars()
    planted = table.eval(rows)
    table.loc[planted, column] = change(table.loc[planted, column])
    file = examine(saved(table, tmp_path))
    assert re.search(words, said(file, level)[kind])
    # a swap is not reported as jumps or overlaps as well
    assert kind != "identity_swap" or set(said(file)) == {kind}


@pytest.mark.parametrize("told", [True, False])
def test_nobody_comes_or_goes_where_a_sequence_begins_and_ends(told: bool, tmp_path: Path) -> None:
    """Of three stays one after the other the second begins and ends amid the others."""
    table = cars()
    stays = [
        table.assign(t=table["t"] + 100 * k, x=table["x"] + 300 * (k == 1), veh=100 * k + table.veh)
        for k in range(3)
    ]
    table = pd.concat([stay.assign(sequence=k) for k, stay in enumerate(stays)])
    file = examine(saved(table if told else table.drop(columns="sequence"), tmp_path))
    kinds = {item.kind for item in file.findings}
    assert ("broken" in kinds) is not told


def test_cells_rows_and_holes(tmp_path: Path) -> None:
    table = cars().astype({"x": object})
    table.loc[100, "x"] = "oops"
    table.loc[101, "x"] = None
    table = pd.concat([table, table.iloc[[7, 7]]])
    table = table.drop(index=range(600, 640))
    file = examine(saved(table, tmp_path))
    wrong = said(file)
    # the empty one is a missing sample
    assert "column 'x' (x) holds no number in 1 of" in wrong["cells"]
    assert "first 'oops' in line 102" in wrong["cells"]
    assert (
        "2 rows repeat the agent and the time of an earlier row (2 of them" in wrong["duplicates"]
    )
    assert "refuses it" in wrong["reader"]
    assert "the longest of 4.1 s" in said(file, "note")["holes"]
    assert "readers sort them" in said(file, "note")["unsorted"]


def test_people_in_text_whose_header_tells_all(tmp_path: Path) -> None:
    head = "# framerate: 16 fps\n# id frame x/cm y/cm z/cm\n"
    file = examine(text(people(), tmp_path, head, 100.0))
    assert said(file) == said(file, "warning") == {}
    options = cast(WalkwayOptions, file.source.options)
    assert file.source.group == "pedpy"
    assert (options.frame_rate, options.unit) == (None, None)
    assert "right to about a tenth" in said(file, "note")["gait"]
    assert "50% of them towards larger values" in said(file, "note")["direction"]


def test_people_in_centimetres_whose_rate_nobody_tells(tmp_path: Path) -> None:
    file = examine(text(people(), tmp_path, "", 100.0))
    options = cast(WalkwayOptions, file.source.options)
    assert options.unit == "cm"
    assert options.frame_rate == pytest.approx(16, rel=0.15)  # by their gait
    assert "of a rate that the file does not tell" in said(file, "warning")["units"]
    assert " 16" in said(file, "warning")["units"]
    stated = examine(file.path, rate=16.0)
    assert said(stated, "warning") == {}
    assert cast(WalkwayOptions, stated.source.options).frame_rate == 16.0


def test_a_wrong_rate_is_told_by_peoples_gait_alone(tmp_path: Path) -> None:
    head = "# framerate: 30 fps\n# id frame x/m y/m z/m\n"
    text_ = said(examine(text(people(), tmp_path, head)))["time_scale"]
    (speed,) = re.findall(r"at the stated 30 frames/s, people walk ([\d.]+) m/s", text_)
    assert float(speed) == pytest.approx(1.3 * 30 / 16, rel=0.1)
    assert "16 frames/s fit" in text_ or "15 frames/s fit" in text_


def test_the_copied_eth_set_and_its_rate(tmp_path: Path) -> None:
    """Frames that count 15 in a second, velocities of their own, taken for 25 frames/s."""
    table = people(rate=2.5, length=16.0, number=60)
    table["frame"] *= 6  # every sixth frame of 15 in a second
    faster = 1.47 / table["vx"].abs().median()
    table["x"], table["vx"] = faster * table["x"], faster * table["vx"]
    rows = table.assign(a=0.0, b=0.0)[["frame", "id", "x", "a", "y", "vx", "b", "vy"]]
    path = tmp_path / "obsmat.txt"
    path.write_text(rows.sort_values("frame").to_csv(sep=" ", header=False, index=False))
    file = examine(path, rate=25.0)
    assert file.meanings["agent"].column == "column 2"
    assert file.meanings["y"].column == "column 5"
    text_ = said(file)["time_scale"]
    assert "at the stated 25 frames/s, people walk 2.4" in text_
    assert "its own velocities say 1.4" in text_
    assert "15 frames/s fit" in text_
    # and the file that would be read says so
    assert file.source.group == "pedpy"
    speed = np.concatenate(
        [np.linalg.norm(np.diff(s.x, axis=0), axis=-1).ravel() / s.dt for s in file.sequences]
    )
    assert np.median(speed) == pytest.approx(1.47, rel=0.05)


def test_pairs_and_tidy_tables(tmp_path: Path) -> None:
    lead, follow = pair()
    pairs = pd.DataFrame({"t": lead["t"], "xFollower": follow["x"], "x_leader": lead["x"]})
    pairs = pairs.assign(v_follower=follow["v"], v_leader=lead["v"])
    file = examine(saved(pairs, tmp_path, "pairs.csv"))
    assert file.source.group == "pairs"
    assert said(file) == {}
    assert len(file.sequences) == 1
    tidy = cars().rename(columns={"veh": "agent", "t": "time"}).assign(sequence=0)
    file = examine(saved(tidy[["sequence", "time", "agent", "x"]], tmp_path, "tidy.csv"))
    assert file.source.group == "table"
    assert len(file.sequences) == 1


def pair() -> tuple[pd.DataFrame, ...]:
    """A leader and its follower."""
    table = cars(2)
    return tuple(table[table["veh"] == i].reset_index() for i in (0, 1))


def spaced(units: dict[str, float]) -> pd.DataFrame:
    """Four pairs of spacings and speeds, numbered anew on either side of a division."""
    lead, follow = pair()
    single_pair = pd.DataFrame(
        {
            "t": lead["t"],
            "spacing": (lead["x"] - follow["x"] - 4.5) / units["position"],
            "speed": follow["v"] / units["speed"],
            "leader_speed": lead["v"] / units["speed"],
        }
    )
    parts = [
        single_pair.assign(event=i, split=side) for i in range(2) for side in ("train", "test")
    ]
    return pd.concat(parts)


@pytest.mark.parametrize("position", ["m", "ft"])
@pytest.mark.parametrize("speed", ["m/s", "km/h"])
def test_pairs_without_positions_and_their_units(tmp_path: Path, position: str, speed: str) -> None:
    """How spacings change with the speeds tells one unit by the other."""
    units = {"position": LENGTH_UNITS[position], "speed": SPEED_UNITS[speed]}
    file = examine(saved(spaced(units), tmp_path, "pairs.csv"))
    assert said(file) == said(file, "warning") == {}
    assert (file.scale.position, file.scale.speed) == (position, speed)
    options = file.source.options
    assert isinstance(options, PairOptions)
    assert options.columns == {
        "time": "t",
        "pair": "event",
        "run": "split",
        "v_follower": "speed",
        "v_leader": "leader_speed",
    }
    assert {s.name for s in file.sequences} == {"train/0", "train/1", "test/0", "test/1"}
    first = file.sequences[0]
    assert np.abs(np.gradient(first.x[:, 0, 0], 0.1) - first.velocity()[:, 0, 0]).max() < 0.5


def test_pairs_that_are_left_out_are_a_finding(tmp_path: Path) -> None:
    table = spaced({"position": 1.0, "speed": 1.0})
    short = table[(table["event"] == 0) & (table["split"] == "test")]
    table = pd.concat([table, short.iloc[:2].assign(event=7)])
    told = said(examine(saved(table, tmp_path, "pairs.csv")), "warning")
    assert told["left_out"] == (
        "records that are left out, as there is no sequence of them: 1 (fewer than "
        "data.min_samples=3 times in 1; first test/7)"
    )


DATES = {
    "dates": lambda t: (pd.Timestamp("2020-01-01 23:00") + pd.to_timedelta(t, unit="s")).astype(
        str
    ),
    "durations": lambda t: pd.to_timedelta(t, unit="s").astype(str),
    "ms": lambda t: 1_577_865_600_000 + (1e3 * t).round().astype("int64"),
    "us": lambda t: 1_577_865_600_000_000 + (1e6 * t).round().astype("int64"),
    "ns": lambda t: 1_577_865_600_000_000_000 + (1e9 * t).round().astype("int64"),
}


@pytest.mark.parametrize(
    ("group", "kind"),
    [*(("vehicles", kind) for kind in DATES), ("table", "dates"), ("table", "us"), ("pairs", "ns")],
)
def test_dates_and_epochs_are_recognised(tmp_path: Path, group: str, kind: str) -> None:
    table = cars()
    if group == "table":
        table = table.rename(columns={"veh": "agent", "t": "time"}).assign(sequence=0)
        table = table[["sequence", "time", "agent", "x"]]
    elif group == "pairs":
        table = spaced({"position": 1.0, "speed": 1.0})
    clock = "time" if group == "table" else "t"
    table[clock] = DATES[kind](table[clock])
    file = examine(saved(table, tmp_path, "t.csv"))
    assert said(file) == {}
    assert file.source.group == group
    assert file.scale.time == (kind if kind in ("ms", "us", "ns") else "s")
    assert file.source.options.time_unit == file.scale.time
    assert file.rows.dt == pytest.approx(0.1, abs=1e-6)
    assert file.sequences


@pytest.mark.parametrize("dates", [True, False])
def test_semicolons_and_commas(tmp_path: Path, dates: bool) -> None:
    path = tmp_path / "german.csv"
    table = cars()
    table["t"] = DATES["dates"](table["t"]) if dates else table["t"]
    table.to_csv(path, index=False, sep=";", decimal=",")
    file = examine(path)
    assert file.source.group == "vehicles"
    (platoon,) = file.sequences
    assert platoon.n_agents == 12
    assert platoon.time[0] == 0.0


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b" \n\n", "is empty"),
        (bytes(range(256)) * 20, "is no text"),
        (b"veh,t,x,lane\n", "has no rows below"),
        (b"veh,t,x,lane\n1,0,5,1\n", "1 row, in which no agent"),
        (b"just some words in a letter\nand more of them\n", "no column was recognised"),
        (b"# only\n# comments\n", "no rows below its comments"),
        (b"a,b\n1,2\n", "is no table of trajectories"),
        (b"<html><body></body></html>", "expected the root element <fcd-export>"),
        (b"PAR1 and then nothing", "give it a name that ends in .parquet"),
        (b"SQLite format 3\0 nothing", "cannot be read as a JuPedSim database"),
        (b"1 2 nan nan 0\n1 3 nan nan 0\n", "no column was|in which no agent"),
        ("veh,t,x\n".encode("utf-16"), "UTF-16"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "file.csv"
    path.write_bytes(content)
    with pytest.raises(DataError, match=words):
        examine(path)


def test_no_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no file"):
        examine(tmp_path / "absent.csv")
    with pytest.raises(ConfigError, match="is a folder"):
        examine(tmp_path)


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
    assert "time_scale" not in said(file)
    assert "reader" not in said(file)


@pytest.mark.real
@pytest.mark.parametrize(("told", "wrong"), [(16.0, False), (25.0, True), (10.0, True)])
def test_real_people_tell_their_rate(real_data: Path, told: float, wrong: bool) -> None:
    """HERMES took 16 frames in a second, as its archive says; nothing in the file does."""
    file = examine(real_data / "juelich" / "bo-360-050-050.txt", rate=told)
    assert ("time_scale" in said(file)) == wrong


def test_random_damage_ends_in_words_or_in_findings(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    good = [saved(cars(3, 3.0), tmp_path), text(people(4), tmp_path, "# framerate: 16 fps\n")]
    contents = [path.read_bytes() for path in good]
    examined, refused = 0, list[str]()
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
        path = tmp_path / "damaged.csv"
        path.write_bytes(bytes(content))
        try:
            examined += bool(examine(path).findings)
        except DataError as error:
            refused.append(str(error))
    assert examined > 10
    assert all(str(path) in words for words in refused)


def test_people_on_an_oval_keep_the_rate_that_is_told(tmp_path: Path) -> None:
    """In curves the sway across the way from start to end is none."""
    k = np.arange(1200)
    parts = []
    for i in range(4):
        angle = 2 * np.pi * (1.0 * k / 25 / 15 + i / 4)
        x, y = 2.4 * np.cos(angle), 2.4 * np.sin(angle) + 0.02 * np.sin(2 * np.pi * 1.7 * k / 25)
        parts.append(pd.DataFrame({"id": i, "frame": k, "x": x, "y": y}))
    head = "# framerate: 25 fps\n# id frame x/m y/m z/m\n"
    file = examine(text(pd.concat(parts), tmp_path, head))
    assert "time_scale" not in said(file)
    assert file.scale.rate == 25.0


def test_times_that_are_numbers_of_frames(tmp_path: Path) -> None:
    table = people(rate=2.5).rename(columns={"id": "ped"}).drop(columns=["vx", "vy"])
    file = examine(saved(table.assign(timestamp=table.frame), tmp_path))
    options = cast(WalkwayOptions, file.source.options)
    assert (options.time_unit, options.frame_rate) == ("frame", 2.5)
    assert options.columns == {"agent": "ped", "time": "frame"}
    assert file.sequences[0].dt == pytest.approx(0.4)


def test_people_sampled_coarsely_have_no_clock(tmp_path: Path) -> None:
    """At 2.5 positions a second what is left of the sway is the slow turns of the way."""
    k = np.arange(60)
    y = 0.5 * np.sin(2 * np.pi * 0.06 * 0.4 * k)
    parts = [
        pd.DataFrame({"id": i, "frame": k + 10 * i, "x": 0.4 * 1.3 * k, "y": i + y})
        for i in range(12)
    ]
    file = examine(saved(pd.concat(parts), tmp_path), domain="crowd", rate=2.5)
    assert "time_scale" not in said(file)
    assert file.scale.rate == 2.5


def test_names_in_the_last_comment_above_columns_parted_by_tabs(tmp_path: Path) -> None:
    path = tmp_path / "people.txt"
    table = people(12)[["id", "frame", "x", "y"]]
    path.write_text(
        "#framerate: 16\n#ID\tFR\tX\tY\n" + table.to_csv(sep="\t", header=False, index=False)
    )
    file = examine(path)
    assert {m: item.column for m, item in file.meanings.items()} == {
        "agent": "ID",
        "frame": "FR",
        "x": "X",
        "y": "Y",
    }
    options = cast(WalkwayOptions, file.source.options)
    assert (options.time_unit, options.frame_rate) == ("frame", 16.0)
    assert {name for s in file.sequences for name in s.agents} <= set(map(str, range(1, 13)))


def test_a_rate_that_the_file_tells_is_read_and_doubted(tmp_path: Path) -> None:
    """Filmed at 16 frames/s, said to be 30: the check says so, the reader takes what is said."""
    path = tmp_path / "people.txt"
    table = people()[["id", "frame", "x", "y"]]
    rows = table.to_csv(sep="\t", header=False, index=False)
    path.write_text(f"#framerate: 30\n#id\tframe\tx\ty\n{rows}")
    file = examine(path)
    assert "time_scale" in said(file)
    assert cast(WalkwayOptions, file.source.options).frame_rate == 30.0
    assert file.sequences[0].dt == pytest.approx(1 / 30)
    line = recognised(path).line
    assert "times in frames of 1/30 s" in line
    assert re.search(r"as it tells; 1[56] frames/s fit", line)


@pytest.mark.real
@pytest.mark.parametrize(
    ("file", "agent"), [("single_file/oval/UX_24_1.txt", "ID"), ("eth_ucy/eth_hotel.parquet", "id")]
)
def test_public_tables_of_people_are_read_as_they_are(
    real_data: Path, file: str, agent: str
) -> None:
    if not (real_data / file).is_file():
        pytest.skip(f"{file} is not there")
    examination = examine(real_data / file)
    options = cast(WalkwayOptions, examination.source.options)
    assert options.columns["agent"] == agent
    assert options.time_unit == "frame"
    assert examination.sequences


def test_the_window_that_noise_asks_for_reads_and_smooths(tmp_path: Path) -> None:
    table = cars(4)
    noisy = table.assign(x=table.x + 0.3 * np.random.default_rng(2).standard_normal(len(table)))
    path = saved(noisy.drop(columns="v"), tmp_path)
    text_ = said(examine(path), "warning")["noise"]
    (window,) = re.findall(r"data\.smooth=([\d.]+) \(s\)", text_)
    raw, smooth = (
        nnode.sequences(
            path, data="vehicles", columns={"vehicle": "veh", "time": "t"}, **smoothing
        )[0]
        for smoothing in ({}, {"smooth": float(window)})
    )
    true = table[table.veh == 0].set_index("t").v  # the leader, last in its platoon
    for s, low, high in ((raw, 1.0, np.inf), (smooth, 0.0, 0.25)):
        error = s.velocity()[5:-5, -1, 0] - true.loc[s.time[5:-5].round(6)].to_numpy()
        assert low < np.std(error) < high
