"""Reader of pairs: one row per follower, its leader, and time, as car following is published.

A pair is its own little platoon of two, the leader last. Where the source gives the spacing from
bumper to bumper in place of the leader's length, that follows from it and from the positions.
Without positions, these follow from the spacing and the speeds, see :func:`read_pairs`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from nnode.data.cut import (
    Member,
    Reading,
    chosen_lanes,
    sequence_of,
    spans,
    told_uneven,
    whole_steps,
    windows,
)
from nnode.data.options import Gaps, PairOptions, check_known, one_of, positive, wanted
from nnode.data.readers.columns import Table, opened
from nnode.data.readers.recordings import natural, place_below, tables_below
from nnode.data.readers.vehicles import LENGTH_UNITS, SPEED_UNITS, seconds_per_unit
from nnode.data.sequence import Sequence
from nnode.data.trajectories import (
    UNEVEN,
    Grid,
    Record,
    Trajectories,
    driven,
    measured_times,
    records,
)
from nnode.errors import ConfigError, DataError

log = logging.getLogger(__name__)

REQUIRED = ("time", "x_follower", "x_leader")
#: What positions follow from where there are none.
INTEGRATED = frozenset({"spacing", "v_follower", "v_leader"})
_METRES = ("leader_length", "follower_length", "spacing")
_SPEEDS = ("v_follower", "v_leader")
_WHO = ("follower", "leader")
#: What belongs to a pair as a whole.
_WORDS = ("pair", "run", "follower", "leader", "lane", "split", "leader_kind", "follower_kind")
OPTIONAL = (*_METRES, *_SPEEDS, *_WORDS)

#: Key of the table that lists the files.
INDEX = "index"

#: m by which a length that follows from spacings may vary within a pair: the error that a single
#: position may have without being a fault (:mod:`nnode.data.quality`).
UNSTEADY = 0.5


@dataclass(frozen=True)
class _Pair:
    """A pair's rows in one file, follower and leader, and what belongs to it as a whole.

    Its times count from ``origin`` (ns).
    """

    words: dict[str, str]
    origin: int
    rows: Trajectories


def pair_files(options: PairOptions) -> dict[str, Path]:
    """The tables by their path below the folder; a single file by its name; and the index.

    Raises:
        ConfigError: no path, or ``data.source`` is an address.
        DataError: no such file or folder, one without a table, or an index that names a file that
            is not there.
    """
    place = place_below(options, options.path)
    listed = place / options.index if options.index is not None and place.is_dir() else None
    if listed is None or not listed.is_file():
        return tables_below(options, options.path, options.files)
    table = Table(listed)
    files = {INDEX: listed}
    for i, name in enumerate(table.names(table.choose(("path",))["path"])):
        files[name] = place / name
        if not files[name].is_file():
            raise DataError(f"{listed}, {table.row(i)}: there is no file {files[name]}")
    return files


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
        ``left_out`` tells of pairs that are too short.

    Raises:
        ConfigError: an option out of its range, an unknown recording or lane.
        DataError: columns or cells that are missing or hold no number (names the row), values
            that change within a pair although they belong to it, a gap in its times where
            ``gaps=error``, or no pair at all.
    """
    _check(options)
    asked = wanted(options.recording)
    listed = _listed(files.get(INDEX))
    pairs = [
        pair
        for key, path in files.items()
        if key != INDEX
        for pair in _pairs(key, opened(path), options, listed.get(key, {}))
    ]
    if asked is not None:
        check_known(asked, [pair.words["run"] for pair in pairs])
    lanes = _lanes(options, pairs)
    start = min((pair.origin for pair in pairs), default=0)
    dt = options.dt or _usual([pair.rows for pair in pairs])
    found: list[Sequence] = []
    taken: dict[str, Path] = {}
    short: list[dict[str, str]] = []
    every: list[Record] = []
    for pair in sorted(pairs, key=lambda p: (natural(p.words["run"]), natural(p.words["pair"]))):
        run, lane = pair.words["run"], pair.words.get("lane", "")
        if (asked is not None and run not in asked) or (lanes and lane not in lanes):
            continue
        name = f"{run}/{pair.words['pair']}"
        if name in taken:
            raise DataError(
                f"{pair.rows.path}: pair {pair.words['pair']} of run {run} stands in {taken[name]} "
                "as well; give pairs names of their own (data.columns.pair, data.pattern)"
            )
        taken[name] = pair.rows.path
        late = (pair.origin - start) / 1e9
        rows = replace(pair.rows, time=pair.rows.time + late)
        made, own = _sequences(name, rows, pair.words, dt, options)
        every += own
        if not made:
            short.append({"name": name, "why": _too_short(rows, options)})
        found += made
    if not found:
        raise DataError(
            f"{options.path}: no sequence; none of {len(pairs)} pairs has "
            f"{options.min_samples} equally spaced times"
            + (f" or lasts for {options.window:g} s" if options.window else "")
            + "; lower data.min_samples or data.window"
        )
    anonymous = sum(not (p.words.get("follower") or p.words.get("leader")) for p in pairs)
    if anonymous:
        log.info(
            "%d of %d pairs name neither follower nor leader and are taken as independent of each "
            "other; data.columns.follower and data.columns.leader tell which share a vehicle",
            anonymous,
            len(pairs),
        )
    return Reading(found, short, told_uneven(every, dt))


