"""Preparation: policy for faults, manifest, interruption, and opening prepared data."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
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
    """Write platoons in the layout of ESIMAS; the options that read them."""
    folder.mkdir(exist_ok=True)
    platoons = ((x, time[: x.shape[1]]) for x in positions)
    esimas(folder / f"sequence_data{recording}.mat", *platoons)
    return EsimasOptions(source=str(folder))


def prepared_table(folder: Path, table: pd.DataFrame, **options: Any) -> Store:
    """The store of a tidy table of traffic, or of another domain."""
    path = saved(folder / "t.csv", table)
    options = {"domain": "traffic", "path": str(path), **options}
    return prepare(TableOptions(**options), folder / "out")


@pytest.fixture
def options(tmp_path: Path) -> EsimasOptions:
    return raw(tmp_path / "raw", CLEAN, JUMP, INFINITE, CLEAN[:, :4])


def test_faulty_sequences_are_dropped(tmp_path: Path, options: EsimasOptions) -> None:
    store = prepare(options, tmp_path / "out", draw=plot_faults)
    assert [s.name for s in store] == ["demo/000", "demo/003"]
    np.testing.assert_array_equal(store[0].x[:, :, 0].T, CLEAN)
    manifest, counts = store.manifest, {"read": 4, "kept": 2, "dropped": 2}
    assert manifest["counts"] == counts
    faulty = {"jump": 1, "non_finite": 1}
    assert manifest["recordings"]["demo"] == {**counts, "faulty": faulty}
    reasons = {d["sequence"]: [r["kind"] for r in d["reasons"]] for d in manifest["dropped"]}
    assert reasons == {"demo/001": ["jump"], "demo/002": ["non_finite"]}
    assert (manifest["dt"], manifest["domain"]) == (0.2, "traffic")
    file = tmp_path / "raw" / "sequence_datademo.mat"
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert manifest["files"]["demo"] == {"name": file.name, "sha256": digest}
    assert manifest["options"]["faults"] == "drop"
    assert manifest["options"]["split"]["heldout"] == SplitOptions().heldout
    assert (tmp_path / "out" / "faults" / "demo.png").is_file()


def test_faulty_sequences_are_kept_if_finite(tmp_path: Path, options: EsimasOptions) -> None:
    options.faults = Faults.keep
    store = prepare(options, tmp_path / "out")
    assert [s.name for s in store] == ["demo/000", "demo/001", "demo/003"]
    assert {f["kind"] for f in store.manifest["faults"]} == {"jump", "non_finite"}
    assert not (tmp_path / "out" / "faults").exists()


def test_faults_are_refused_without_changing_the_folder(
    tmp_path: Path, options: EsimasOptions
) -> None:
    def content() -> dict[Path, bytes]:
        return {p: p.read_bytes() for p in (tmp_path / "out").iterdir() if p.is_file()}

    prepare(options, tmp_path / "out")
    before = content()
    options.faults = Faults.error
    with pytest.raises(FaultError, match=r"2 of 4 sequences hold faults \(jump in 1, non_fin"):
        prepare(options, tmp_path / "out")
    assert before == content()
    clean = replace(raw(tmp_path / "clean", CLEAN), faults=Faults.error)
    assert len(prepare(clean, tmp_path / "clean_out")) == 1


def test_fault_message_lists_the_first_faults(tmp_path: Path) -> None:
    options = replace(raw(tmp_path / "raw", *[JUMP] * 9), faults=Faults.error)
    message = r"(?s)demo/000: jump: car 2 goes from .*\.\.\. and 4 more"
    with pytest.raises(FaultError, match=message) as error:
        prepare(options, tmp_path / "out")
    assert str(error.value).count("demo/") == LISTED


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ([JUMP, INFINITE], "nothing is left of 2 sequences: jump in 1, non_finite"),
        ([CLEAN[:1]], "nothing is left of 1 sequences: too_short in 1"),
    ],
)
def test_no_sequence_without_faults(
    tmp_path: Path, positions: list[np.ndarray], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        prepare(raw(tmp_path / "raw", *positions), tmp_path / "out")


@pytest.mark.parametrize("place", ["write_store", "plot"])
def test_interrupted_preparation_leaves_a_valid_store(
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


def test_same_data_give_the_same_files(tmp_path: Path, options: EsimasOptions) -> None:
    for name in ("a", "b"):
        prepare(options, tmp_path / name, draw=plot_faults)
    for file in ("manifest.json", "sequences.parquet", "faults/demo.png"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_open_prepared_data(tmp_path: Path, options: EsimasOptions) -> None:
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


def test_prepared_folder_is_the_only_option_needed(tmp_path: Path, options: EsimasOptions) -> None:
    options.faults, options.recording = Faults.keep, ["demo"]
    prepare(options, tmp_path / "out")
    assert len(open_data(EsimasOptions(prepared=str(tmp_path / "out")), tmp_path / "unused")) == 3
    other = EsimasOptions(prepared=str(tmp_path / "out"), recording="demo", faults=Faults.error)
    with pytest.raises(ConfigError, match=r"data\.recording=\['demo'\] then, demo now; data\.faul"):
        open_data(other, tmp_path / "unused")


def test_folder_without_the_name_of_its_reader(tmp_path: Path, options: EsimasOptions) -> None:
    prepare(options, tmp_path / "out")
    manifest = tmp_path / "out" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"reader"', '"earlier"'))
    with pytest.raises(ConfigError, match=r"does not state which of nnode's readers .* again"):
        open_data(EsimasOptions(prepared=str(tmp_path / "out")), tmp_path / "unused")


def test_open_data_prepares_raw_data(tmp_path: Path, options: EsimasOptions) -> None:
    store = open_data(options, tmp_path / "out")
    assert len(store) == 2
    assert not (tmp_path / "out" / "faults").exists()


def test_moved_table_is_the_same_table(tmp_path: Path) -> None:
    store = prepared_table(tmp_path, tidy(4, 2))
    options = TableOptions(domain="traffic", path="far/away/t.csv", prepared=str(store.folder))
    assert len(open_data(options, tmp_path / "unused")) == 1
    options.path = "other.csv"
    with pytest.raises(ConfigError, match=r"data\.path=t\.csv then, other\.csv now"):
        open_data(options, tmp_path / "unused")


def test_people_with_missing_samples_are_left_out(tmp_path: Path) -> None:
    table = tidy(5, 3, step=0.1).assign(y=0.0)
    present = table[(table.agent != 1) | (table.time > 0)]
    store = prepared_table(tmp_path, present, domain="crowd")
    assert store[0].agents == ("0", "2")
    (absent,) = store.manifest["dropped_agents"]
    assert absent == {"sequence": "t/s", "agent": "1", "why": "absent at 1 of 5 samples"}


def test_absent_vehicle_makes_the_sequence_faulty(tmp_path: Path) -> None:
    table = tidy(5, 3, "ab")
    absent = (table.sequence == "b") & (table.agent == 1) & (table.time > 0.15)
    store = prepared_table(tmp_path, table[~absent], faults=Faults.keep, fill=0.1)
    assert [s.name for s in store] == ["t/a"]
    assert store.manifest["recordings"]["t"]["faulty"] == {"gap_in_time": 1}


def test_missing_samples_are_filled(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    rows = tidy(100, 4, "01234567", step=1.5)
    rows["x"] += 6 * np.sin(0.5 * rows.time + rows.sequence.astype(int))
    store = prepared_table(tmp_path, rows[rng.random(len(rows)) > 0.02])
    assert len(store) == 8
    filled = store.manifest["filled"]
    assert sum(entry["samples"] for entry in filled) == pytest.approx(0.02 * len(rows), rel=0.3)
    assert {entry["sequence"] for entry in filled} <= {s.name for s in store}
    # a long hole is not filled and divides the platoon
    store = prepared_table(tmp_path, rows[~(rows.time.between(3, 5) & (rows.agent == 1))])
    assert len(store) == 16
    assert store.manifest["filled"] == []
    assert "cut into 2 sequences" in store.manifest["notes"][0]
    assert store.manifest["notes"][3] == "and 5 more such sequences"


def test_vehicles_that_are_never_present_together_are_refused(tmp_path: Path) -> None:
    """The message suggests an option that helps."""
    table = tidy(30, 3).assign(time=lambda t: t.time + 3 * t.agent)
    with pytest.raises(DataError, match=r"data\.fill=SECONDS") as error:
        prepared_table(tmp_path, table)
    assert "faults=keep" not in str(error.value)


def test_renamed_option_of_an_earlier_version(tmp_path: Path) -> None:
    store = prepared_table(tmp_path, tidy(30, 3), fill=0.3)
    manifest = store.folder / "manifest.json"
    assert '"fill": 0.3' in manifest.read_text()
    manifest.write_text(manifest.read_text().replace('"fill": 0.3', '"max_hole": 0.3'))
    options = TableOptions(
        domain="traffic", path=str(tmp_path / "t.csv"), fill=0.3, prepared=str(store.folder)
    )
    assert len(open_data(options, tmp_path / "new")) == 1
    with pytest.raises(ConfigError, match=r"data\.fill=0\.3 then, 0\.1 now"):
        open_data(replace(options, fill=0.1), tmp_path / "new")


def test_noise_is_reported_and_is_not_a_fault(tmp_path: Path) -> None:
    rows = tidy(200, 3, "abcde", step=0.4)
    rows["x"] += 0.3 * np.random.default_rng(5).normal(size=len(rows))
    store = prepared_table(tmp_path, rows)
    # Noise makes steps of -0.5 m frequent at low speed.
    assert len(store) == 5
    noise = store.manifest["noise"]
    assert noise["position"] == pytest.approx(0.3, rel=0.1)
    assert noise["start_speed"] == pytest.approx(0.3 * 2**0.5 / 0.1, rel=0.1)
    smooth = prepared_table(tmp_path, rows, smooth=2.0)
    assert smooth.manifest["noise"]["start_speed"] < 0.2
    assert np.std(smooth[0].x[:, 0, 0] - 4 * smooth[0].time) < 0.15


def test_different_sampling_intervals_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "raw"
    raw(folder, CLEAN, recording="a")
    options = raw(folder, CLEAN, recording="b", time=2 * TIME)
    with pytest.raises(DataError, match=r"a/000 is sampled every 0.2 s, b/000 every 0.4 s"):
        prepare(options, tmp_path / "out")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (EsimasOptions(domain="crowd"), "domain=crowd needs 2-dimensional positions"),
        (EsimasOptions(domain="sea"), "domain=sea: expected traffic or crowd"),
        (DataOptions(), "no reader for DataOptions"),
        (VehicleTableOptions(), "path is not set"),
    ],
)
def test_invalid_options(tmp_path: Path, options: DataOptions, message: str) -> None:
    if isinstance(options, EsimasOptions):
        options = replace(raw(tmp_path / "raw", CLEAN), domain=options.domain)
    with pytest.raises(ConfigError, match=message):
        prepare(options, tmp_path / "out")


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
    for s in clean:  # independent of the checks: no backward step, jump or overlap
        step, gap = np.diff(s.x, axis=0), np.diff(s.x, axis=1)
        assert step.min() > -0.5
        assert step.max() < 12.5
        assert gap.min() >= 2
