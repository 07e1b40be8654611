"""The prepared data set on disk: one tidy Parquet table and one manifest.

``sequences.parquet`` has one row per sequence, sampling time and agent, in SI units, and one row
group per sequence, so that any sequence is read without the others. ``manifest.json`` holds what
the preparation wants to be remembered, and an index of the sequences. It is written last:
a folder without it is the remainder of an interrupted preparation.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nnode.data._arrow import open_writer, to_sequence, to_table
from nnode.data.clusters import index_of
from nnode.data.sequence import Sequence
from nnode.errors import DataError
from nnode.files import interpolation, replacing

TABLE = "sequences.parquet"
#: A store that replaces another one has the name that the other has not.
_TABLES = (TABLE, "sequences-2.parquet")
MANIFEST = "manifest.json"
FORMAT = "nnode sequences"
VERSION = 1


class Store:
    """A prepared data set, read one sequence at a time.

    The table is opened on first use, once per process, so that a store may be pickled and handed
    to the workers of a data loader, forked or spawned.

    Attributes:
        folder: where the data set lies.
        manifest: what the preparation recorded, as it was given to :func:`write_store`.
        index: per sequence a dict with ``name``, ``recording``, ``n_samples``, ``n_agents``,
            ``start`` and ``end`` (s), ``agents`` (identifiers, empty where unknown),
            ``split`` (side of the published division) and ``walls`` (position in the list of
            distinct walls, or None).
        dims: D, the number of space dimensions; 0 for an empty store.

    Raises:
        DataError: no store, a half-written or damaged one, or one of another format version.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        content = _read_manifest(self.folder)
        try:
            self.manifest: dict[str, Any] = dict(content["manifest"])
            self.index: list[dict[str, Any]] = content["sequences"]
            self.dims = int(content["dims"])
            self._bytes = int(content["table"]["bytes"])
            self._path = self.folder / _TABLES[_TABLES.index(content["table"]["file"])]
            self._walls = [np.asarray(w, float).reshape(-1, 4) for w in content["walls"]]
            placeholder = interpolation(self.manifest.get("options"))
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            raise DataError(
                f"{self.folder / MANIFEST} is damaged ({type(error).__name__}: {error}); "
                "prepare the data again"
            ) from error
        if placeholder is not None:
            raise DataError(
                f"{self.folder / MANIFEST} is refused: its options hold {placeholder[:80]!r}, and "
                "${...} stands for values of this machine, such as its environment; prepare the "
                "data again, from names without ${"
            )
        path = self._path
        size = path.stat().st_size if path.is_file() else None
        if size != self._bytes:
            held = "no such file" if size is None else f"{size} bytes"
            raise DataError(
                f"{path}: the manifest promises {self._bytes} bytes, found {held}; the store is "
                "half-written or damaged: prepare the data again"
            )
        self._file: pq.ParquetFile | None = None
        self._pid: int | None = None

    def __len__(self) -> int:
        return len(self.index)

    def __iter__(self) -> Iterator[Sequence]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> Sequence:
        """Read sequence ``i`` (negative counts from the end) from the disk."""
        if not -len(self) <= i < len(self):
            raise IndexError(f"sequence {i} of a store with {len(self)} sequences")
        i %= len(self)
        with self._damage(i):
            table = self._open().read_row_group(i, use_threads=False)
            entry = self.index[i]
            walls = None if entry["walls"] is None else self._walls[entry["walls"]].copy()
            return to_sequence(table, entry, walls)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None, "_pid": None}

    def _open(self) -> pq.ParquetFile:
        # An open file must not cross a fork: parent and child would share its position.
        if self._file is None or self._pid != os.getpid():
            file = pq.ParquetFile(self._path, page_checksum_verification=True)
            if file.num_row_groups != len(self):
                raise ValueError(f"{file.num_row_groups} row groups for {len(self)} sequences")
            self._file, self._pid = file, os.getpid()
        return self._file

    @contextmanager
    def _damage(self, i: int) -> Iterator[None]:
        try:
            yield
        except (
            pa.ArrowException,
            OSError,
            LookupError,
            ValueError,
            TypeError,
            OverflowError,
        ) as error:
            raise DataError(
                f"{self._path}: sequence {i} ({self.index[i]!s:.80}) cannot be "
                f"read: {error}; the store is damaged: prepare the data again"
            ) from error


