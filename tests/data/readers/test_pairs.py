"""Pairs of a follower and its leader: columns, units, gaps, and the published division."""

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


def drive(first: int = 0, last: int = 50, unit: float = 1.0, **columns: object) -> pd.DataFrame:
    """A follower at 10 m/s, 20 m behind the rear of a leader of 4 m at 11 m/s, in ``unit`` m."""
    t = 0.1 * np.arange(first, last + 1)
    lengths = {"x_follower": 10.0 * t, "x_leader": 24.0 + 11.0 * t, "spacing": 20.0 + t}
    table = pd.DataFrame({**lengths, "v_follower": 10.0, "v_leader": 11.0}) / unit
    return table.assign(time=t, **columns)


read = partial(tables.read, PairOptions)

#: ``(K, 2)`` positions of the follower and the leader of :func:`drive`, m.
PATHS = np.stack([np.arange(51.0), 24 + 1.1 * np.arange(51)], axis=-1)


def configured(name: str, path: Path | str, source: Path | None = None) -> PairOptions:
    """The options of a shipped configuration."""
    shipped = OmegaConf.load(CONF / f"{name}.yaml")
    shipped.pop("defaults")
    chosen = {"path": str(path), "source": None if source is None else str(source)}
    merged = OmegaConf.merge(OmegaConf.structured(PairOptions), shipped, chosen)
    return OmegaConf.to_object(merged)


def configured_pairs(name: str, path: Path | str, source: Path | None = None) -> Reading:
    """The pairs that a shipped configuration reads."""
    options = configured(name, path, source)
    return read_pairs(pair_files(options), options)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_pair_is_a_platoon_of_two(tmp_path: Path, suffix: str) -> None:
    columns = {"follower": 7, "leader": 5, "run": "a", "leader_kind": "CAV", "split": "Test"}
    (s,) = read(
        saved(tmp_path / f"p{suffix}", drive(unit=FOOT, **columns)),
        position_unit="ft",
        speed_unit="ft/s",
        kinds={"CAV": "automated"},
    )
    assert (s.name, s.recording, s.agents, s.split) == ("a/p", "a", ("7", "5"), "test")
    assert s.kind == ("", "automated")
    np.testing.assert_allclose(s.time, 0.1 * np.arange(51), atol=1e-12)
    np.testing.assert_allclose(s.x[:, :, 0], PATHS, atol=1e-9)
    np.testing.assert_allclose(s.v[:, :, 0], np.tile([10.0, 11.0], (51, 1)))
    np.testing.assert_allclose(s.length, [np.nan, 4.0])


def test_several_pairs_of_one_table(tmp_path: Path) -> None:
    """The rows may have any order; the length of the leader is a column."""
    parts = [drive(pair=p, leader_length=4.5).drop(columns="spacing") for p in (3, 1)]
    table = pd.concat(parts).sample(frac=1.0, random_state=1)
    result = read(saved(tmp_path / "all.csv", table), window=1.0)
    assert len(result) == 10
    assert {s.name for s in result} == {f"pairs/{p}_{k:03d}" for p in (1, 3) for k in range(5)}
    assert {(s.n_samples, s.length[1]) for s in result} == {(11, 4.5)}
    # vehicles without a name are named after their pair, so that its windows are one cluster
    assert {s.agents for s in result} == {(f"{p} follower", f"{p} leader") for p in (1, 3)}


def test_gap_splits_a_pair_or_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "p.csv", drive(0, 20), drive(30, 50))
    first, second = read(path)
    assert (first.name, second.name) == ("pairs/p_000", "pairs/p_001")
    assert (first.time[-1], second.time[0]) == pytest.approx((2.0, 3.0))
    with pytest.raises(DataError, match=r"pair p steps from 2 s to 3 s \(line 23\)"):
        read(path, gaps=Gaps.error)


