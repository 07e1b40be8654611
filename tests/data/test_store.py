"""The prepared data set on disk: exact round trips, streaming, and detection of damage."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import pickle
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nnode.data.sequence import Sequence
from nnode.data.store import MANIFEST, TABLE, Store, write_store
from nnode.errors import DataError
from tests.builders import people


def crowd(name: str, k: int = 5, n: int = 3, seed: int = 0) -> Sequence:
    rng = np.random.default_rng(seed)
    return Sequence(
        name=name,
        recording="corridor",
        time=seed + 0.04 * np.arange(k),
        x=rng.normal(size=(k, n, 2)),
        v=rng.normal(size=(k, n, 2)),
        agents=tuple(f"p{i}" for i in range(n)),
        length=np.where(np.arange(n) % 2, np.nan, 4.5),
        kind=("adult",) * n,
        group=("",) * n,
        destination=rng.normal(size=(n, 2)),
        walls=np.array([[-5.0, 0.0, 5.0, 0.0], [5.0, 4.0, -5.0, 4.0]]),
    )


def minimal(name: str, k: int = 4, n: int = 2) -> Sequence:
    time = 7.04 + 0.2 * np.arange(k)
    x = np.cumsum(np.full((k, n, 1), 1 / 3), axis=0) + 10.0 * np.arange(n)[None, :, None]
    return Sequence(name=name, recording="tunnel", time=time, x=x)


def assert_same(a: Sequence, b: Sequence) -> None:
    """Assert bitwise equality, None and () included."""
    for field in fields(Sequence):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if isinstance(left, np.ndarray):
            assert left.dtype == right.dtype == np.float64
            assert (left.shape, left.tobytes()) == (right.shape, right.tobytes()), field.name
        else:
            assert left == right, field.name


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    items = [crowd("corridor/1", seed=1), crowd("corridor/2", k=7, n=4, seed=2)]
    write_store(tmp_path / "set", items, {"name": "demo"})
    return tmp_path / "set"


def test_round_trip_is_exact(tmp_path: Path) -> None:
    items = [crowd(f"corridor/{i}", k=i, n=1 + i % 3, seed=i) for i in range(1, 8)]
    store = write_store(tmp_path / "a" / "b", iter(items), {"domain": "crowd", "n": 7})
    assert len(store) == 7
    assert store.manifest == {"domain": "crowd", "n": 7}
    for item, result in zip(items, store, strict=True):
        assert_same(item, result)
    assert_same(store[-1], items[-1])
    with pytest.raises(IndexError):
        store[7]


def test_missing_fields_stay_missing(tmp_path: Path) -> None:
    item = minimal("tunnel/1")
    assert_same(write_store(tmp_path, [item], {})[0], item)
    assert item.agents == ()
    assert item.v is item.length is item.kind is item.group is None
    assert item.destination is item.walls is None


@settings(max_examples=25, deadline=None)
@given(
    values=st.lists(
        st.floats(allow_nan=True, allow_infinity=True, width=64), min_size=6, max_size=6
    ),
    name=st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=8),
)
def test_any_float_and_any_name_round_trip(
    tmp_path_factory: pytest.TempPathFactory, values: list[float], name: str
) -> None:
    x = np.array(values).reshape(3, 2, 1)
    item = Sequence(name=name, recording=name, time=np.arange(3.0), x=x, kind=(name, ""))
    store = write_store(tmp_path_factory.mktemp("s"), [item], {})
    assert_same(store[0], item)


def test_table_is_tidy_with_one_row_group_per_sequence(folder: Path) -> None:
    table = pd.read_parquet(folder / TABLE)
    columns = "sequence, recording, time, agent, x, y, vx, vy, length, kind, group, dest_x, dest_y"
    columns += ", preferred_x, preferred_y"
    assert ", ".join(table.columns) == columns
    assert len(table) == 5 * 3 + 7 * 4
    rows = table[(table.sequence == "corridor/2") & (table.agent == "p3")]
    np.testing.assert_array_equal(rows.x, crowd("", k=7, n=4, seed=2).x[:, 3, 0])
    assert pq.ParquetFile(folder / TABLE).num_row_groups == 2


def test_index(folder: Path) -> None:
    assert Store(folder).index[1] == {
        "name": "corridor/2",
        "recording": "corridor",
        "site": "",
        "split": "",
        "n_samples": 7,
        "n_agents": 4,
        "start": 2.0,
        "end": pytest.approx(2.24),
        "agents": ["p0", "p1", "p2", "p3"],
        "walls": 0,
    }


def test_empty_store(tmp_path: Path) -> None:
    store = write_store(tmp_path, [], {"why": "all faulty"})
    assert len(store) == 0
    assert list(store) == []


def test_arrays_and_paths_in_a_manifest(tmp_path: Path) -> None:
    manifest = {"n": np.int64(3), "x": np.array([1.0, 2.0]), "file": Path("a") / "b"}
    store = write_store(tmp_path, [minimal("a")], manifest)
    assert store.manifest == {"n": 3, "x": [1.0, 2.0], "file": str(Path("a") / "b")}


@pytest.mark.parametrize("value", [math.nan, object()])
def test_manifest_that_is_not_json_is_refused(tmp_path: Path, value: object) -> None:
    with pytest.raises(DataError, match="JSON"):
        write_store(tmp_path, [minimal("a")], {"value": value})
    assert list(tmp_path.iterdir()) == []


def test_failed_write_keeps_the_old_store(folder: Path) -> None:
    def failing() -> Iterator[Sequence]:
        yield crowd("new/1")
        raise RuntimeError("reader stopped")

    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    with pytest.raises(RuntimeError, match="reader stopped"):
        write_store(folder, failing(), {})
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    assert len(Store(folder)) == 2


def test_rewriting_replaces_the_store(folder: Path) -> None:
    write_store(folder, [minimal("tunnel/1")], {"name": "other"})
    store = Store(folder)
    assert (len(store), store.dims, store.manifest) == (1, 1, {"name": "other"})
    assert len(store[0].time)
    assert sorted(p.name for p in folder.iterdir()) == [MANIFEST, "sequences-2.parquet"]
    write_store(folder, [minimal("tunnel/2")], {})
    assert sorted(p.name for p in folder.iterdir()) == [MANIFEST, TABLE]


@pytest.mark.parametrize("completed", [0, 1, 2])
def test_interrupted_replacement_leaves_a_complete_store(
    folder: Path, completed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    moves: list[object] = []
    move = os.replace

    def stop(source: Path, target: Path) -> None:
        moves.append(target)
        if len(moves) > completed:
            raise KeyboardInterrupt
        move(source, target)

    monkeypatch.setattr(os, "replace", stop)
    with suppress(KeyboardInterrupt):
        write_store(folder, [minimal("tunnel/1")], {"name": "other"})
    assert len(list(Store(folder))) == (1 if completed == 2 else 2)


def set_manifest(folder: Path, value: object, *keys: str | int) -> None:
    """Set a value of the manifest by its keys."""
    content = part = json.loads((folder / MANIFEST).read_text())
    for key in keys[:-1]:
        part = part[key]
    part[keys[-1]] = value
    (folder / MANIFEST).write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("value", "keys", "message"),
    [
        ([[[10**400, 0, 1, 1]]], ("walls",), "is damaged"),
        # the only file that a manifest may name is its table
        ("../elsewhere.parquet", ("table", "file"), "is damaged"),
        ("/etc/passwd", ("table", "file"), "is damaged"),
        ("manifest.json", ("table", "file"), "is damaged"),
        (3, ("table", "file"), "is damaged"),
        (0.5, ("sequences", 0, "walls"), "the store is damaged"),
        (9, ("sequences", 0, "walls"), "the store is damaged"),
        ("0", ("sequences", 0, "walls"), "the store is damaged"),
        ([0], ("sequences", 0, "walls"), "the store is damaged"),
    ],
)
def test_invalid_manifest_entries(
    folder: Path, value: object, keys: tuple[str | int, ...], message: str
) -> None:
    set_manifest(folder, value, *keys)
    with pytest.raises(DataError, match=message):
        Store(folder)[0]


@pytest.mark.parametrize(
    ("items", "message"),
    [
        ([minimal("a"), minimal("a")], "a cannot be stored: its name is used twice"),
        ([minimal("a"), crowd("b")], "b cannot be stored: it has 2 dimensions, .* before it 1"),
        ([minimal("a", n=0)], "0 agents"),
        ([minimal("a", k=0)], "0 samples"),
        ([people(np.zeros((1, 1, 3)), 0.1)], "3 dim"),
        ([people(np.zeros((1, 1, 2)), 0.1, walls=np.zeros((2, 3)))], r"\(W, 4\)"),
    ],
)
def test_invalid_sequences_are_refused(tmp_path: Path, items: list[Sequence], message: str) -> None:
    with pytest.raises(DataError, match=message):
        write_store(tmp_path, items, {})
    assert list(tmp_path.iterdir()) == []


def test_unwritable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataError, match="cannot be written"):
        write_store(tmp_path / "file" / "set", [minimal("a")], {})


@pytest.mark.parametrize("name", ["", "nowhere"])
def test_folder_without_a_store(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match="holds no prepared data"):
        Store(tmp_path / name)


def test_incomplete_store(folder: Path) -> None:
    (folder / MANIFEST).unlink()
    with pytest.raises(DataError, match="half-written"):
        Store(folder)


def test_missing_or_truncated_table(folder: Path) -> None:
    data = (folder / TABLE).read_bytes()
    (folder / TABLE).write_bytes(data[:-100])
    with pytest.raises(DataError, match=rf"promises {len(data)} bytes, found {len(data) - 100}"):
        Store(folder)
    (folder / TABLE).unlink()
    with pytest.raises(DataError, match="no such file"):
        Store(folder)


def test_table_of_another_data_set(folder: Path) -> None:
    write_store(folder.parent / "other", [crowd("c/1"), crowd("c/2")], {})
    other = (folder.parent / "other" / TABLE).read_bytes()
    (folder / TABLE).write_bytes(other)
    set_manifest(folder, len(other), "table", "bytes")
    with pytest.raises(DataError, match="damaged"):
        Store(folder)[0]


def test_flipped_bits_are_detected(folder: Path) -> None:
    data = bytearray((folder / TABLE).read_bytes())
    reference = list(Store(folder))
    n_detected = 0
    for position in range(4, len(data) // 2, 97):
        damaged = data.copy()
        damaged[position] ^= 0x10
        (folder / TABLE).write_bytes(damaged)
        try:
            result = list(Store(folder))
        except DataError as error:
            assert str(folder / TABLE) in str(error)  # noqa: PT017
            n_detected += 1
        else:  # the byte carries no data
            for a, b in zip(reference, result, strict=True):
                assert_same(a, b)
    assert n_detected > 5


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "damaged"),
        ("[]", "no manifest"),
        ('{"format": "something"}', "no manifest"),
        ('{"format": "nnode sequences", "version": 99}', "format version 99"),
        ('{"format": "nnode sequences", "version": 1}', "damaged"),
        pytest.param("[" * 10**5, "is damaged", id="lists without end"),
        pytest.param('{"a":' * 10**5, "is damaged", id="dicts without end"),
    ],
)
def test_invalid_manifests(folder: Path, content: str, message: str) -> None:
    (folder / MANIFEST).write_text(content)
    with pytest.raises(DataError, match=message):
        Store(folder)


def read_first(store: Store, queue: multiprocessing.SimpleQueue) -> None:
    queue.put(store[0].x.tobytes())


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_store_in_another_process(folder: Path, method: str) -> None:
    store = Store(folder)
    expected = store[0].x.tobytes()  # the table is opened before the other process starts
    context = multiprocessing.get_context(method)
    queue = context.SimpleQueue()
    process = context.Process(target=read_first, args=(store, queue))
    process.start()
    assert queue.get() == expected
    process.join()
    assert process.exitcode == 0
    assert_same(store[1], pickle.loads(pickle.dumps(store))[1])


def test_interpolations_in_options_are_refused(tmp_path: Path) -> None:
    variable = "${oc.env:HOME}"
    for options in ({"path": f"a/{variable}.csv"}, {"columns": {"time": [variable]}}):
        with pytest.raises(DataError, match="is refused: its options hold"):
            write_store(tmp_path, [minimal("a")], {"options": options})
    # elsewhere such text is kept as it is
    store = write_store(tmp_path, [minimal("${a}")], {"options": {"path": "a"}, "note": "${b}"})
    assert (store.manifest["note"], store[0].name) == ("${b}", "${a}")
