"""Reader of pairs: one row per follower, its leader, and time, as car following is published.

A pair is its own little platoon of two, the leader last. Where the source gives the spacing from
bumper to bumper in place of the leader's length, that follows from it and from the positions.
Without positions, these follow from the spacing and the speeds, see :func:`read_pairs`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import MISSING

from nnode.data.cut import (
    Reading,
    chosen_lanes,
    kinds_of,
    members,
    numbered_parts,
    spans,
    uneven_text,
    whole_steps,
    windows,
)
from nnode.data.limits import LIMITS, UNEVEN
from nnode.data.options import DataOptions, chosen, one_of, positive
from nnode.data.readers.columns import ColumnOptions, Table, opened, seconds_per_unit
from nnode.data.readers.recordings import natural, place_below, tables_below
from nnode.data.sequence import LENGTH_UNITS, SPEED_UNITS
from nnode.data.trajectories import (
    Grid,
    Record,
    Trajectories,
    driven,
    group_numbers,
    grouped_rows,
    records,
)
from nnode.errors import ConfigError, DataError

log = logging.getLogger(__name__)

REQUIRED = ("time", "x_follower", "x_leader")
#: What positions follow from where there are none.
INTEGRATED = frozenset({"spacing", "v_follower", "v_leader"})
_SPEEDS = ("v_follower", "v_leader")
_WHO = ("follower", "leader")
#: What belongs to a pair as a whole.
_WORDS = ("pair", "run", "follower", "leader", "lane", "split", "leader_kind", "follower_kind")
OPTIONAL = ("leader_length", "follower_length", "spacing", *_SPEEDS, *_WORDS)

#: Key of the table that lists the files.
INDEX = "index"


class Gaps(str, Enum):
    """What becomes of a record whose equally spaced times have a gap."""

    cut = "cut"
    error = "error"


@dataclass
class PairOptions(ColumnOptions, DataOptions):
    """Pairs of a follower and its leader: one row per pair and time, in one file or many.

    ``columns`` names the tables' columns by what they mean: ``time``, ``x_follower``,
    ``x_leader`` (or, in their place, ``spacing`` and both speeds), and where they exist ``pair``,
    ``v_follower``, ``v_leader``, ``leader_length``,
    ``follower_length``, ``spacing`` (bumper to bumper), ``follower``, ``leader`` (identifiers),
    ``run``, ``lane``, ``split`` (train, test), ``leader_kind``, ``follower_kind``. A column that
    bears the name of its meaning need not be listed; null leaves an optional one out.
    """

    name: str = "pairs"
    domain: str = "traffic"
    path: str = MISSING  # a file, or a folder of files; relative to data.source where that is given
    # patterns of the files of a folder, of which the first that fits any is taken
    files: list[str] = field(default_factory=lambda: ["**/*.csv", "**/*.parquet"])
    # a table in that folder with a row per file: path, and meanings that the files have no columns
    # of; where it is there, no other file is read
    index: str | None = None
    # a regular expression, searched for in a file's path below the folder: its named groups are
    # meanings that the file has no column of
    pattern: str | None = None
    constant: dict[str, str] = field(default_factory=dict)  # {meaning: its value in every row}
    position_unit: Any = "m"  # m | ft | cm | km, or by pattern of the file's name {"*.csv": ft}
    speed_unit: Any = "m/s"  # m/s | km/h | ft/s | mph, or by pattern of the file's name
    # m, of leaders where the table has neither positions nor lengths; the gap does not depend on it
    length: float | None = 5.0
    kinds: Any = field(default_factory=dict)  # {class code: name}
    lane: Any = None  # a lane or a list of lanes; null takes every lane
    dt: float | None = None  # s, grid to interpolate to; null: the times as they are
    gaps: Gaps = Gaps.cut  # what becomes of a gap in the times of a pair
    window: float | None = None  # s, length of a sequence; null: a pair is as long as it is
    min_samples: int = 3  # fewest times of a sequence


def pair_files(options: PairOptions, table: Table | None = None) -> dict[str, Path | Table]:
    """The tables by their path below the folder; a single file by its name; and the index.

    Args:
        table: takes the place of files.

    Raises:
        ConfigError: no path, or ``data.source`` is an address.
        DataError: no such file or folder, one without a table, or an index that names a file that
            is not there.
    """
    if table is not None:
        return {table.path.stem: table}
    place = place_below(options)
    listed = place / options.index if options.index is not None and place.is_dir() else None
    if listed is None or not listed.is_file():
        return {**tables_below(options, options.files)}
    index = Table(listed)
    names = index.names(index.choose(("path",))["path"])
    for i, name in enumerate(names):
        if not (place / name).is_file():
            raise DataError(f"{listed}, {index.row(i)}: there is no file {place / name}")
    return {INDEX: listed, **{name: place / name for name in names}}


def read_pairs(files: Mapping[str, Path | Table], options: PairOptions) -> Reading:
    """Read pairs.

    Without positions, that of the leader's front is the integral of its speed by the trapezium
    rule, from 0 at the pair's first time, and that of the follower's front is the leader's less
    the leader's length and the spacing: the measured spacing is kept exactly. The length is
    ``data.length`` where the table has none.

    Args:
        files: see :func:`pair_files`.
        options: columns, units, time grid, and what becomes of gaps.

    Returns:
        Sequences of two vehicles, follower and leader, named ``run/pair``, with a number behind
        where a pair is cut, in the order of these names. A pair is cut where more than
        ``fill`` s are missing, see :func:`nnode.data.trajectories.records`; a
        row without a position or a speed is one that is missing.
        Speeds are the measured ones where the source has those of both. A pair without a column
        of it is a file; without a run, all are of one recording, which is called like the data. A
        vehicle without an identifier is called after the pair and is in no other one.
        ``left_out`` lists pairs that are too short.

    Raises:
        ConfigError: an option out of its range, an unknown recording or lane.
        DataError: columns or cells that are missing or hold no number (names the row), values
            that change within a pair although they belong to it, a gap in its times where
            ``gaps=error``, or no pair at all.
    """
    _check(options)
    listed = _listed(files.get(INDEX))
    tables = [
        _rows(key, opened(path), options, listed.get(key, {}))
        for key, path in files.items()
        if key != INDEX
    ]
    start = min((origin for origin, _ in tables), default=0)
    pairs: list[tuple[str, str, str, Trajectories]] = [
        (*names, pair)  # type: ignore[misc]
        for origin, rows in tables
        for names, pair in replace(rows, time=rows.time + (origin - start) / 1e9).parts(
            "recording", "sequence", "lane"
        )
    ]
    asked = chosen(options.recording, [run for run, *_ in pairs])
    lanes = chosen_lanes(options.lane, {lane for _, _, lane, _ in pairs}, "the pairs have")
    steps = [rows.dt for *_, rows in pairs if np.isfinite(rows.dt)]
    dt = options.dt or (float(np.median(steps)) if steps else 1.0)
    reading = Reading()
    taken: dict[str, Path] = {}
    every: list[Record] = []
    for run, number, lane, rows in sorted(pairs, key=lambda p: (natural(p[0]), natural(p[1]))):
        if run not in asked or lane not in lanes:
            continue
        name = f"{run}/{number}"
        if name in taken:
            raise DataError(
                f"{rows.path}: pair {number} of run {run} stands in {taken[name]} as well; give "
                "pairs names of their own (data.columns.pair, data.pattern)"
            )
        taken[name] = rows.path
        made, pair_records = by_pair(rows, run, number, dt, options)
        every += pair_records
        reading.add(made)
    if not reading:
        raise DataError(
            f"{options.path}: no sequence; none of {len(pairs)} pairs has "
            f"{options.min_samples} equally spaced times"
            + (f" or lasts for {options.window:g} s" if options.window else "")
            + "; lower data.min_samples or data.window"
        )
    anonymous = sum(
        all(f"{number} {who}" in rows.agent for who in _WHO) for _, number, _, rows in pairs
    )
    if anonymous:
        log.info(
            "%d of %d pairs name neither follower nor leader and are taken as independent of each "
            "other; data.columns.follower and data.columns.leader tell which share a vehicle",
            anonymous,
            len(pairs),
        )
    reading.notes = uneven_text(every, dt)
    return reading


def _check(options: PairOptions) -> None:
    for name in ("dt", "window", "length"):
        if getattr(options, name) is not None:
            positive(name, getattr(options, name))
    if options.min_samples < 2:
        raise ConfigError(f"data.min_samples={options.min_samples}: expected at least 2")
    for option, valid in (("constant", _WORDS), ("columns", (*REQUIRED, *OPTIONAL))):
        for key in getattr(options, option):
            if key not in valid:
                raise ConfigError(f"data.{option}.{key} is unknown; expected {', '.join(valid)}")
    try:
        groups = re.compile(options.pattern or "").groupindex
    except re.error as error:
        raise ConfigError(f"data.pattern={options.pattern}: {error}") from error
    for key in groups:
        if key not in _WORDS:
            raise ConfigError(
                f"data.pattern={options.pattern}: the group {key!r} is unknown; expected "
                f"{', '.join(_WORDS)}"
            )


def _unit(option: str, value: Any, path: Path, units: dict[str, float]) -> float:
    """SI units per unit of a file; a mapping gives the unit by pattern of the file's name."""
    if isinstance(value, str):
        return one_of(option, value, units)
    for pattern, unit in dict(value).items():
        if fnmatch(path.name, pattern):
            return one_of(f"{option}.{pattern}", unit, units)
    raise ConfigError(f"data.{option}={value}: no pattern fits {path.name}")