def test_uneven_times_are_interpolated(tmp_path: Path) -> None:
    table = drive()
    table["time"] += np.random.default_rng(2).uniform(-0.02, 0.02, 51)
    table["x_follower"], table["x_leader"] = 10 * table.time, 24 + 11 * table.time
    result = read(saved(tmp_path / "p.csv", table.drop(columns="spacing")), dt=0.1)
    (s,) = result
    assert "are interpolated to steps of 0.1 s" in result.notes[0]
    np.testing.assert_allclose(s.x[:, 0, 0], 10 * s.time, atol=1e-9)
    np.testing.assert_allclose(s.x[:, 1, 0], 24 + 11 * s.time, atol=1e-9)


def test_times_in_frames(tmp_path: Path) -> None:
    path = saved(tmp_path / "p.csv", drive().assign(time=range(51)))
    (s,) = read(path, time_unit="frame", frame_rate=10.0)
    np.testing.assert_allclose(s.time, 0.1 * np.arange(51), atol=1e-12)
    with pytest.raises(ConfigError, match="frame_rate=None: expected a positive number"):
        read(path, time_unit="frame")


def test_coarser_grid(tmp_path: Path) -> None:
    path = saved(tmp_path / "p.csv", drive(3, 50))
    with pytest.raises(ConfigError, match=r"dt=0\.05 s is finer than the 0\.1 s"):
        read(path, dt=0.05)
    (s,) = read(path, dt=0.4)
    np.testing.assert_allclose(s.time, 0.4 * np.arange(1, 13))
    np.testing.assert_allclose(s.x[:, 0, 0], 10 * s.time)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"spacing": np.linspace(20, 30, 51)}, "one length of the leader"),
        ({"leader": np.arange(51)}, "line 3: column 'leader' holds 1, before it 0"),
        ({"time": 0.0}, "line 3: agent 1 of p occurs a second time at 0 s"),
        ({"x_leader": "?"}, "line 2: column 'x_leader' holds '\\?'"),
        # the spacing between fronts
        (
            {"spacing": PATHS[:, 1] - PATHS[:, 0]},
            r"leader's length, is 0.00 m; .*data\.columns\.spacing",
        ),
    ],
)
def test_invalid_rows(tmp_path: Path, columns: dict[str, object], message: str) -> None:
    path = saved(tmp_path / "p.csv", drive(pair="p", follower=1).assign(**columns))
    with pytest.raises(DataError, match=message):
        read(path)


def test_spacing_may_be_left_out(tmp_path: Path) -> None:
    (s,) = read(saved(tmp_path / "p.csv", drive()), columns={"spacing": None})
    assert s.length is None


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"pattern": "(?P<colour>.*)"}, ConfigError, "group 'colour' is unknown"),
        ({"pattern": "("}, ConfigError, "data.pattern"),
        ({"constant": {"x": "1"}}, ConfigError, "data.constant.x"),
        ({"columns": {"y": "y"}}, ConfigError, "data.columns.y is unknown"),
        ({"lane": 3}, ConfigError, "lane=3: the pairs have the lanes 2"),
        ({"window": 0.15}, ConfigError, "no whole number of steps"),
        ({"position_unit": {"*.parquet": "m"}}, ConfigError, "no pattern fits p.csv"),
        ({"recording": "b"}, ConfigError, "recording=b: unknown recording"),
        ({"pattern": "(?P<run>[0-9]+)_"}, DataError, r"does not fit data\.pattern"),
    ],
)
def test_invalid_options(
    tmp_path: Path, options: dict[str, object], error: type[Exception], message: str
) -> None:
    path = saved(tmp_path / "p.csv", drive(lane=2))
    assert len(read(path, lane=2)) == 1
    with pytest.raises(error, match=message):
        read(path, **options)


