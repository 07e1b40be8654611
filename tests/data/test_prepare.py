"""Preparation: policy, manifest, interruption, and opening what was prepared."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nnode.data.prepare as module
from nnode.data.options import DataOptions, Faults, SplitOptions
from nnode.data.prepare import open_data, prepare
from nnode.data.quality import LISTED
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.readers.juelich import JuelichOptions
from nnode.data.readers.table import TableOptions
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.data.store import Store
from nnode.errors import ConfigError, DataError, FaultError
from nnode.plots.quality import plot_faults
from tests.data.tables import esimas, saved, tidy

TIME = 0.2 * np.arange(6)
CLEAN = np.array([[0.0], [30.0], [60.0]]) + 25 * TIME
JUMP = CLEAN + np.where(TIME > 0.5, [[0], [0], [40]], 0)
INFINITE = np.where(CLEAN[1, 2] == CLEAN, np.inf, CLEAN)


def raw(
    folder: Path, *positions: np.ndarray, recording: str = "demo", time: np.ndarray = TIME
) -> EsimasOptions:
    folder.mkdir(exist_ok=True)
    platoons = ((x, time[: x.shape[1]]) for x in positions)
    esimas(folder / f"sequence_data{recording}.mat", *platoons)
    return EsimasOptions(source=str(folder))


@pytest.fixture
def options(tmp_path: Path) -> EsimasOptions:
    return raw(tmp_path / "raw", CLEAN, JUMP, INFINITE, CLEAN[:, :4])


def test_drop(tmp_path: Path, options: EsimasOptions) -> None:
    store = prepare(options, tmp_path / "out", draw=plot_faults)
    assert [s.name for s in store] == ["demo/000", "demo/003"]
    np.testing.assert_array_equal(store[0].x[:, :, 0].T, CLEAN)
    m = store.manifest
    assert m["counts"] == {"read": 4, "kept": 2, "dropped": 2}
    assert m["recordings"]["demo"] == {
        "read": 4,
        "kept": 2,
        "dropped": 2,
        "faulty": {"jump": 1, "non_finite": 1},
    }
    reasons = {d["sequence"]: [r["kind"] for r in d["reasons"]] for d in m["dropped"]}
    assert reasons == {"demo/001": ["jump"], "demo/002": ["non_finite"]}
    assert m["dt"] == 0.2
    assert m["domain"] == "traffic"
    file = Path(options.source or "") / "sequence_datademo.mat"
    assert m["files"]["demo"] == {
        "name": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
    }
    assert m["options"]["faults"] == "drop"
    assert m["options"]["split"]["heldout"] == SplitOptions().heldout
    assert (tmp_path / "out" / "faults" / "demo.png").is_file()


def test_keep_keeps_what_can_be_simulated(tmp_path: Path, options: EsimasOptions) -> None:
    options.faults = Faults.keep
    store = prepare(options, tmp_path / "out")
    assert [s.name for s in store] == ["demo/000", "demo/001", "demo/003"]
    assert {f["kind"] for f in store.manifest["faults"]} == {"jump", "non_finite"}
    assert not (tmp_path / "out" / "faults").exists()


def test_error_refuses_and_leaves_the_folder_alone(tmp_path: Path, options: EsimasOptions) -> None:
    prepare(options, tmp_path / "out")
    before = {p: p.read_bytes() for p in (tmp_path / "out").iterdir() if p.is_file()}
    options.faults = Faults.error
    with pytest.raises(FaultError, match=r"2 of 4 sequences hold faults \(jump in 1, non_fin"):
        prepare(options, tmp_path / "out")
    assert before == {p: p.read_bytes() for p in (tmp_path / "out").iterdir() if p.is_file()}
    options = raw(tmp_path / "sound", CLEAN)
    options.faults = Faults.error
    assert len(prepare(options, tmp_path / "sound_out")) == 1


def test_a_fault_message_lists_the_first_few(tmp_path: Path) -> None:
    options = raw(tmp_path / "raw", *[JUMP] * 9)
    options.faults = Faults.error
    with pytest.raises(
        FaultError, match=r"(?s)demo/000: jump: car 2 goes from .*\.\.\. and 4 more"
    ) as e:
        prepare(options, tmp_path / "out")
    assert str(e.value).count("demo/") == LISTED


def test_nothing_left(tmp_path: Path) -> None:
    options = raw(tmp_path / "raw", JUMP, INFINITE)
    with pytest.raises(DataError, match=r"nothing is left of 2 sequences: jump in 1, non_finite"):
        prepare(options, tmp_path / "out")
    options = raw(tmp_path / "raw", CLEAN[:1])
    with pytest.raises(DataError, match="nothing is left of 1 sequences: too_short in 1"):
        prepare(options, tmp_path / "out")


@pytest.mark.parametrize("place", ["write_store", "plot"])
def test_interrupted_preparation_starts_clean(
    tmp_path: Path, options: EsimasOptions, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    out = tmp_path / "out"

    def draw(*arguments: Any) -> None:
        arguments[-1].write_bytes(b"a picture")

    prepare(options, out, draw=draw)
    before = (out / "manifest.json").read_bytes()

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if place == "write_store":
            patch.setattr(module, place, interrupt)
        options.recording = "demo"
        with pytest.raises(KeyboardInterrupt):
            prepare(options, out, draw=interrupt if place == "plot" else draw)
    assert (out / "manifest.json").read_bytes() == before
    assert len(Store(out)) == 2
    (out / ".faults.123.partial").mkdir()
    (out / ".sequences.parquet.123.partial").write_text("half")
    prepare(options, out, draw=draw)
    assert sorted(p.name for p in out.iterdir()) == [
        "faults",
        "manifest.json",
        "sequences-2.parquet",
    ]


def test_same_data_same_files(tmp_path: Path, options: EsimasOptions) -> None:
    for name in ("a", "b"):
        prepare(options, tmp_path / name, draw=plot_faults)
    for file in ("manifest.json", "sequences.parquet", "faults/demo.png"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_open_prepared(tmp_path: Path, options: EsimasOptions) -> None:
    prepare(options, tmp_path / "out")
    options.prepared = str(tmp_path / "out")
    options.source, options.download = "elsewhere", "elsewhere"
    options.split.heldout, options.loader.batch_size = 0.5, 3
    store = open_data(options, tmp_path / "unused")
    assert store.folder == tmp_path / "out"
    assert not (tmp_path / "unused").exists()
    options.faults, options.min_vehicles = Faults.keep, 2
    with pytest.raises(
        ConfigError, match=r"data\.faults=drop then, keep now; data\.min_vehicles=3 then, 2 now"
    ):
        open_data(options, tmp_path / "unused")
    with pytest.raises(ConfigError, match=r"out holds data of EsimasOptions, the options are Jue"):
        open_data(JuelichOptions(prepared=options.prepared), tmp_path / "unused")
    options.prepared = str(tmp_path / "raw")
    with pytest.raises(DataError):
        open_data(options, tmp_path / "unused")


def test_the_folder_is_enough(tmp_path: Path, options: EsimasOptions) -> None:
    options.faults, options.recording = Faults.keep, ["demo"]
    prepare(options, tmp_path / "out")
    assert len(open_data(EsimasOptions(prepared=str(tmp_path / "out")), tmp_path / "unused")) == 3
    other = EsimasOptions(prepared=str(tmp_path / "out"), recording="demo", faults=Faults.error)
    with pytest.raises(ConfigError, match=r"data\.recording=\['demo'\] then, demo now; data\.faul"):
        open_data(other, tmp_path / "unused")


def test_a_folder_that_does_not_tell_its_reader(tmp_path: Path, options: EsimasOptions) -> None:
    prepare(options, tmp_path / "out")
    manifest = tmp_path / "out" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"reader"', '"earlier"'))
    with pytest.raises(ConfigError, match=r"does not tell which of nnode's readers .* again"):
        open_data(EsimasOptions(prepared=str(tmp_path / "out")), tmp_path / "unused")


def test_open_prepares_on_the_fly(tmp_path: Path, options: EsimasOptions) -> None:
    store = open_data(options, tmp_path / "out")
    assert len(store) == 2
    assert not (tmp_path / "out" / "faults").exists()


def test_a_moved_table_is_the_same_table(tmp_path: Path) -> None:
    path = saved(tmp_path / "t.csv", tidy(4, 2))
    options = TableOptions(domain="traffic", path=str(path))
    prepare(options, tmp_path / "out")
    options.path, options.prepared = "far/away/t.csv", str(tmp_path / "out")
    assert len(open_data(options, tmp_path / "unused")) == 1
    options.path = "other.csv"
    with pytest.raises(ConfigError, match=r"data\.path=t\.csv then, other\.csv now"):
        open_data(options, tmp_path / "unused")


def test_people_absent_for_a_while_are_left_out(tmp_path: Path) -> None:
    table = tidy(5, 3, step=0.1).assign(y=0.0)
    path = saved(tmp_path / "t.csv", table[(table.agent != 1) | (table.time > 0)])
    options = TableOptions(domain="crowd", path=str(path))
    store = prepare(options, tmp_path / "out")
    assert store[0].agents == ("0", "2")
    (absent,) = store.manifest["dropped_agents"]
    assert absent == {"sequence": "t/s", "agent": "1", "why": "absent at 1 of 5 samples"}


def test_absent_vehicle_makes_the_sequence_faulty(tmp_path: Path) -> None:
    table = tidy(5, 3, "ab")
    absent = (table.sequence == "b") & (table.agent == 1) & (table.time > 0.15)
    path = saved(tmp_path / "t.csv", table[~absent])
    options = TableOptions(domain="traffic", path=str(path), faults=Faults.keep, fill=0.1)
    store = prepare(options, tmp_path / "out")
    assert [s.name for s in store] == ["t/a"]
    assert store.manifest["recordings"]["t"]["faulty"] == {"gap_in_time": 1}


def test_two_percent_of_missing_samples_cost_no_platoon(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    rows = tidy(100, 4, "01234567", step=1.5)
    rows["x"] += 6 * np.sin(0.5 * rows.time + rows.sequence.astype(int))
    path = saved(tmp_path / "t.csv", rows[rng.random(len(rows)) > 0.02])
    store = prepare(TableOptions(domain="traffic", path=str(path)), tmp_path / "out")
    assert len(store) == 8
    told = store.manifest["filled"]
    assert sum(entry["samples"] for entry in told) == pytest.approx(0.02 * len(rows), rel=0.3)
    assert {entry["sequence"] for entry in told} <= {s.name for s in store}
    # what is longer is not filled: it cuts a platoon in two, and that is said
    gone = rows[~(rows.time.between(3, 5) & (rows.agent == 1))]
    gone.to_csv(path, index=False)
    store = prepare(TableOptions(domain="traffic", path=str(path)), tmp_path / "out")
    assert len(store) == 16
    assert store.manifest["filled"] == []
    assert "cut into 2 sequences" in store.manifest["notes"][0]
    assert store.manifest["notes"][3] == "and 5 more such sequences"


def test_vehicles_that_never_meet_are_refused_with_what_to_do(tmp_path: Path) -> None:
    table = tidy(30, 3)
    path = saved(tmp_path / "t.csv", table.assign(time=table.time + 3 * table.agent))
    with pytest.raises(DataError, match=r"data\.fill=SECONDS") as error:
        prepare(TableOptions(domain="traffic", path=str(path)), tmp_path / "out")
    assert "faults=keep" not in str(error.value)


def test_a_folder_of_an_earlier_version_opens_under_its_names_of_options(tmp_path: Path) -> None:
    path = saved(tmp_path / "t.csv", tidy(30, 3))
    options = TableOptions(domain="traffic", path=str(path), fill=0.3)
    store = prepare(options, tmp_path / "out")
    manifest = tmp_path / "out" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"fill": 0.3', '"max_hole": 0.3'))
    assert "max_hole" in manifest.read_text()
    asked = replace(options, prepared=str(store.folder))
    assert len(open_data(asked, tmp_path / "new")) == 1
    with pytest.raises(ConfigError, match=r"data\.fill=0\.3 then, 0\.1 now"):
        open_data(replace(asked, fill=0.1), tmp_path / "new")


def test_noise_stands_in_the_manifest_and_is_no_fault(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    rows = tidy(200, 3, "abcde", step=0.4)
    rows["x"] += 0.3 * rng.normal(size=len(rows))
    path = saved(tmp_path / "t.csv", rows)
    options = TableOptions(domain="traffic", path=str(path))
    store = prepare(options, tmp_path / "out")
    # steps of -0.5 m are common where cars drive slowly: none of them is a fault
    assert len(store) == 5
    assert store.manifest["noise"]["position"] == pytest.approx(0.3, rel=0.1)
    assert store.manifest["noise"]["start_speed"] == pytest.approx(0.3 * 2**0.5 / 0.1, rel=0.1)
    options.smooth = 2.0
    smooth = prepare(options, tmp_path / "smooth")
    assert smooth.manifest["noise"]["start_speed"] < 0.2
    assert np.std(smooth[0].x[:, 0, 0] - 4 * smooth[0].time) < 0.15


def test_one_data_set_has_one_sampling_interval(tmp_path: Path) -> None:
    folder = tmp_path / "raw"
    raw(folder, CLEAN, recording="a")
    options = raw(folder, CLEAN, recording="b", time=2 * TIME)
    with pytest.raises(DataError, match=r"a/000 is sampled every 0.2 s, b/000 every 0.4 s"):
        prepare(options, tmp_path / "out")


def test_wrong_options(tmp_path: Path, options: EsimasOptions) -> None:
    options.domain = "crowd"
    with pytest.raises(ConfigError, match="domain=crowd needs 2-dimensional positions"):
        prepare(options, tmp_path / "out")
    options.domain = "sea"
    with pytest.raises(ConfigError, match="domain=sea: expected traffic or crowd"):
        prepare(options, tmp_path / "out")
    with pytest.raises(ConfigError, match="no reader for DataOptions"):
        prepare(DataOptions(), tmp_path / "out")
    with pytest.raises(ConfigError, match=r"path is not set"):
        prepare(VehicleTableOptions(), tmp_path / "out")


def test_unwritable_folder(tmp_path: Path, options: EsimasOptions) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot be written"):
        prepare(options, tmp_path / "file" / "out")


@pytest.mark.real
def test_published_recordings(tmp_path: Path, real_data: Path) -> None:
    options = EsimasOptions(source=str(real_data), faults=Faults.keep)
    store = prepare(options, tmp_path / "keep")
    assert len(store) == 265
    assert len(store.manifest["recordings"]) == 10
    options.faults = Faults.drop
    clean = prepare(options, tmp_path / "drop")
    for s in clean:  # judged without the checks: nobody goes back, leaps or overlaps
        step, gap = np.diff(s.x, axis=0), np.diff(s.x, axis=1)
        assert step.min() > -0.5
        assert step.max() < 12.5
        assert gap.min() >= 2