def _listed(path: Path | Table | None) -> dict[str, dict[str, str]]:
    """Properties of every file that an index lists, by the file's path."""
    if path is None:
        return {}
    table = opened(path)
    names = table.choose(("path",), _WORDS)
    cells = {name: table.names(column, empty=True) for name, column in names.items()}
    files = cells.pop("path")
    return {
        str(file): {name: str(values[i]) for name, values in cells.items() if values[i]}
        for i, file in enumerate(files)
    }


def _rows(
    key: str, table: Table, options: PairOptions, listed: dict[str, str]
) -> tuple[int, Trajectories]:
    """The rows of a file's followers and then those of their leaders; times count from an origin
    (ns)."""
    names, integrated = _columns(table, options)
    metres = _unit("position_unit", options.position_unit, table.path, LENGTH_UNITS)
    speeds = _unit("speed_unit", options.speed_unit, table.path, SPEED_UNITS)
    origin, time = table.times(names["time"], seconds_per_unit(options))
    x, v = np.full((len(table), 2), np.nan), None
    if not integrated:
        x = np.stack([table.measured(names[n]) for n in ("x_follower", "x_leader")], -1) * metres
    if all(name in names for name in _SPEEDS):
        speed = table.numbers if integrated else table.measured
        v = np.stack([speed(names[name]) for name in _SPEEDS], -1) * speeds
    words = _words(key, table, names, options, listed)

    def lengths(name: str) -> np.ndarray:
        if name in names:
            return table.positive(names[name]) * metres
        return np.full(len(table), np.nan)

    leader, spacing = lengths("leader_length"), np.full(len(table), np.nan)
    if "spacing" in names:
        spacing = table.numbers(names["spacing"], empty=not integrated) * metres
    for rows in grouped_rows(words["run"], words["pair"], time=time):
        length = float(leader[rows[0]])
        if integrated:
            assert v is not None
            length = float(options.length or np.nan) if np.isnan(length) else length
            front = driven(time[rows], v[rows, 1])
            x[rows] = np.stack([front - np.nan_to_num(length) - spacing[rows], front], -1)
        elif "leader_length" not in names:
            length = _leader(table, x[rows, 1] - x[rows, 0] - spacing[rows], rows)
        leader[rows] = length
    none = np.full(len(table), "", dtype=object)
    codes = np.concatenate([words.get(f"{who}_kind", none) for who in _WHO])
    identifiers = np.concatenate([words.get(who, none) for who in _WHO])
    # one without an identifier is in no other pair
    anonymous = np.concatenate([words["pair"] + f" {who}" for who in _WHO])
    columns = {"recording": "run", "sequence": "pair", "lane": "lane", "split": "split"}
    return origin, Trajectories(
        path=table.path,
        name=options.name,
        where=lambda i: table.row(i % len(table)),
        agent=np.where(identifiers == "", anonymous, identifiers),
        time=np.tile(time, 2),
        x=x.T.reshape(-1, 1),
        v=None if v is None else v.T.reshape(-1, 1),
        length=np.concatenate([lengths("follower_length"), leader]),
        kind=kinds_of(codes, options.kinds) if any(codes) else None,
        **{field: np.tile(words[n], 2) for field, n in columns.items() if n in words},
    )