def test_published_files_of_ngsim(tmp_path: Path) -> None:
    table = drive(unit=FOOT, leader_length=4.0 / FOOT).rename(columns={"time": "t"})
    run = "final_I80_trajectories-0400pm-0415pm_runfinal_I80_trajectories-0400pm-0415pm"
    listed = [f"train/ngsim_{run}_f13_l15_00035.csv", f"test/ngsim_{run}_f254_l253_00014.csv"]
    # the last file is of an earlier extraction, which the list does not name
    for name in (*listed, f"train/ngsim_{run}_f254_l253_00002.csv"):
        saved(tmp_path / name, table)
    manifest = {
        "path": listed,
        "split": ["train", "test"],
        "follower": [13, 254],
        "leader": [15, 253],
        "lane": [4.0, 2.0],
        "run": run,
    }
    saved(tmp_path / "manifest.csv", pd.DataFrame(manifest))
    options = configured("ngsim_pairs", tmp_path)
    train, test = read_pairs(pair_files(options), options)
    assert {s.recording for s in (train, test)} == {"0400pm-0415pm"}
    assert (test.name, test.split) == ("0400pm-0415pm/f254_l253_00014", "test")
    assert (train.agents, train.split) == (("13", "15"), "train")
    np.testing.assert_allclose(train.x[-1, :, 0], [50.0, 79.0])
    np.testing.assert_allclose(train.length, [np.nan, 4.0])
    options.lane = 2
    assert [s.agents for s in read_pairs(pair_files(options), options)] == [("254", "253")]

    (tmp_path / listed[0]).unlink()
    with pytest.raises(DataError, match=r"manifest\.csv, line 2: there is no file"):
        pair_files(options)


def test_published_files_of_tgsim(tmp_path: Path) -> None:
    names = {"time": "timestamp"} | {
        f"{q}_{who.lower()}": f"{q}{who}Real" for q in "xv" for who in ("Leader", "Follower")
    }
    table = drive(follower_id=16, leader_id=6, run_no=1).rename(columns=names)
    saved(tmp_path / "CAV" / "run-1-veh-16-pair-7.csv", table)
    (s,) = configured_pairs("tgsim", tmp_path)
    assert (s.name, s.agents, s.kind) == ("1/run-1-veh-16-pair-7", ("16", "6"), ("HV", "CAV"))


def spaced(pair: object, spacing: float = 20.0, k: int = 51, **columns: object) -> pd.DataFrame:
    """A follower at 10 m/s behind a leader whose speed falls linearly from 12 m/s to 9 m/s."""
    t = 0.1 * np.arange(k)
    gap = spacing + 2.0 * t - 0.3 * t**2
    table = {"pair": pair, "time": t, "spacing": gap, "v_follower": 10.0, "v_leader": 12 - 0.6 * t}
    return pd.DataFrame({**table, **columns})


