"""A file from its first byte to the options that read it: what it holds, what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from nnode.data.check.columns import (
    Meaning,
    are_pairs,
    clock_of,
    in_seconds,
    is_spaced,
    meanings,
    rivals,
)
from nnode.data.check.raw import Raw, read_raw
from nnode.data.check.recognise import Recognised, native_source, source_of, source_of_native
from nnode.data.check.rows import scaled
from nnode.data.cut import Reading
from nnode.data.prepare import FORMATS
from nnode.data.quality import (
    Fault,
    Finding,
    cell_findings,
    find_faults,
    left_out_texts,
    order_findings,
    row_findings,
    sequence_findings,
)
from nnode.data.readers.recordings import reading
from nnode.data.sequence import Domain, Sequence
from nnode.data.smooth import measured_noise
from nnode.data.trajectories import Trajectories
from nnode.data.units import Medians, Scale, medians
from nnode.errors import NNodeError

#: Sequences in which faults are looked for.
MOST = 400
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
        rows: in order and in SI units, by the most probable units.
        findings: errors first.
        source: what reads it, with its options.
        sequences: that the reader makes, at most :data:`MOST`.
        faults: in them, by name.
    """

    path: Path
    raw: Raw
    meanings: dict[str, Meaning]
    scales: list[Scale]
    known: Medians
    rows: Trajectories
    findings: list[Finding]
    source: Recognised
    sequences: list[Sequence] = field(default_factory=list)
    faults: dict[str, list[Fault]] = field(default_factory=dict)

    @property
    def scale(self) -> Scale:
        """The units that are taken."""
        return self.scales[0]


def examine(path: Path, domain: Domain | None = None, rate: float | None = None) -> Examination:
    """Look at a file of trajectories.

    Args:
        domain: of the data; None looks for itself.
        rate: frames per second that the file is said to have; None: what the file states.

    Raises:
        ConfigError: there is no such file.
        DataError: it is no table of trajectories, or a damaged file of a known format.
    """
    with reading(path):
        raw = read_raw(path)
        if raw.native:
            return _native(raw)
        raw = in_seconds(raw)
        columns = meanings(raw)
        native = native_source(raw, columns)
        if native is not None:
            return _native(replace(raw, native=native))
        return _table(raw, columns, domain, rate)


def _native(raw: Raw) -> Examination:
    """A format whose reader knows its units."""
    source = source_of_native(raw)
    sequences = _read(source)
    rows = _rows_of(raw, sequences)
    domain: Domain = "crowd" if rows.x.shape[1] == 2 else "traffic"
    scale = replace(_SI, domain=domain)
    examined = Examination(raw.path, raw, {}, [scale], medians(rows, domain), rows, [], source)
    return _judged(examined, sequences, None)


def _rows_of(raw: Raw, sequences: list[Sequence]) -> Trajectories:
    """Sequences that a reader made, as rows in order.

    An agent without an identifier is one of its own, and so is everyone in sequences whose
    positions begin anew.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    for s in sequences:
        n, k = s.n_agents, s.n_samples
        whose = s.name if raw.native in _CUT or not s.agents else s.recording
        names = [f"{whose} {name}" for name in s.agents or range(n)]
        v = np.full((k, n), np.nan) if s.v is None else np.linalg.norm(s.v, axis=2)
        length = np.full(n, np.nan) if s.length is None else s.length
        parts.append(
            (
                np.tile(np.array(names, dtype=object), k),
                np.repeat(s.time, n),
                s.x.reshape(k * n, -1),
                v.reshape(-1, 1),
                np.tile(length, k),
                np.full(k * n, s.recording, dtype=object),
            )
        )
    agent, time, x, v, length, recording = (np.concatenate(p) for p in zip(*parts, strict=True))
    return Trajectories(
        path=raw.path,
        name=raw.path.stem,
        where=str,
        agent=agent,
        time=time,
        x=x,
        v=None if np.isnan(v).all() else v,
        recording=recording,
        lane=recording,
        length=None if np.isnan(length).all() else length,
    ).in_order()


def _table(
    raw: Raw, columns: dict[str, Meaning], domain: Domain | None, rate: float | None
) -> Examination:
    table = raw.table
    assert table is not None
    measured = scaled(raw, columns, domain, rate)
    columns = measured.meanings
    rate = rate or raw.rate
    source = source_of(raw, measured)
    examined = Examination(
        raw.path, raw, columns, measured.scales, measured.known, measured.rows, [], source
    )
    needed: dict[str, str] = {
        m: columns[m].column
        for m in ("agent", clock_of(columns), "x", "y", "x_follower", "x_leader")
        if m in columns
    }
    if is_spaced(columns):
        needed |= {m: columns[m].column for m in ("spacing", "v_follower", "v_leader")}
    examined.findings += cell_findings(table, needed)
    stand = measured.table.at(np.arange(len(table)))
    examined.findings += order_findings(stand, int(table.frame.duplicated().sum()))
    doubts = [("units", text) for text in measured.doubts(rate).values()]
    doubts += [("columns", text) for text in rivals(columns).values()]
    examined.findings += [Finding(kind, "warning", text) for kind, text in doubts]
    sequences = _tried(source, examined.findings)
    return _judged(examined, sequences, rate)


def _read(source: Recognised) -> Reading:
    kind = FORMATS[type(source.options)]
    return kind.sequences(kind.files(source.options), source.options)


def _tried(source: Recognised, findings: list[Finding]) -> list[Sequence]:
    """The sequences that the reader makes of the file; what it refuses is a finding."""
    try:
        made = _read(source)
        texts = {"left_out": left_out_texts(len(made), [], made.left_out), "resampled": made.notes}
        findings += [
            Finding(kind, "warning", text) for kind, of_kind in texts.items() for text in of_kind
        ]
        return made
    except NNodeError as error:
        findings.append(Finding("reader", "error", f"data={source.group} refuses it: {error}"))
        return []


def _judged(examined: Examination, sequences: list[Sequence], rate: float | None) -> Examination:
    """With everything that rows and sequences show."""
    rows, domain = examined.rows, examined.scale.domain
    whole = examined.raw.native not in _CUT and not are_pairs(examined.meanings)
    examined.findings += row_findings(rows, examined.known, examined.scale, rate, whole)
    examined.sequences = sequences[:: max(1, -(-len(sequences) // MOST))]
    noise = measured_noise(examined.sequences)
    position_noise = 0.0 if examined.source.options.published else noise.position
    examined.faults = {
        s.name: faults
        for s in examined.sequences
        if (faults := find_faults(s, domain, position_noise))
    }
    examined.findings += sequence_findings(examined.sequences, examined.faults, noise, domain)
    examined.findings += _made(examined, len(sequences))
    examined.findings.sort(key=lambda finding: _LEVELS.index(finding.level))
    return examined


def _made(examined: Examination, number: int) -> Iterator[Finding]:
    if number:
        looked = f"; {len(examined.sequences)} of them were examined for faults" * (
            len(examined.sequences) < number
        )
        yield Finding(
            "sequences",
            "note",
            f"data={examined.source.group} yields {number} sequences{looked}",
        )