def _columns(table: Table, options: PairOptions) -> tuple[dict[str, str], bool]:
    """Columns by meaning, and whether positions are to be integrated."""
    places = REQUIRED[1:]
    names = table.choose(REQUIRED[:1], (*places, *OPTIONAL), options.columns)
    if set(names) >= INTEGRATED and not any(place in names for place in places):
        return names, True
    try:
        return table.choose(REQUIRED, OPTIONAL, options.columns), False
    except DataError as error:
        raise DataError(
            f"{error}; without positions, spacing, v_follower and v_leader are needed, from which "
            "positions are integrated"
        ) from error


def _words(
    key: str, table: Table, names: dict[str, str], options: PairOptions, listed: dict[str, str]
) -> dict[str, np.ndarray]:
    """``(R,)`` what belongs to pairs as a whole: from columns, else the same in all rows of a
    file, as set by hand, by the index, by its path."""
    words = {n: table.names(names[n], empty=True) for n in _WORDS if n in names}
    said = {"run": options.name, "pair": table.path.stem}
    said |= {str(name): str(value) for name, value in options.constant.items()}
    said |= listed
    if options.pattern is not None:
        lacking = sorted(set(re.compile(options.pattern).groupindex) - set(words))
        match = re.search(options.pattern, key)
        if match is not None:
            said |= {name: value for name, value in match.groupdict().items() if value}
        elif lacking:
            raise DataError(
                f"{table.path}: its path {key!r} does not fit data.pattern={options.pattern}, and "
                f"the file has no columns {', '.join(lacking)}"
            )
    words = {n: np.full(len(table), value, dtype=object) for n, value in said.items()} | words
    pair = group_numbers(words["run"], words["pair"])
    rule = (
        "it belongs to the pair and must be the same in all its rows: name pairs that are to be "
        "told apart (data.columns.pair)"
    )
    for name in (word for word in _WORDS if word in names):
        table.check_constant(names[name], words[name], pair, rule)
    return words