def test_positions_follow_from_spacing_and_speeds(tmp_path: Path) -> None:
    table = spaced(1)
    path = saved(tmp_path / "p.csv", table)
    (s,) = read(path)
    # the trapezium rule is exact for a speed that changes linearly
    np.testing.assert_allclose(s.x[:, 1, 0], 12.0 * s.time - 0.3 * s.time**2, atol=1e-9)
    np.testing.assert_array_equal(s.length, [np.nan, 5.0])
    np.testing.assert_allclose(s.x[:, 1, 0] - s.x[:, 0, 0] - 5.0, table.spacing, atol=1e-9)
    np.testing.assert_allclose(np.diff(s.x[:, 0, 0]), 1.0, atol=1e-9)
    np.testing.assert_array_equal(s.velocity()[:, :, 0], table[["v_follower", "v_leader"]])

    # the length of a leader moves the fronts and leaves the gaps as they are
    (longer,) = read(saved(tmp_path / "q.csv", spaced(1, leader_length=12.0)))
    np.testing.assert_array_equal(longer.length, [np.nan, 12.0])
    np.testing.assert_allclose(longer.x[:, 0] - s.x[:, 0], -7.0)
    (no_length,) = read(path, length=None)
    assert no_length.length is None
    np.testing.assert_allclose(no_length.x[:, 1, 0] - no_length.x[:, 0, 0], table.spacing)

    units = table.assign(spacing=table.spacing / FOOT, v_leader=table.v_leader * 3.6)
    path = saved(tmp_path / "r.csv", units.assign(v_follower=36.0))
    (converted,) = read(path, position_unit="ft", speed_unit="km/h")
    np.testing.assert_allclose(converted.x, s.x, atol=1e-9)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        *(
            (spaced(1).drop(columns=name), "spacing, v_follower and v_leader are needed")
            for name in ("spacing", "v_follower", "v_leader")
        ),
        (
            spaced(1).assign(spacing=[np.nan] + [20.0] * 50),
            "line 2: column 'spacing' holds nothing",
        ),
    ],
)
def test_incomplete_tables_without_positions(
    tmp_path: Path, table: pd.DataFrame, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        read(saved(tmp_path / "p.csv", table))


def test_each_anonymous_pair_is_a_cluster(tmp_path: Path) -> None:
    parts = [spaced(i, 20.0 + i) for i in range(12)]
    result = read(saved(tmp_path / "p.csv", *parts), window=1.0)
    assert len(result) == 60
    label = clusters(index_of(result))
    assert label.max() + 1 == 12
    names = np.array([s.name.partition("_")[0] for s in result])
    assert all(len(set(label[names == name])) == 1 for name in names)


def test_pairs_that_share_a_vehicle_are_one_cluster(tmp_path: Path) -> None:
    parts = [spaced(i, follower=i // 2) for i in range(6)]
    result = read(saved(tmp_path / "p.csv", *parts))
    assert clusters(index_of(result)).tolist() == [0, 0, 1, 1, 2, 2]


def test_omitted_pairs_are_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with_holes = spaced(3).drop(index=range(5, 51, 5))
    parts = [spaced(1), spaced(2, k=4), with_holes, spaced(4, spacing=0.2, leader_length=0.5)]
    path = str(saved(tmp_path / "p.csv", *parts))
    store = prepare(PairOptions(path=path, min_samples=10, fill=0.0), tmp_path / "store")
    assert store.manifest["left_out"] == [
        {"name": "pairs/2", "why": "fewer than data.min_samples=10 times"},
        {"name": "pairs/3", "why": "no data.min_samples=10 times without a gap"},
    ]
    assert [entry["sequence"] for entry in store.manifest["dropped"]] == ["pairs/4"]
    assert store.manifest["counts"] == {"read": 2, "kept": 1, "dropped": 1}
    assert "records that are left out, as there is no sequence of them: 2 (" in caplog.text
    assert "1 of 2 sequences are left out for their faults: overlap in 1" in caplog.text

    store = prepare(PairOptions(path=path, window=4.0, fill=0.0), tmp_path / "store")
    assert store.manifest["left_out"] == [
        {"name": name, "why": "no data.window=4 s without a gap"} for name in ("pairs/2", "pairs/3")
    ]


def test_missing_folder_error_states_the_source(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"github.com/usdot-fhwa-stol/.* at commit bd31e5189d9a"):
        pair_files(configured("tgsim", "tgsim", tmp_path))


def test_published_division_is_the_default(tmp_path: Path) -> None:
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
    assert split(store, SplitOptions(mode=SplitMode.random, heldout=0.4)).mode == "random"
    assert split(store, SplitOptions(heldout=0)).train == [0, 1, 2, 3, 4]
    unmarked = [{**entry, "split": ""} for entry in store.index]
    with pytest.raises(DataError, match="0 sequences are marked 'train'"):
        split(unmarked, SplitOptions(mode=SplitMode.published))


@pytest.mark.real
def test_pairs_of_ngsim(real_data: Path) -> None:
    result = configured_pairs("ngsim_pairs", "ngsim_pairs", real_data)
    table = pd.read_parquet(real_data / "ngsim_pairs" / "i80_pairs.parquet")
    assert len(result) == 120
    assert sum(s.n_samples for s in result) == len(table) == 85283
    assert sorted(s.split for s in result) == ["test"] * 20 + ["train"] * 100
    for s in result:
        rows = table[table.pair == int(s.name.rpartition("/")[2])]
        gap = s.x[:, 1, 0] - s.x[:, 0, 0] - s.length[1]
        np.testing.assert_allclose(gap, rows.spacing, atol=1e-3)
        np.testing.assert_allclose(s.x[:, :, 0], rows[["x_follower", "x_leader"]])
        np.testing.assert_allclose(s.v[:, :, 0], rows[["v_follower", "v_leader"]])
    # the groups of pairs that share a vehicle within a quarter of an hour
    groups: list[tuple[set[object], set[object]]] = []
    for pair, rows in table.groupby("pair"):
        first = rows.iloc[0]
        pairs, vehicles = {pair}, {(first.run, first.follower), (first.run, first.leader)}
        separate = []
        for group in groups:
            if group[1] & vehicles:
                pairs, vehicles = pairs | group[0], vehicles | group[1]
            else:
                separate.append(group)
        groups = [*separate, (pairs, vehicles)]
    assert sum(len(pairs) for pairs, _ in groups) == 120
    assert clusters(index_of(result)).max() + 1 == len(groups) == 114


@pytest.mark.real
def test_pairs_of_tgsim(real_data: Path) -> None:
    result = configured_pairs("tgsim", "tgsim", real_data)
    kinds = [s.kind for s in result]
    assert (kinds.count(("HV", "HV")), kinds.count(("HV", "CAV"))) == (139, 49)
    # the published spacings assume vehicles of 5 m
    assert all(abs(s.length[1] - 5.0) < 1e-9 for s in result)
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
    rows = {"/".join(map(str, key[::-1])): part for key, part in table.groupby(names, sort=False)}
    for s in result:
        measured = rows[s.name.removeprefix("pairs/")]
        np.testing.assert_allclose(s.x[:, 1, 0] - s.x[:, 0, 0] - 5.0, measured.spacing, atol=1e-9)
        speeds = [columns.get(name, name) for name in ("v_follower", "v_leader")]
        np.testing.assert_array_equal(s.velocity()[:, :, 0], measured[speeds])
        # the follower's position agrees with its measured speed
        moved = cumulative_trapezoid(s.velocity()[:, 0, 0], s.time, initial=0.0)
        assert np.abs(s.x[:, 0, 0] - s.x[0, 0, 0] - moved).max() < 2.0
        assert find_faults(s, "traffic") == []


@pytest.mark.real
def test_published_idm_of_waymo(real_data: Path) -> None:
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
        x, gaps = 0.0, [spacing[0]]
        for k in range(s.n_samples - 1):
            desired = s0 + v * headway + v * (v - leader[k]) / (2 * np.sqrt(a * b))
            next_v = v + 0.1 * a * (1 - (v / v0) ** 4 - (desired / gaps[-1]) ** 2)
            x += 0.1 * (v + next_v) / 2
            v = next_v
            gaps.append(rear[k + 1] - x)
        squares += float(((spacing - np.array(gaps)) ** 2).sum())
        total += float((spacing**2).sum())
    assert np.sqrt(squares / total) == pytest.approx(0.2782, abs=5e-5)


def gap_error(s: Sequence, p: dict[str, float], dt: float = 0.1) -> float:
    """Root mean square error (m) of the gap of a follower by the IDM behind its measured leader.

    As described in ``published.json``: the acceleration is bounded and constant during a step, and
    stops are exact.
    """
    rear, (follower, leader) = s.x[:, 1, 0] - s.length[1], s.velocity()[:, :, 0].T
    x, v = s.x[0, 0, 0], follower[0]
    errors = []
    for k in range(s.n_samples):
        errors.append(s.x[k, 0, 0] - x)
        if k + 1 == s.n_samples:
            break
        desired = p["s0"] + max(
            0.0, v * p["T"] + v * (v - leader[k]) / (2 * np.sqrt(p["a"] * p["b"]))
        )
        a = p["a"] * (1 - (v / p["v0"]) ** 4 - (desired / max(rear[k] - x, 0.1)) ** 2)
        a = min(max(a, -9.0), 6.0)
        stopping = v + a * dt < 0
        x += v**2 / (-2 * a) if stopping else v * dt + a * dt**2 / 2
        v = 0.0 if stopping else v + a * dt
        if rear[k + 1] - x < 0.1:
            x, v = rear[k + 1] - 0.1, min(v, leader[k + 1])
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.real
def test_published_idm_of_ngsim(real_data: Path) -> None:
    published = json.loads((real_data / "ngsim_pairs" / "published.json").read_text())["idm"]
    pairs = configured_pairs("ngsim_pairs", "ngsim_pairs", real_data)
    for target in ("segment", "spacing", "speed"):
        error = np.mean([gap_error(s, published[target]) for s in pairs if s.split == "test"])
        # positions are stored in single precision, to 1.5e-5 m at 500 m
        assert error == pytest.approx(published[target]["rmse"], abs=2e-5), target
