"""A file from its first byte to the options that read it: what it holds, what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from nnode.data.check import findings as find
from nnode.data.check.columns import Meaning, meanings, numbers
from nnode.data.check.findings import Finding
from nnode.data.check.raw import Raw, read_raw
from nnode.data.check.scale import Medians, Scale, medians, scales
from nnode.data.check.source import Source, native_source, source_of
from nnode.data.check.tracks import Tracks, tracks_from, tracks_of
from nnode.data.prepare import FORMATS
from nnode.data.quality import Fault, find_faults
from nnode.data.sequence import Domain, Sequence
from nnode.errors import DataError, NNodeError

#: Sequences in which faults are looked for.
MOST = 400
#: How sure something is, by its probability.
SURE, LIKELY = 0.95, 0.7
#: A rate that is no less probable than this fits.
FAIR = 0.05

#: Columns whose names tell a unit.
_TELL: dict[str, tuple[str, ...]] = {
    "position": ("x", "x_follower"), "time": (), "speed": ("speed", "vx", "v_follower"),
}  # fmt: skip
#: Formats whose records are cut: where one begins or ends, nobody comes or goes.
_CUT = ("esimas", "openacc", "astazero")

_LEVELS = ("error", "warning", "note")
_SI = Scale("traffic", "m", "s", "m/s", None)


@dataclass
class Examination:
    """What a file holds.

    Attributes:
        path: of the file.
        raw: as it was read.
        meanings: column by meaning; empty where the format fixes them.
        scales: combinations of units, the most probable first; one where the format fixes them.
        known: medians in the file's own units.
        tracks: rows in SI units, by the most probable units.
        findings: errors first.
        source: what reads it, with its options, where need be after a change of its form.
        sequences: that the reader makes, at most :data:`MOST`.
        faults: in them, by name.
    """

    path: Path
    raw: Raw
    meanings: dict[str, Meaning]
    scales: list[Scale]
    known: Medians
    tracks: Tracks
    findings: list[Finding]
    source: Source
    sequences: list[Sequence] = field(default_factory=list)
    faults: dict[str, list[Fault]] = field(default_factory=dict)

    @property
    def scale(self) -> Scale:
        """The units that are taken."""
        return self.scales[0]


def sure(probability: float) -> str:
    """A probability in words."""
    if probability >= SURE:
        return "sure"
    return "likely" if probability >= LIKELY else "a guess"


def examine(path: Path, domain: Domain | None = None, rate: float | None = None) -> Examination:
    """Look at a file of trajectories.

    Args:
        domain: of the data; None looks for itself.
        rate: frames per second that the file is said to have; None: what the file tells.

    Raises:
        ConfigError: there is no such file.
        DataError: it is no table of trajectories, or a damaged file of a known format.
    """
    raw = read_raw(path)
    if raw.native:
        return _native(raw)
    found = meanings(raw)
    native = native_source(raw, found)
    if native is not None:
        return _native(replace(raw, native=native))
    return _table(raw, found, domain, rate)


def _native(raw: Raw) -> Examination:
    """A format whose reader knows its units."""
    source = source_of(raw)
    sequences = _read(source)
    tracks = tracks_from(sequences, cut=raw.native in _CUT)
    domain: Domain = "crowd" if tracks.x.shape[1] == 2 else "traffic"
    known = medians(tracks, domain)
    scale = replace(_SI, domain=domain)
    found = Examination(raw.path, raw, {}, [scale], known, tracks, [], source)
    return _judged(found, sequences, None)


def _table(
    raw: Raw, found: dict[str, Meaning], domain: Domain | None, rate: float | None
) -> Examination:
    table = raw.table
    assert table is not None
    seen = scaled(raw, found, domain, rate)
    rate = rate or raw.rate
    every = seen.scales
    source = source_of(raw, found, seen.scale, seen.tracks)
    examined = Examination(raw.path, raw, found, every, seen.known, seen.tracks, [], source)
    needed: dict[str, str] = {
        m: found[m].column for m in ("agent", seen.clock, "x", "y", "x_follower", "x_leader")
        if m in found
    }  # fmt: skip
    examined.findings += find.cells(table, needed)
    examined.findings += find.rows(table, seen.agent[: len(table)], seen.time[: len(table)])
    examined.findings += _unsure(every, rate)
    examined.findings += _rivals(found)
    sequences = [] if source.convert else _tried(source, examined.findings)
    return _judged(examined, sequences, rate)


@dataclass(frozen=True)
class Scaled:
    """The rows of a table in the units that are most probable.

    Attributes:
        scales: combinations of units, the most probable first.
        known: medians in the file's own units.
        tracks: rows in SI units.
        agent, time: of every row, in the file's own units.
        clock: the meaning of the column that times are from, ``time`` or ``frame``.
    """

    scales: list[Scale]
    known: Medians
    tracks: Tracks
    agent: np.ndarray
    time: np.ndarray
    clock: str

    @property
    def scale(self) -> Scale:
        """The units that are taken."""
        return self.scales[0]


def scaled(
    raw: Raw,
    found: Mapping[str, Meaning],
    domain: Domain | None,
    rate: float | None,
    told: Mapping[str, str] | None = None,
) -> Scaled:
    """Rows of a table, and its units.

    Args:
        found: column by meaning.
        domain, rate: see :func:`examine`.
        told: units by ``position``, ``time``, ``speed``, as the user tells them.

    Raises:
        DataError: a column that is needed was not recognised, or nothing moves.
    """
    table = raw.table
    assert table is not None
    pairs = {"x_follower", "x_leader"} <= set(found)
    clock = next((m for m in ("time", "frame") if m in found), None)
    lacking = [] if clock else ["a time or a frame"]
    lacking += [] if pairs or "x" in found else ["a position x"]
    lacking += [] if pairs or "agent" in found else ["an agent"]
    if lacking or clock is None:
        listed = ", ".join(map(str, table.frame.columns[:20]))
        taken = ", ".join(f"{m.column} as {meaning}" for meaning, m in found.items())
        raise DataError(
            f"{raw.path}: no column was recognised as {' nor as '.join(lacking)}; it has {listed} "
            f"(taken: {taken or 'none'}); name the columns agent, time, x (and y), see docs/data.md"
        )
    time = numbers(table.frame, found[clock].column)
    files = _agents(raw, found, pairs)
    x, speed, length, lane = _places(raw, found, pairs)
    if pairs:
        time = np.concatenate([time, time])
    tracks = tracks_of(files, time, x, speed, lane, length, None if pairs else _parts(raw, found))
    if len(tracks) < 2 or not tracks.steps.size:
        raise DataError(
            f"{raw.path}: {len(table)} row{'s' * (len(table) != 1)}, in which no agent of column "
            f"{found.get('agent', found[clock]).column!r} has numbers at two times; "
            "nothing moves that could be looked at"
        )
    units: dict[str, str] = {}
    for what, tellers in _TELL.items():
        for meaning in (*tellers, clock) if what == "time" else tellers:
            if not units.get(what) and meaning in found:
                units[what] = found[meaning].unit
    if raw.unit:
        units["position"] = raw.unit
    units |= told or {}
    if clock == "frame":
        units["time"] = "frame"
    rate = rate or raw.rate
    known = {d: medians(tracks, d) for d in _domains(found, tracks, domain)}
    frames = clock == "frame" or bool((tracks.time % 1 == 0).all())
    every = scales(
        known, {k: v for k, v in units.items() if v}, frames=frames, rate=rate,
        speeds=speed is not None,
    )  # fmt: skip
    scale = every[0]
    si = tracks.scaled(scale.metres, scale.seconds, scale.per_second)
    return Scaled(every, known[scale.domain], si, files, time, clock)


def _rivals(found: Mapping[str, Meaning]) -> Iterator[Finding]:
    """Meanings that more than one column may have."""
    for meaning, one in found.items():
        if one.rivals:
            yield Finding(
                "columns", "warning",
                f"{meaning} may be {one.column} or {' or '.join(one.rivals)}, which hold different "
                f"values; {one.column} is taken",
            )  # fmt: skip


def _unsure(every: list[Scale], rate: float | None) -> Iterator[Finding]:
    """What is known too little: the frame rate, or units."""
    best = every[0]
    same = [one for one in every if _units(one) == _units(best)]
    if sum(one.probability for one in same) < LIKELY:
        others = "; ".join(f"{_words(one)} ({one.probability:.0%})" for one in every[:3])
        yield Finding("units", "warning", f"units are a guess: {others}; say what you know")
    if rate is None and best.rate is not None:
        rates = sorted(one.rate for one in same if one.rate and one.probability > FAIR)
        yield Finding(
            "units", "warning",
            f"times are frames of a rate that the file does not tell; of the usual ones "
            f"{', '.join(f'{one:g}' for one in rates)} frames/s fit, {best.rate:g} is taken: tell "
            "the right one with frame_rate=",
        )  # fmt: skip


def _units(scale: Scale) -> tuple[str, ...]:
    return scale.domain, scale.position, scale.time, scale.speed


def _words(scale: Scale) -> str:
    clock = f"{scale.rate:g} frames/s" if scale.rate else scale.time
    return f"{scale.domain}, {scale.position}, {clock}, {scale.speed}"


def _domains(found: Mapping[str, Meaning], tracks: Tracks, asked: Domain | None) -> list[Domain]:
    if tracks.x.shape[1] == 1:
        return ["traffic"]
    if asked:
        return [asked]
    names = {m.column.lower() for m in found.values()}
    if any(word in name for name in names for word in ("ped", "person")):
        return ["crowd"]
    return ["traffic"] if "lane" in found else ["crowd", "traffic"]


def _agents(raw: Raw, found: Mapping[str, Meaning], pairs: bool) -> np.ndarray:
    """Whose row it is: what tells recordings and sequences apart is part of the name."""
    assert raw.table is not None
    whose = ("recording", "sequence", "pair") if pairs else ("recording", "sequence", "agent")
    parts = [raw.table.names(found[m].column, empty=True) for m in whose if m in found]
    if pairs and "pair" not in found:
        own = [raw.table.names(found[m].column) for m in ("follower", "leader") if m in found]
        parts += own or [np.full(len(raw.table), "pair", dtype=object)]
    names = np.array([" ".join(cells) for cells in zip(*parts, strict=True)], dtype=object)
    blank = parts[-1] == "" if not pairs else np.zeros(len(names), dtype=bool)
    names[blank] = None
    if pairs:
        return np.concatenate([names + " follower", names + " leader"])
    return names


_Places = tuple[np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray | None]


def _places(raw: Raw, found: Mapping[str, Meaning], pairs: bool) -> _Places:
    """Positions, speeds, lengths and lanes of the rows."""
    assert raw.table is not None
    frame = raw.table.frame

    def cells(meaning: str) -> np.ndarray | None:
        return numbers(frame, found[meaning].column) if meaning in found else None

    if pairs:
        both = [numbers(frame, found[m].column) for m in ("x_follower", "x_leader")]
        x = np.concatenate(both)[:, None]
        own, other = cells("v_follower"), cells("v_leader")
        speed = None if own is None or other is None else np.abs(np.concatenate([own, other]))
        pair = _agents(raw, found, pairs)
        both_in = np.array([name.rpartition(" ")[0] for name in pair], dtype=object)
        return x, speed, None, both_in
    axes = [m for m in ("x", "y") if m in found]
    if "lane" in found and "y" in found:
        axes = ["x"]  # along the lane
    x = np.stack([numbers(frame, found[m].column) for m in axes], -1)
    speed = cells("speed")
    lane: np.ndarray | None = None
    parts = [v for m in ("vx", "vy")[: len(axes)] if (v := cells(m)) is not None]
    if len(parts) == len(axes):
        speed = np.sqrt(sum(v**2 for v in parts))
    if "lane" in found:
        lane = raw.table.names(found["lane"].column, empty=True)
    if lane is None and len(axes) == 1:
        lane = _parts(raw, found)
    return x, None if speed is None else np.abs(speed), cells("length"), lane


def _parts(raw: Raw, found: Mapping[str, Meaning]) -> np.ndarray | None:
    """Names of the recordings and sequences that the rows are of, where the table has such."""
    assert raw.table is not None
    whose = [
        raw.table.names(found[m].column, empty=True)
        for m in ("recording", "sequence")
        if m in found
    ]
    if not whose:
        return None
    return np.array([" ".join(one) for one in zip(*whose, strict=True)], dtype=object)


def _read(source: Source) -> list[Sequence]:
    kind = FORMATS[type(source.options)]
    return kind.read(kind.files(source.options), source.options)


def _tried(source: Source, findings: list[Finding]) -> list[Sequence]:
    """The sequences that the reader makes; what it refuses is a finding."""
    try:
        return _read(source)
    except NNodeError as error:
        findings.append(Finding("reader", "error", f"data={source.group} refuses it: {error}"))
        return []


def _judged(found: Examination, sequences: list[Sequence], rate: float | None) -> Examination:
    """With everything that rows and sequences show."""
    tracks, domain = found.tracks, found.scale.domain
    found.findings += find.sampling(tracks)
    found.findings += find.time_scale(found.known, found.scale, rate)
    found.findings += find.extremes(tracks, domain)
    found.findings += find.direction(tracks, domain)
    whole = found.raw.native not in _CUT and "x_follower" not in found.meanings
    found.findings += find.coming_and_going(tracks, domain, whole)
    found.sequences = sequences[:: max(1, -(-len(sequences) // MOST))]
    found.faults = {s.name: own for s in found.sequences if (own := find_faults(s, domain))}
    every = [fault for own in found.faults.values() for fault in own]
    found.findings += find.faults(every, len(found.sequences))
    found.findings += _made(found, len(sequences))
    found.findings.sort(key=lambda one: _LEVELS.index(one.level))
    return found


def _made(found: Examination, number: int) -> Iterator[Finding]:
    if number:
        looked = f"; faults were looked for in {len(found.sequences)}" * (
            len(found.sequences) < number
        )
        yield Finding(
            "sequences", "note", f"data={found.source.group} makes {number} sequences of it{looked}"
        )
