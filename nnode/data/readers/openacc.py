"""Reader of OpenACC's campaigns on test tracks: platoons with and without adaptive cruise control.

Two layouts are read: the published files of the ZalaZONE campaign (five lines about the run, then
speeds, coordinates and gaps, a column per vehicle), and a table of one row per vehicle and time
(run, position, t, v, gap), as the AstaZero campaign is kept.

Source: Makridis, Mattas, Anesiadou & Ciuffo 2021, OpenACC, Transportation Research Part C 125,
103047.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from nnode.data.options import OpenAccOptions, check_known, one_of, positive, wanted
from nnode.data.readers.columns import Table
from nnode.data.readers.recordings import raw_files, tables_below
from nnode.data.readers.track import KNOWN, Run, check_laps, cut_run
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError, DataError

#: The five lines above the columns.
HEAD = ("Date", "Vehicle_order", "Number_of_vehicles", "ACC", "Distance_setting")

#: Times of a run, with those that no row stands for.
MOST_TIMES = 10**6

#: Places in a platoon; its vehicles are tens.
MOST_VEHICLES = 1000

#: Times and places of a run may be so many, or so many times the rows that stand there.
_CELLS, _SPARSE = 10**7, 10

_FLAT = ("run", "position", "t", "v", "gap")


def openacc_files(options: OpenAccOptions) -> dict[str, Path]:
    """The files of the runs: those of ``data.path``, else the published ones.

    Raises:
        ConfigError, DataError, DownloadError: see
            :func:`nnode.data.readers.recordings.tables_below` and ``raw_files``.
    """
    if options.path is not None:
        return tables_below(options, options.path, options.files)
    return raw_files(
        options,
        default="openacc",
        pattern=re.compile(r"(.+)\.csv"),
        file_name=lambda name: f"{name}.csv",
    )


def read_openacc(files: Mapping[str, Path], options: OpenAccOptions) -> list[Sequence]:
    """Read runs and cut them into sequences.

    Where a vehicle's record has a hole longer than ``fill``, or a vehicle has no columns, the
    platoon is cut in two at its place, so that nobody follows a vehicle that is not its leader.
    Gaps that are not above 0, and those that jump, count as holes (``max_error``).

    Args:
        files: see :func:`openacc_files`.
        options: what is told of vehicles, time grid and the way of cutting.

    Returns:
        Sequences named ``run/number``, with measured speeds. Vehicles are called ``make``, with
        their place in the platoon behind where there are two of a make.

    Raises:
        ConfigError: an option out of its range, or an unknown run.
        DataError: a file of another layout, cells that hold no number (names the row), unequal
            times, or no sequence at all.
    """
    _check(options)
    runs = [run for key, path in files.items() for run in _runs(key, path)]
    asked = wanted(options.recording)
    if asked is not None and options.path is not None:
        check_known(asked, [run.name for run in runs])
        runs = [run for run in runs if run.name in asked]
    found: list[Sequence] = []
    for run in runs:
        check_laps(run)
        found += cut_run(run, options)
    if not found:
        raise DataError(
            f"{next(iter(files.values()))}: no sequence; in {len(runs)} runs there are nowhere "
            f"{options.min_vehicles} vehicles behind each other for "
            f"{options.window or options.min_duration:g} s; lower data.min_vehicles and "
            f"data.{'window' if options.window else 'min_duration'}"
        )
    return found


def _check(options: OpenAccOptions) -> None:
    for name in ("dt", "window", "length", "max_error"):
        if getattr(options, name) is not None:
            positive(name, getattr(options, name))
    positive("fill", options.fill)
    positive("min_duration", options.min_duration)
    for name in ("kind", "group"):
        if getattr(options, name) is not None:
            one_of(name, getattr(options, name), dict.fromkeys(KNOWN, 0.0))
    if options.min_vehicles < 1:
        raise ConfigError("data.min_vehicles must be at least 1")


def _runs(key: str, path: Path) -> Iterator[Run]:
    name = re.sub(r"\.[^./]*$", "", key).replace("/", "_")
    first = ""
    if path.suffix.lower() not in (".parquet", ".pq") and path.is_file():
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            first = file.readline()
    if first.startswith(HEAD[0] + ","):
        yield _published_run(name, path)
    else:
        yield from _flat_runs(path)


def _published_run(name: str, path: Path) -> Run:
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        head = [file.readline().strip().rstrip(",").split(",") for _ in HEAD]
    for number, (cells, expected) in enumerate(zip(head, HEAD, strict=True), start=1):
        if cells[0] != expected:
            raise DataError(f"{path}, line {number}: expected {expected},…, found {cells[0]!r}")
    make = tuple(cell.strip() for cell in head[1][1:])
    said = head[2][1] if len(head[2]) > 1 else ""
    if said != str(len(make)):
        raise DataError(
            f"{path}, line 3: {said or 'no number of'} vehicles, but line 2 has the order of "
            f"{len(make)}: correct either"
        )
    table = Table(path, skiprows=len(HEAD))
    table.choose(("Time",))
    held, n = set(table.frame.columns), len(make)

    def column(word: str, i: int) -> np.ndarray:
        name = f"{word}{i + 1}"
        return table.numbers(name, empty=True) if name in held else np.full(len(table), np.nan)

    nowhere = np.full(len(table), np.nan)
    v = np.stack([column("Speed", i) for i in range(n)], 1)
    gap = np.stack([nowhere, *(column("IVS", i) for i in range(n - 1))], 1)
    place = np.stack([np.stack([column(w, i) for i in range(n)], 1) for w in ("E", "N")], -1)
    acc = len(head[3]) > 1 and head[3][1] == "1"
    setting = head[4][1] if acc and len(head[4]) > 1 and head[4][1] else "none"
    start, dt, (v, gap, place) = _gridded(path, table.numbers("Time"), v, gap, place)
    return Run(name, path, start, dt, v, gap, place, make, acc, setting)


def _flat_runs(path: Path) -> Iterator[Run]:
    table = Table(path)
    names = table.choose(_FLAT, ("make", "acc", "setting"))
    run, position = table.names("run"), _positions(table)
    time, v, gap = (
        table.numbers("t"),
        table.numbers("v", empty=True),
        table.numbers("gap", empty=True),
    )
    words = {n: table.names(n, empty=True) for n in ("make", "acc", "setting") if n in names}
    for name in dict.fromkeys(run):
        own = np.flatnonzero(run == name)
        times, k = np.unique(np.round(time[own], 6), return_inverse=True)
        order, i = np.unique(position[own], return_inverse=True)
        # a vehicle without a row has its place in the platoon all the same
        shape = (len(times), int(order[-1]))
        _check_size(path, shape, len(own))
        place_of = order[i] - 1
        wide = {w: np.full(shape, np.nan) for w in ("v", "gap")}
        count = np.zeros(shape, int)
        np.add.at(count, (k, place_of), 1)
        if count.max() > 1:
            raise DataError(
                f"{path}: run {name} has two rows of one position at one time; expected one row "
                "per vehicle and time"
            )
        wide["v"][k, place_of], wide["gap"][k, place_of] = v[own], gap[own]
        make = [str(p + 1) for p in range(shape[1])]
        for row, p in zip(own, place_of, strict=True):
            if "make" in words:
                make[p] = words["make"][row]
        acc = "acc" not in words or words["acc"][own[0]].lower() in ("true", "1")
        setting = words["setting"][own[0]] if "setting" in words and acc else "none"
        nowhere = np.full((*shape, 2), np.nan)
        start, dt, (sv, sg, sp) = _gridded(path, times, wide["v"], wide["gap"], nowhere)
        yield Run(str(name), path, start, dt, sv, sg, sp, tuple(make), acc, setting or "none")


def _positions(table: Table) -> np.ndarray:
    """Places in the platoon, counted from 1."""
    found = table.numbers("position")
    odd = np.flatnonzero(~((found >= 1) & (found <= MOST_VEHICLES) & (found % 1 == 0)))
    if odd.size:
        i = int(odd[0])
        raise DataError(
            f"{table.path}, {table.row(i)}: position is {found[i]:g}; expected the place in the "
            f"platoon, a whole number from 1 to {MOST_VEHICLES}"
        )
    return found.astype(int)


def _check_size(path: Path, shape: tuple[int, int], rows: int) -> None:
    """Refuse a time or a position that is wrong before a table is made for it."""
    if shape[0] * shape[1] > max(_CELLS, _SPARSE * rows):
        raise DataError(
            f"{path}: {rows} rows stand at {shape[0]} equally spaced times of {shape[1]} vehicles; "
            "look for a time or a position that is wrong, or cut the file"
        )


def _gridded(
    path: Path, time: np.ndarray, *columns: np.ndarray
) -> tuple[float, float, list[np.ndarray]]:
    """Rows at all equally spaced times, NaN where the file has none."""
    step = np.diff(time)
    if not len(step) or step.min() <= 0:
        i = int(np.argmin(step)) if len(step) else 0
        raise DataError(f"{path}: times do not grow from {time[i]:g} s on; expected rows in order")
    dt = float(np.median(step))
    if not (time[-1] - time[0]) / dt < MOST_TIMES:
        raise DataError(
            f"{path}: times go from {time[0]:g} to {time[-1]:g} s in steps of {dt:g} s; expected "
            f"at most {MOST_TIMES:.0e} steps: look for a time that is wrong"
        )
    at = (time - time[0]) / dt
    k = np.round(at).astype(int)
    odd = np.flatnonzero(np.abs(at - k) > 0.1)
    if odd.size or (np.diff(k) == 0).any():
        i = int(odd[0]) if odd.size else int(np.argmin(np.diff(k)))
        raise DataError(
            f"{path}: the time {time[i]:g} s is no whole number of steps of {dt:g} s from the "
            f"first, {time[0]:g} s"
        )
    _check_size(path, (int(k[-1]) + 1, columns[0].shape[1]), columns[0].size)
    full = [np.full((k[-1] + 1, *c.shape[1:]), np.nan) for c in columns]
    for wide, column in zip(full, columns, strict=True):
        wide[k] = column
    return float(time[0]), round(dt, 9), full