def _leader(table: Table, length: np.ndarray, rows: np.ndarray) -> float:
    """The leader's length (m): what is left of the distance without the spacing.

    Args:
        length: ``(K,)`` m by the row, NaN where it is unknown.
    """
    if np.isnan(length).all():
        return float("nan")
    usual = float(np.nanmedian(length))
    off = np.abs(length - usual)
    i = np.nanargmax(off)
    if off[i] > LIMITS["traffic"].noise:
        raise DataError(
            f"{table.path}, {table.row(int(rows[i]))}: x_leader - x_follower - spacing is "
            f"{length[i]:.2f} m, {usual:.2f} m in other rows of the pair; expected "
            "one length of the leader: leave out data.columns.spacing and give leader_length"
        )
    if usual <= 0:
        raise DataError(
            f"{table.path}, {table.row(int(rows[0]))}: x_leader - x_follower - spacing, the "
            f"leader's length, is {usual:.2f} m; expected a positive number, as the spacing is "
            "bumper to bumper and positions are fronts: leave it out with "
            "data.columns.spacing=null, or correct it"
        )
    return usual


def by_pair(
    rows: Trajectories, run: str, number: str, dt: float, options: PairOptions
) -> tuple[Reading, list[Record]]:
    """Cut a pair where either is not there, or into windows without such a gap.

    Args:
        rows: of one pair, the follower's and then as many of the leader's.
        run, number: names of the recording and of the pair.
        dt: s, of the time grid; it begins at 0 where ``options.dt`` says it, otherwise with the
            pair.

    Returns:
        Sequences named ``recording/sequence``, with a number behind where there are several, and
        both records.

    Raises:
        ConfigError: a ``dt`` finer than the rows, or a ``window`` that is no whole number of steps.
        DataError: a gap, where ``gaps=error``; or one agent twice at one time.
    """
    name = f"{run}/{number}"
    if options.dt is not None and dt < rows.dt * (1 - UNEVEN):
        raise ConfigError(
            f"data.dt={dt:g} s is finer than the {rows.dt:g} s of {rows.path}: pair {number}; "
            "expected no more times than were measured"
        )
    grid = Grid(dt, 0.0 if options.dt is not None else float(rows.time.min()))
    pair_records = records(rows, grid, fill=options.fill, smoothing=options.smooth)
    vehicles = sorted(members(rows, pair_records), key=lambda member: member.row)
    parts = spans(vehicles)
    if len(parts) > 1 and options.gaps is Gaps.error:
        end, start = (grid.origin + dt * k for k in (parts[0][1], parts[1][0]))
        row = int(np.argmin(np.where(rows.time >= start - dt / 2, rows.time, np.inf)))
        raise DataError(
            f"{rows.path}: pair {number} steps from {end:g} s to {start:g} s "
            f"({rows.where(row)}), expected steps of {dt:g} s ({len(parts) - 1} such gaps); "
            "data.gaps=cut cuts the pair there"
        )
    if options.window is not None:
        steps = whole_steps("window", options.window, dt)
        parts = [piece for part in parts for piece in windows(*part, steps)]
    parts = [(a, b) for a, b in parts if b - a + 1 >= options.min_samples]
    made = Reading(numbered_parts(name, rows, [vehicles] * len(parts), parts, grid, recording=run))
    if not made:
        times = f"data.min_samples={options.min_samples} times"
        if len(rows) // 2 < options.min_samples:
            why = f"fewer than {times}"
        elif options.window is not None:
            why = f"no data.window={options.window:g} s without a gap"
        else:
            why = f"no {times} without a gap"
        made.left_out.append({"name": name, "why": why})
    return made, pair_records
