"""Reading pairs of a follower and its leader: columns, units, gaps, and the published division."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from omegaconf import OmegaConf
from scipy.integrate import cumulative_trapezoid

from nnode.data.clusters import clusters, index_of
from nnode.data.cut import Reading
from nnode.data.options import SplitMode, SplitOptions
from nnode.data.prepare import prepare
from nnode.data.quality import find_faults
from nnode.data.readers.pairs import Gaps, PairOptions, pair_files, read_pairs
from nnode.data.sequence import Sequence
from nnode.data.split import split
from nnode.errors import ConfigError, DataError
from tests.data import tables
from tests.data.tables import saved

FOOT = 0.3048
CONF = Path(__file__).parents[3] / "conf" / "data"


def drive(first: int = 0, last: int = 50, unit: float = 1.0, **further: object) -> pd.DataFrame:
    """A follower at 10 m/s, 20 m of it behind a leader of 4 m at 11 m/s, in ``unit`` m."""
    k = np.arange(first, last + 1)
    t = k * 0.1
    x, lead = 10.0 * t, 24.0 + 11.0 * t
    return pd.DataFrame(
        {
            "time": t,
            "x_follower": x / unit,
            "v_follower": 10.0 / unit,
            "x_leader": lead / unit,
            "v_leader": 11.0 / unit,
            "spacing": (lead - x - 4.0) / unit,
            **further,
        }
    )


read = partial(tables.read, PairOptions)


def configured(name: str, path: Path | str, source: Path | None = None) -> PairOptions:
    """The options of a shipped configuration."""
    said = OmegaConf.load(CONF / f"{name}.yaml")
    said.pop("defaults")
    given = OmegaConf.merge(OmegaConf.structured(PairOptions), said, {"path": str(path)})
    given["source"] = None if source is None else str(source)
    options = OmegaConf.to_object(given)
    assert isinstance(options, PairOptions)
    return options


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_pair_is_a_platoon_of_two(tmp_path: Path, suffix: str) -> None:
    further = {"follower": 7, "leader": 5, "run": "a", "leader_kind": "CAV", "split": "Test"}
    (s,) = read(
        saved(tmp_path / f"one{suffix}", drive(unit=FOOT, **further)),
        position_unit="ft",
        speed_unit="ft/s",
        kinds={"CAV": "automated"},
    )
    assert (s.name, s.recording, s.agents, s.split) == ("a/one", "a", ("7", "5"), "test")
    assert s.kind == ("", "automated")
    np.testing.assert_allclose(s.time, 0.1 * np.arange(51), atol=1e-12)
    np.testing.assert_allclose(s.x[:, 0, 0], 10 * s.time, atol=1e-9)
    np.testing.assert_allclose(s.x[:, 1, 0], 24 + 11 * s.time, atol=1e-9)
    np.testing.assert_allclose(s.v[:, :, 0], np.tile([10.0, 11.0], (51, 1)))
    np.testing.assert_allclose(s.length, [np.nan, 4.0])


def test_pairs_of_one_table_in_any_order_with_a_given_length(tmp_path: Path) -> None:
    parts = [drive(pair=p, leader_length=4.5).drop(columns="spacing") for p in (3, 1)]
    table = pd.concat(parts).sample(frac=1.0, random_state=1)
    result = read(saved(tmp_path / "all.csv", table), window=1.0)
    assert len(result) == 10
    assert {s.name for s in result} == {f"pairs/{p}_{k:03d}" for p in (1, 3) for k in range(5)}
    assert {s.n_samples for s in result} == {11}
    assert all(s.length is not None and s.length[1] == 4.5 for s in result)
    # vehicles without a name are called after their pair, so that its windows are one cluster
    assert {s.agents for s in result} == {(f"{p} follower", f"{p} leader") for p in (1, 3)}


def test_gaps_split_a_pair_or_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "one.csv", drive(0, 20), drive(30, 50))
    first, second = read(path)
    assert (first.name, second.name) == ("pairs/one_000", "pairs/one_001")
    assert (first.time[-1], second.time[0]) == pytest.approx((2.0, 3.0))
    with pytest.raises(DataError, match=r"pair one steps from 2 s to 3 s \(line 23\)"):
        read(path, gaps=Gaps.error)


def test_uneven_times_of_pairs_are_interpolated_and_told(tmp_path: Path) -> None:
    table = drive(0, 50)
    table["time"] += np.random.default_rng(2).uniform(-0.02, 0.02, 51)
    table["x_follower"], table["x_leader"] = 10 * table.time, 24 + 11 * table.time
    path = saved(tmp_path / "one.csv", table.drop(columns="spacing"))
    result = read(path, dt=0.1)
    assert isinstance(result, Reading)
    (s,) = result
    assert "are interpolated to steps of 0.1 s" in result.notes[0]
    np.testing.assert_allclose(s.x[:, 0, 0], 10 * s.time, atol=1e-9)
    np.testing.assert_allclose(s.x[:, 1, 0], 24 + 11 * s.time, atol=1e-9)


def test_pairs_in_frames(tmp_path: Path) -> None:
    table = drive().assign(time=lambda t: (10 * t.time).round().astype(int))
    path = saved(tmp_path / "one.csv", table)
    (s,) = read(path, time_unit="frame", frame_rate=10.0)
    np.testing.assert_allclose(s.time, 0.1 * np.arange(51), atol=1e-12)
    with pytest.raises(ConfigError, match="frame_rate=None: expected a positive number"):
        read(path, time_unit="frame")


def test_a_coarser_grid(tmp_path: Path) -> None:
    path = saved(tmp_path / "one.csv", drive(3, 50))
    with pytest.raises(ConfigError, match=r"dt=0\.05 s is finer than the 0\.1 s"):
        read(path, dt=0.05)
    (s,) = read(path, dt=0.4)
    np.testing.assert_allclose(s.time, 0.4 * np.arange(1, 13))
    np.testing.assert_allclose(s.x[:, 0, 0], 10 * s.time)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"spacing": np.linspace(20, 30, 51)}, "one length of the leader"),
        ({"leader": np.arange(51)}, "line 3: column 'leader' holds 1, before it 0"),
        ({"time": 0.0}, "line 3: agent 1 of p stands there a second time at 0 s"),
        ({"x_leader": "?"}, "line 2: column 'x_leader' holds '\\?'"),
    ],
)
def test_rows_that_are_no_pair_are_refused(
    tmp_path: Path, change: dict[str, object], said: str
) -> None:
    table = drive(pair="p", follower=1).assign(**change)
    with pytest.raises(DataError, match=said):
        read(saved(tmp_path / "one.csv", table))


def test_options_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "one.csv", drive(lane=2))
    assert len(read(path, lane=2)) == 1
    for options, said in (
        ({"pattern": "(?P<colour>.*)"}, "group 'colour' is unknown"),
        ({"pattern": "("}, "data.pattern"),
        ({"constant": {"x": "1"}}, "data.constant.x"),
        ({"columns": {"y": "y"}}, "data.columns.y is unknown"),
        ({"lane": 3}, "lane=3: the pairs have the lanes 2"),
        ({"window": 0.15}, "no whole number of steps"),
        ({"position_unit": {"*.parquet": "m"}}, "no pattern fits one.csv"),
        ({"recording": "b"}, "recording=b: unknown recording"),
    ):
        with pytest.raises(ConfigError, match=said):
            read(path, **options)
    with pytest.raises(DataError, match=r"does not fit data\.pattern"):
        read(path, pattern="(?P<run>[0-9]+)_")


def test_files_as_they_are_published(tmp_path: Path) -> None:
    table = drive(unit=FOOT, leader_length=4.0 / FOOT).rename(columns={"time": "t"})
    start = "ngsim_final_I80_trajectories-0400pm-0415pm_runfinal_I80_trajectories-0400pm-0415pm"
    saved(tmp_path / "train" / f"{start}_f13_l15_00035.csv", table)
    saved(tmp_path / "test" / f"{start}_f254_l253_00014.csv", table)
    # of an earlier extraction, which the list does not name
    saved(tmp_path / "train" / f"{start}_f254_l253_00002.csv", table)
    listed = {
        "path": [f"train/{start}_f13_l15_00035.csv", f"test/{start}_f254_l253_00014.csv"],
        "split": ["train", "test"],
        "follower": [13, 254],
        "leader": [15, 253],
        "lane": [4.0, 2.0],
        "run": f"{start[6:]}",
    }
    saved(tmp_path / "manifest.csv", pd.DataFrame(listed))
    options = configured("ngsim_pairs", tmp_path)
    two, first_pair = read_pairs(pair_files(options), options)
    assert {s.recording for s in (first_pair, two)} == {"0400pm-0415pm"}
    options.lane = 2
    assert [s.agents for s in read_pairs(pair_files(options), options)] == [("254", "253")]
    assert (first_pair.name, first_pair.split) == ("0400pm-0415pm/f254_l253_00014", "test")
    assert (two.agents, two.split) == (("13", "15"), "train")
    np.testing.assert_allclose(two.x[-1, :, 0], [50.0, 79.0])
    np.testing.assert_allclose(two.length, [np.nan, 4.0])

    (tmp_path / listed["path"][0]).unlink()
    with pytest.raises(DataError, match=r"manifest\.csv, line 2: there is no file"):
        pair_files(options)

    names = {"time": "timestamp"} | {
        f"{q}_{who.lower()}": f"{q}{who}Real" for q in "xv" for who in ("Leader", "Follower")
    }
    given = drive(follower_id=16, leader_id=6, run_no=1).rename(columns=names)
    saved(tmp_path / "Data" / "CAV" / "run-1-veh-16-pair-7.csv", given)
    options = configured("tgsim", tmp_path / "Data")
    (s,) = read_pairs(pair_files(options), options)
    assert (s.name, s.agents, s.kind) == ("1/run-1-veh-16-pair-7", ("16", "6"), ("HV", "CAV"))


def spaced(pair: object, spacing: float = 20.0, k: int = 51, **further: object) -> pd.DataFrame:
    """A follower at 10 m/s behind a leader whose speed falls evenly from 12 to 9 m/s."""
    t = 0.1 * np.arange(k)
    v = 12.0 - 0.6 * t
    gap = spacing + (12.0 * t - 0.3 * t**2) - 10.0 * t
    given = {"pair": pair, "time": t, "spacing": gap, "v_follower": 10.0, "v_leader": v}
    return pd.DataFrame({**given, **further})


def test_positions_follow_from_spacing_and_speeds(tmp_path: Path) -> None:
    table = spaced(1)
    (s,) = read(saved(tmp_path / "p.csv", table))
    # the trapezium rule is exact for a speed that changes evenly
    np.testing.assert_allclose(s.x[:, 1, 0], 12.0 * s.time - 0.3 * s.time**2, atol=1e-9)
    np.testing.assert_array_equal(s.length, [np.nan, 5.0])
    np.testing.assert_allclose(s.x[:, 1, 0] - s.x[:, 0, 0] - 5.0, table.spacing, atol=1e-9)
    np.testing.assert_allclose(np.diff(s.x[:, 0, 0]), 1.0, atol=1e-9)
    np.testing.assert_array_equal(s.velocity()[:, :, 0], table[["v_follower", "v_leader"]])

    # the length of a leader changes where fronts are, and no gap
    (longer,) = read(saved(tmp_path / "q.csv", spaced(1, leader_length=12.0)))
    np.testing.assert_array_equal(longer.length, [np.nan, 12.0])
    np.testing.assert_allclose(longer.x[:, 0] - s.x[:, 0], -7.0)
    (unknown,) = read(saved(tmp_path / "p.csv", spaced(1)), length=None)
    assert unknown.length is None
    np.testing.assert_allclose(unknown.x[:, 1, 0] - unknown.x[:, 0, 0], table.spacing)


def test_speeds_and_spacings_have_their_units(tmp_path: Path) -> None:
    table = spaced(1)
    feet = table.assign(
        spacing=table.spacing / FOOT, v_leader=table.v_leader * 3.6, v_follower=36.0
    )
    (s,) = read(saved(tmp_path / "p.csv", feet), position_unit="ft", speed_unit="km/h")
    (si,) = read(saved(tmp_path / "q.csv", table))
    np.testing.assert_allclose(s.x, si.x, atol=1e-9)


def test_without_positions_the_spacing_needs_both_speeds(tmp_path: Path) -> None:
    for missing in ("spacing", "v_follower", "v_leader"):
        path = saved(tmp_path / "p.csv", spaced(1).drop(columns=missing))
        with pytest.raises(DataError, match="spacing, v_follower and v_leader are needed"):
            read(path)
    path = saved(tmp_path / "p.csv", spaced(1).assign(spacing=[np.nan] + [20.0] * 50))
    with pytest.raises(DataError, match="line 2: column 'spacing' holds nothing"):
        read(path)


def test_anonymous_pairs_are_a_cluster_each(tmp_path: Path) -> None:
    parts = [spaced(i, 20.0 + i) for i in range(12)]
    result = read(saved(tmp_path / "p.csv", *parts), window=1.0)
    assert len(result) == 60
    label = clusters(index_of(result))
    assert label.max() + 1 == 12
    # windows of one pair are one
    names = np.array([s.name.partition("_")[0] for s in result])
    assert all(len(set(label[names == name])) == 1 for name in names)


def test_pairs_that_name_one_vehicle_share_that_one(tmp_path: Path) -> None:
    parts = [spaced(i, follower=i // 2) for i in range(6)]
    result = read(saved(tmp_path / "p.csv", *parts))
    assert clusters(index_of(result)).tolist() == [0, 0, 1, 1, 2, 2]


def test_no_pair_is_lost_without_a_word(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    holed = spaced(3).drop(index=range(5, 51, 5))
    parts = [spaced(1), spaced(2, k=4), holed, spaced(4, spacing=0.2, leader_length=0.5)]
    path = saved(tmp_path / "p.csv", *parts)
    store = prepare(PairOptions(path=str(path), min_samples=10, fill=0.0), tmp_path / "store")
    left = {entry["name"]: entry["why"] for entry in store.manifest["left_out"]}
    assert left == {
        "pairs/2": "fewer than data.min_samples=10 times",
        "pairs/3": "no data.min_samples=10 times without a gap",
    }
    assert [entry["sequence"] for entry in store.manifest["dropped"]] == ["pairs/4"]
    assert store.manifest["counts"] == {"read": 2, "kept": 1, "dropped": 1}
    said = " ".join(record.getMessage() for record in caplog.records)
    assert "records that are left out, as there is no sequence of them: 2 (" in said
    assert "1 of 2 sequences are left out for their faults: overlap in 1" in said

    store = prepare(PairOptions(path=str(path), window=4.0, fill=0.0), tmp_path / "store")
    assert store.manifest["left_out"] == [
        {"name": "pairs/2", "why": "no data.window=4 s without a gap"},
        {"name": "pairs/3", "why": "no data.window=4 s without a gap"},
    ]


def test_a_spacing_of_fronts_is_refused(tmp_path: Path) -> None:
    table = drive()
    path = saved(tmp_path / "p.csv", table.assign(spacing=table.x_leader - table.x_follower))
    with pytest.raises(DataError, match=r"leader's length, is 0.00 m; .*data\.columns\.spacing"):
        read(path)
    (s,) = read(path, columns={"spacing": None})
    assert s.length is None


def test_without_the_folder_it_is_said_where_it_is_published(tmp_path: Path) -> None:
    options = configured("tgsim", "tgsim", tmp_path)
    with pytest.raises(DataError, match=r"github.com/usdot-fhwa-stol/.* at commit bd31e5189d9a"):
        pair_files(options)


def test_the_published_division_is_taken(tmp_path: Path) -> None:
    sides = ["train", "train", "test", "train", "val"]
    parts = [
        drive(pair=i, follower=2 * i, leader=2 * i + 1 if i else 4, split=side)
        for i, side in enumerate(sides)
    ]
    store = prepare(PairOptions(path=str(saved(tmp_path / "p.csv", *parts))), tmp_path / "store")
    for mode in (SplitMode.auto, SplitMode.published):
        result = split(store, SplitOptions(mode=mode))
        assert (result.train, result.heldout, result.dropped) == ([0, 1, 3], [2], [4])
        assert result.mode == "published"
        assert "1 that train share an agent" in result.note
    drawn = split(store, SplitOptions(mode=SplitMode.random, heldout=0.4))
    assert drawn.mode == "random"
    assert split(store, SplitOptions(heldout=0)).train == [0, 1, 2, 3, 4]
    none = [{**entry, "split": ""} for entry in store.index]
    with pytest.raises(DataError, match="0 sequences are marked 'train'"):
        split(none, SplitOptions(mode=SplitMode.published))


@pytest.mark.real
def test_pairs_of_ngsim(real_data: Path) -> None:
    options = configured("ngsim_pairs", "ngsim_pairs", real_data)
    result = read_pairs(pair_files(options), options)
    table = pd.read_parquet(real_data / "ngsim_pairs" / "i80_pairs.parquet")
    assert len(result) == 120
    assert sum(s.n_samples for s in result) == len(table) == 85283
    assert sorted(s.split for s in result) == ["test"] * 20 + ["train"] * 100
    for s in result:
        given = table[table.pair == int(s.name.rpartition("/")[2])]
        assert s.length is not None
        gap = s.x[:, 1, 0] - s.x[:, 0, 0] - s.length[1]
        np.testing.assert_allclose(gap, given.spacing, atol=1e-3)
        np.testing.assert_allclose(s.x[:, :, 0], given[["x_follower", "x_leader"]])
        np.testing.assert_allclose(s.v[:, :, 0], given[["v_follower", "v_leader"]])
    # pairs that share a vehicle within a quarter of an hour, counted by hand
    shared: dict[tuple[str, int], set[int]] = {}
    for pair, given in table.groupby("pair"):
        for vehicle in (given.follower.iloc[0], given.leader.iloc[0]):
            shared.setdefault((given.run.iloc[0], vehicle), set()).add(int(str(pair)))
    groups = [{pair} for pair in range(120)]
    for members in shared.values():
        joined = [group for group in groups if group & members]
        groups = [g for g in groups if not g & members] + [set().union(*joined)]
    assert clusters(index_of(result)).max() + 1 == len(groups) == 114


@pytest.mark.real
def test_pairs_of_tgsim(real_data: Path) -> None:
    options = configured("tgsim", "tgsim", real_data)
    result = read_pairs(pair_files(options), options)
    kinds = [s.kind for s in result]
    assert (kinds.count(("HV", "HV")), kinds.count(("HV", "CAV"))) == (139, 49)
    # the spacings were made with vehicles of 5 m
    assert all(s.length is not None and abs(s.length[1] - 5.0) < 1e-9 for s in result)
    assert clusters(index_of(result)).max() + 1 == len({s.recording for s in result}) == 10


EVENTS = {"pair": "event", "v_follower": "speed", "v_leader": "leader_speed"}
WAYMO = {"time": "t", "pair": "event", "run": "split"}


@pytest.mark.real
@pytest.mark.parametrize(
    ("file", "columns", "number"),
    [("ngsim_events/events.parquet", EVENTS, 201), ("waymo_pairs/hv_av_2.parquet", WAYMO, 89)],
)
def test_published_pairs_without_positions(
    real_data: Path, file: str, columns: dict[str, str], number: int
) -> None:
    result = read(real_data / file, columns=columns)
    table = pd.read_parquet(real_data / file)
    assert len(result) == clusters(index_of(result)).max() + 1 == number
    assert sum(s.n_samples for s in result) == len(table)
    names = [columns["pair"], *(["split"] if "split" in table else [])]
    rows = {"/".join(map(str, key[::-1])): given for key, given in table.groupby(names, sort=False)}
    for s in result:
        given = rows[s.name.removeprefix("pairs/")]
        np.testing.assert_allclose(s.x[:, 1, 0] - s.x[:, 0, 0] - 5.0, given.spacing, atol=1e-9)
        speeds = [columns.get(name, name) for name in ("v_follower", "v_leader")]
        np.testing.assert_array_equal(s.velocity()[:, :, 0], given[speeds])
        # the follower's position, of which only the spacing is measured, has its measured speed
        moved = cumulative_trapezoid(s.velocity()[:, 0, 0], s.time, initial=0.0)
        assert np.abs(s.x[:, 0, 0] - s.x[0, 0, 0] - moved).max() < 2.0
        assert find_faults(s, "traffic") == []


@pytest.mark.real
def test_a_published_idm_gives_the_published_error_of_spacings(real_data: Path) -> None:
    """Parameters of Wen, Jian & He 2023; speeds by Euler's method, paths by the trapezium rule."""
    a, b, v0, s0, headway = 1.08200092, 0.37833643, 29.72641382, 4.98069566, 1.4551363
    squares = total = 0.0
    for s in read(real_data / "waymo_pairs" / "hv_av_2.parquet", columns=WAYMO):
        if s.split != "test":
            continue
        spacing = s.x[:, 1, 0] - s.x[:, 0, 0] - 5.0
        follower, leader = s.velocity()[:, :, 0].T
        v = follower[0]
        rear = spacing + cumulative_trapezoid(follower, s.time, initial=0.0)
        place, gaps = 0.0, [spacing[0]]
        for k in range(s.n_samples - 1):
            wanted = s0 + v * headway + v * (v - leader[k]) / (2 * np.sqrt(a * b))
            then = v + 0.1 * a * (1 - (v / v0) ** 4 - (wanted / gaps[-1]) ** 2)
            place += 0.1 * (v + then) / 2
            v = then
            gaps.append(rear[k + 1] - place)
        squares += float(((spacing - np.array(gaps)) ** 2).sum())
        total += float((spacing**2).sum())
    assert np.sqrt(squares / total) == pytest.approx(0.2782, abs=5e-5)