def write_store(
    folder: Path | str, sequences: Iterable[Sequence], manifest: Mapping[str, Any]
) -> Store:
    """Write a data set, one sequence at a time, replacing the one in ``folder``.

    At every moment the folder holds the whole store of before or the whole new one: the table
    takes the name that the manifest of before does not speak of, and the manifest follows it.

    Args:
        folder: created where it is missing.
        sequences: of one number of dimensions, with unique names. An empty ``kind`` or
            ``group`` is stored as None.
        manifest: anything that JSON can hold; read again as :attr:`Store.manifest`.

    Returns:
        The store, opened.

    Raises:
        DataError: sequences that do not belong into one data set, or that have no sample or
            no agent; a manifest that JSON cannot hold; a folder that cannot be written.
    """
    folder = Path(folder)
    try:
        name, before = _free_name(folder)
        # the table, which is the inner one, takes its place first
        with (
            replacing(folder / MANIFEST) as manifest_file,
            replacing(folder / name) as table_file,
        ):
            content = _write_table(table_file, sequences)
            content["table"]["file"] = name
            _write_json(manifest_file, {**content, "manifest": dict(manifest)})
        (folder / before).unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f"the store {folder} cannot be written: {error}") from error
    return Store(folder)


def _free_name(folder: Path) -> tuple[str, str]:
    """The table's name that the present manifest does not speak of, and the other one."""
    try:
        used = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))["table"]["file"]
    except (OSError, ValueError, KeyError, TypeError):
        used = _TABLES[1]
    return _TABLES if used != TABLE else (_TABLES[1], _TABLES[0])


def _write_table(path: Path, sequences: Iterable[Sequence]) -> dict[str, Any]:
    """Write the Parquet table; returns the manifest's part that describes it."""
    index: list[dict[str, Any]] = []
    walls: list[np.ndarray] = []
    names: set[str] = set()
    dims = 0
    with ExitStack() as stack:
        for item in sequences:
            _check(item, dims, names)
            if not index:
                dims = item.x.shape[2]
                writer = stack.enter_context(open_writer(path, dims))
            names.add(item.name)
            table = to_table(item)
            writer.write_table(table, row_group_size=table.num_rows)
            index.append(_entry(item, walls))
        if not index:
            stack.enter_context(open_writer(path, dims))
    return {
        "format": FORMAT,
        "version": VERSION,
        "dims": dims,
        "table": {"file": TABLE, "bytes": path.stat().st_size},
        "walls": [w.tolist() for w in walls],
        "sequences": index,
    }


def _entry(item: Sequence, walls: list[np.ndarray]) -> dict[str, Any]:
    number: int | None = None
    if item.walls is not None:
        segments = np.asarray(item.walls, dtype=np.float64)
        number = next(
            (i for i, w in enumerate(walls) if w.tobytes() == segments.tobytes()), len(walls)
        )
        if number == len(walls):
            walls.append(segments)
    (entry,) = index_of([item])
    return entry | {"n_samples": item.n_samples, "n_agents": item.n_agents, "walls": number}


def _check(item: Sequence, dims: int, names: set[str]) -> None:
    fault = None
    if item.name in names:
        fault = "its name is used twice; names must be unique within a data set"
    elif not item.n_samples or not item.n_agents:
        fault = f"it has {item.n_samples} samples of {item.n_agents} agents, expected some"
    elif item.x.shape[2] not in (1, 2):
        fault = f"it has {item.x.shape[2]} dimensions, expected 1 or 2"
    elif dims and item.x.shape[2] != dims:
        fault = f"it has {item.x.shape[2]} dimensions, the sequences before it {dims}"
    elif item.walls is not None:
        walls = np.asarray(item.walls, dtype=np.float64)
        if walls.ndim != 2 or walls.shape[1] != 4 or not np.isfinite(walls).all():
            fault = f"its walls must be finite (W, 4) segments, got shape {walls.shape}"
    if fault:
        raise DataError(f"sequence {item.name} cannot be stored: {fault}")


def _plain(value: Any) -> Any:
    """What JSON takes for a value that it does not know."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{value!r} of type {type(value).__name__}")


def _write_json(path: Path, content: dict[str, Any]) -> None:
    try:
        text = json.dumps(content, indent=1, default=_plain, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"the manifest of {path.parent} holds what JSON cannot: {error}; give it finite "
            "numbers, texts, lists and dicts"
        ) from error
    path.write_text(text + "\n", encoding="utf-8")


def _read_manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    if not path.is_file():
        if any((folder / name).exists() for name in _TABLES) or any(folder.glob(".*.partial")):
            raise DataError(
                f"{folder} holds a half-written store ({MANIFEST} is missing): its preparation "
                "was interrupted; prepare the data again"
            )
        raise DataError(f"{folder} holds no prepared data: expected {MANIFEST} and {TABLE} in it")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is damaged: {error}; prepare the data again") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise DataError(f"{path} is no manifest of {FORMAT!r}; name a folder of prepared data")
    if content.get("version") != VERSION:
        raise DataError(
            f"{path} has format version {content.get('version')!r}, this package reads version "
            f"{VERSION}; prepare the data again"
        )
    return content