def _usual(tables: list[Trajectories]) -> float:
    """The sampling interval (s) of most pairs."""
    steps = [table.dt for table in tables if np.isfinite(table.dt)]
    return float(np.median(steps)) if steps else 1.0


def _check(options: PairOptions) -> None:
    for name in ("dt", "window", "length"):
        if getattr(options, name) is not None:
            positive(name, getattr(options, name))
    if options.min_samples < 2:
        raise ConfigError(f"data.min_samples={options.min_samples}: expected at least 2")
    for option, known in (("constant", _WORDS), ("columns", (*REQUIRED, *OPTIONAL))):
        for key in getattr(options, option):
            if key not in known:
                raise ConfigError(f"data.{option}.{key} is unknown; expected {', '.join(known)}")
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
    """What an index tells of every file, by the file's path."""
    if path is None:
        return {}
    table = opened(path)
    names = table.choose(("path",), _WORDS)
    cells = {name: table.names(column, empty=True) for name, column in names.items()}
    files = cells.pop("path")
    return {
        str(file): {name: str(own[i]) for name, own in cells.items() if own[i]}
        for i, file in enumerate(files)
    }


def _pairs(key: str, table: Table, options: PairOptions, listed: dict[str, str]) -> Iterator[_Pair]:
    names, integrated = _columns(table, options)
    metres = _unit("position_unit", options.position_unit, table.path, LENGTH_UNITS)
    speeds = _unit("speed_unit", options.speed_unit, table.path, SPEED_UNITS)
    origin, time = table.times(names["time"], seconds_per_unit(options))
    x = v = None
    if not integrated:
        x = np.stack([table.measured(names[n]) for n in ("x_follower", "x_leader")], -1) * metres
    if all(name in names for name in _SPEEDS):
        speed = table.numbers if integrated else table.measured
        v = np.stack([speed(names[name]) for name in _SPEEDS], -1) * speeds
    own = {n: table.positive(names[n]) * metres for n in _METRES[:2] if n in names}
    if "spacing" in names:
        own["spacing"] = table.numbers(names["spacing"], empty=not integrated) * metres
    words = {n: table.names(names[n], empty=True) for n in _WORDS if n in names}
    everywhere = _everywhere(key, table.path, options, listed, set(words))
    label = np.array(["\0".join(cells) for cells in zip(*_keys(words), strict=True)], dtype=object)
    codes = np.unique(label, return_inverse=True)[1] if len(label) else np.zeros(len(table), int)
    first = [int(np.flatnonzero(codes == code)[0]) for code in range(codes.max() + 1)]
    for code in np.argsort(first):
        rows = np.flatnonzero(codes == code)
        rows = rows[np.argsort(time[rows], kind="stable")]
        said = dict(everywhere)
        for name, cells in words.items():
            _steady(table, names[name], cells, rows)
            said[name] = str(cells[rows[0]])
        if x is None:
            assert v is not None
            leader = float(own["leader_length"][rows[0]]) if "leader_length" in own else np.nan
            leader = float(options.length or np.nan) if np.isnan(leader) else leader
            place = _integrated(time[rows], v[rows, 1], own["spacing"][rows], leader)
        else:
            place, leader = x[rows], _leader(table, own, x, rows)
        lengths = np.array([_follower(own, rows), leader])
        yield _Pair(said, origin, _rows(table, rows, said, options, time, place, v, lengths))