def _gap_error(s: Sequence, p: dict[str, float], dt: float = 0.1) -> float:
    """Root mean square error of the gap (m) of a follower by the IDM behind its measured leader, as
    ``published.json`` says: acceleration held during a step, bounded, an exact stop."""
    assert s.length is not None
    rear, (follower, ahead) = s.x[:, 1, 0] - s.length[1], s.velocity()[:, :, 0].T
    x, v = s.x[0, 0, 0], follower[0]
    errors = []
    for k in range(s.n_samples):
        errors.append(s.x[k, 0, 0] - x)
        if k + 1 == s.n_samples:
            break
        wanted = p["s0"] + max(
            0.0, v * p["T"] + v * (v - ahead[k]) / (2 * np.sqrt(p["a"] * p["b"]))
        )
        a = p["a"] * (1 - (v / p["v0"]) ** 4 - (wanted / max(rear[k] - x, 0.1)) ** 2)
        a = min(max(a, -9.0), 6.0)
        stops = v + a * dt < 0
        x += v**2 / (-2 * a) if stops else v * dt + a * dt**2 / 2
        v = 0.0 if stops else v + a * dt
        if rear[k + 1] - x < 0.1:
            x, v = rear[k + 1] - 0.1, min(v, ahead[k + 1])
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.real
def test_published_parameters_give_the_published_errors(real_data: Path) -> None:
    published = json.loads((real_data / "ngsim_pairs" / "published.json").read_text())["idm"]
    options = configured("ngsim_pairs", "ngsim_pairs", real_data)
    held = [s for s in read_pairs(pair_files(options), options) if s.split == "test"]
    for how in ("segment", "spacing", "speed"):
        error = np.mean([_gap_error(s, published[how]) for s in held])
        # positions are kept in single precision, to 1.5e-5 m at 500 m
        assert error == pytest.approx(published[how]["rmse"], abs=2e-5), how