def _rows(
    table: Table,
    rows: np.ndarray,
    words: dict[str, str],
    options: PairOptions,
    time: np.ndarray,
    x: np.ndarray,
    v: np.ndarray | None,
    length: np.ndarray,
) -> Trajectories:
    """The rows of a pair's follower, and then those of its leader."""
    n = len(rows)
    kinds = {str(code): str(called) for code, called in dict(options.kinds).items()}
    codes = [words.get(f"{who}_kind", "") for who in _WHO]
    # one without an identifier is in no other pair
    agents = [words.get(who) or f"{words['pair']} {who}" for who in _WHO]
    return Trajectories(
        path=table.path,
        name=words["run"],
        where=lambda i: table.row(int(rows[i % n])),
        agent=np.repeat(np.array(agents, dtype=object), n),
        sequence=np.full(2 * n, words["pair"], dtype=object),
        time=np.tile(time[rows], 2),
        x=x.T.reshape(-1, 1),
        v=None if v is None else v[rows].T.reshape(-1, 1),
        length=np.repeat(length, n),
        kind=np.repeat(np.array([kinds.get(c, c) for c in codes], dtype=object), n)
        if any(codes)
        else None,
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


def _integrated(
    time: np.ndarray, v_leader: np.ndarray, spacing: np.ndarray, length: float
) -> np.ndarray:
    """``(K, 2)`` m, fronts of follower and leader, see :func:`read_pairs`."""
    leader = driven(time, v_leader)
    return np.stack([leader - np.nan_to_num(length) - spacing, leader], -1)


def _keys(words: dict[str, np.ndarray]) -> list[np.ndarray]:
    """The columns that tell pairs apart: their names, else the two vehicles."""
    if "pair" in words:
        return [words[n] for n in ("run", "pair") if n in words]
    return [words[n] for n in ("run", "follower", "leader") if n in words]


def _everywhere(
    key: str, path: Path, options: PairOptions, listed: dict[str, str], held: set[str]
) -> dict[str, str]:
    """What is the same in all rows of a file: set by hand, from the index, from its path."""
    said = {"run": options.name, "pair": path.stem}
    said |= {str(name): str(value) for name, value in options.constant.items()}
    said |= listed
    if options.pattern is not None:
        groups = re.compile(options.pattern).groupindex
        match = re.search(options.pattern, key)
        if match is None and not set(groups) <= held:
            raise DataError(
                f"{path}: its path {key!r} does not fit data.pattern={options.pattern}, and the "
                f"file has no columns {', '.join(sorted(set(groups) - held))}"
            )
        if match is not None:
            said |= {name: value for name, value in match.groupdict().items() if value}
    return said


def _steady(table: Table, column: str, cells: np.ndarray, rows: np.ndarray) -> None:
    other = rows[cells[rows] != cells[rows[0]]]
    if other.size:
        raise DataError(
            f"{table.path}, {table.row(int(other[0]))}: column {column!r} holds "
            f"{cells[other[0]]!s}, before it {cells[rows[0]]!s}; it belongs to the pair and must "
            "be the same in all its rows: name pairs that are to be told apart (data.columns.pair)"
        )


def _follower(own: dict[str, np.ndarray], rows: np.ndarray) -> float:
    return float(own["follower_length"][rows[0]]) if "follower_length" in own else float("nan")


def _leader(table: Table, own: dict[str, np.ndarray], x: np.ndarray, rows: np.ndarray) -> float:
    """The leader's length (m): given, or what is left of the distance without the spacing."""
    if "leader_length" in own:
        return float(own["leader_length"][rows[0]])
    if "spacing" not in own:
        return float("nan")
    length = x[rows, 1] - x[rows, 0] - own["spacing"][rows]
    if np.isnan(length).all():
        return float("nan")
    usual = float(np.nanmedian(length))
    off = np.abs(length - usual)
    if np.nanmax(off) > UNSTEADY:
        i = int(rows[np.nanargmax(off)])
        raise DataError(
            f"{table.path}, {table.row(i)}: x_leader - x_follower - spacing is "
            f"{length[np.nanargmax(off)]:.2f} m, {usual:.2f} m in other rows of the pair; expected "
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


def _lanes(options: PairOptions, pairs: list[_Pair]) -> list[str]:
    if options.lane is None:
        return []
    present = {pair.words.get("lane", "") for pair in pairs}
    return chosen_lanes(options.lane, present, "the pairs have")


def _too_short(rows: Trajectories, options: PairOptions) -> str:
    """Why there is no sequence of a pair."""
    if len(rows) // 2 < options.min_samples:
        return f"fewer than data.min_samples={options.min_samples} times"
    if options.window is not None:
        return f"no data.window={options.window:g} s without a gap"
    return f"no data.min_samples={options.min_samples} times without a gap"


def _sequences(
    name: str, rows: Trajectories, words: dict[str, str], dt: float, options: PairOptions
) -> tuple[list[Sequence], list[Record]]:
    """A pair's sequences, one for every part without a gap or every window, and its records."""
    usual = rows.dt
    if options.dt is not None and dt < usual * (1 - UNEVEN):
        raise ConfigError(
            f"data.dt={dt:g} s is finer than the {usual:g} s of {rows.path}: pair "
            f"{words['pair']}; expected no more times than were measured"
        )
    grid = Grid(dt, 0.0 if options.dt is not None else float(rows.time.min()))
    found = records(rows, grid, fill=options.fill, smoothing=options.smooth)
    both = [Member(str(rows.agent[i]), i) for i in (0, len(rows) // 2)]
    for record in found:
        both[record.row >= len(rows) // 2].records.append(record)
    parts = spans(both)
    if len(parts) > 1 and options.gaps is Gaps.error:
        end, start = (grid.origin + dt * k for k in (parts[0][1], parts[1][0]))
        row = int(np.flatnonzero(rows.time >= start - dt / 2)[0])
        raise DataError(
            f"{rows.path}: pair {words['pair']} steps from {end:g} s to {start:g} s "
            f"({rows.where(row)}), expected steps of {dt:g} s ({len(parts) - 1} such gaps); "
            "data.gaps=cut cuts the pair there"
        )
    if options.window is not None:
        steps = whole_steps("window", options.window, dt)
        parts = [piece for part in parts for piece in windows(*part, steps)]
    parts = [(a, b) for a, b in parts if b - a + 1 >= options.min_samples]
    split = words.get("split", "").lower()
    made = [
        sequence_of(
            name if len(parts) == 1 else f"{name}_{number:03d}",
            rows,
            both,
            first,
            last,
            grid,
            time=measured_times(rows, grid, first, last),
            split=split,
        )
        for number, (first, last) in enumerate(parts)
    ]
    return made, found
