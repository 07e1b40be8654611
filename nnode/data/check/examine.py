"""A file from its first byte to the options that read it: what it holds, what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from nnode.data._arrow import to_table
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
from nnode.data.check.rows import Scaled, scaled
from nnode.data.cut import Reading
from nnode.data.prepare import format_of
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
from nnode.data.units import Scale, medians
from nnode.errors import NNodeError

#: Sequences in which faults are looked for.
MOST = 400
#: Formats whose records are cut: where one begins or ends, nobody comes or goes.
_CUT = ("esimas", "openacc", "astazero")

_LEVELS = ("error", "warning", "note")


@dataclass
class Examination(Scaled):
    """What a file holds.

    Where the format fixes columns and units, ``meanings`` is empty and ``scales`` has one entry.

    Attributes:
        path: of the file.
        raw: as it was read.
        source: what reads it, with its options.
        findings: errors first.
        sequences: that the reader makes, at most :data:`MOST`.
        faults: in them, by name.
    """

    path: Path
    raw: Raw
    source: Recognised
    findings: list[Finding] = field(default_factory=list)
    sequences: list[Sequence] = field(default_factory=list)
    faults: dict[str, list[Fault]] = field(default_factory=dict)


def examine(path: Path, domain: Domain | None = None, rate: float | None = None) -> Examination:
    """Examine a file of trajectories.

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
    scale = Scale(domain, "m", "s", "m/s", None)
    examined = Examination({}, [scale], medians(rows, domain), rows, rows, raw.path, raw, source)
    return _judged(examined, sequences, None)


def _rows_of(raw: Raw, sequences: list[Sequence]) -> Trajectories:
    """Sequences that a reader made, as rows in order.

    An agent without an identifier is one of its own, and so is everyone in sequences whose
    positions begin anew.
    """
    tables = []
    for s in sequences:
        whose = s.name if raw.native in _CUT or not s.agents else s.recording
        table = to_table(s).to_pandas()
        tables.append(table.assign(agent=f"{whose} " + table["agent"]))
    table = pd.concat(tables)
    axes = [axis for axis in ("x", "y") if axis in table]
    speed = np.linalg.norm(table[[f"v{axis}" for axis in axes]], axis=1)
    recording, length = table["recording"].to_numpy(dtype=object), table["length"].to_numpy()
    return Trajectories(
        path=raw.path,
        name=raw.path.stem,
        where=str,
        agent=table["agent"].to_numpy(dtype=object),
        time=table["time"].to_numpy(),
        x=table[axes].to_numpy(),
        v=None if np.isnan(speed).all() else speed[:, None],
        recording=recording,
        lane=recording,
        length=None if np.isnan(length).all() else length,
    ).in_order()


def _table(
    raw: Raw, columns: dict[str, Meaning], domain: Domain | None, rate: float | None
) -> Examination:
    measured = scaled(raw, columns, domain, rate)
    rate = rate or raw.rate
    examined = Examination(
        **vars(measured), path=raw.path, raw=raw, source=source_of(raw, measured)
    )
    columns, findings = examined.meanings, examined.findings
    needed = ["agent", clock_of(columns), "x", "y", "x_follower", "x_leader"]
    needed += ["spacing", "v_follower", "v_leader"] if is_spaced(columns) else []
    findings += cell_findings(raw.cells, {m: columns[m].column for m in needed if m in columns})
    followers = measured.table.at(np.arange(len(raw.frame)))
    findings += order_findings(followers, int(raw.frame.duplicated().sum()))
    doubts = {"units": measured.doubts(rate), "columns": rivals(columns)}
    for kind, texts in doubts.items():
        findings += [Finding(kind, "warning", text) for text in texts.values()]
    return _judged(examined, _tried(examined.source, findings), rate)


def _read(source: Recognised) -> Reading:
    layout = format_of(source.options)
    return layout.sequences(layout.files(source.options), source.options)


def _tried(source: Recognised, findings: list[Finding]) -> list[Sequence]:
    """The sequences that the reader makes of the file; what it refuses is a finding."""
    try:
        made = _read(source)
        texts = {"left_out": left_out_texts(len(made), [], made.left_out), "resampled": made.notes}
        for kind, of_kind in texts.items():
            findings += [Finding(kind, "warning", text) for text in of_kind]
        return made
    except NNodeError as error:
        findings.append(Finding("reader", "error", f"data={source.group} refuses it: {error}"))
        return []


def _judged(examined: Examination, sequences: list[Sequence], rate: float | None) -> Examination:
    """With everything that rows and sequences show."""
    rows, domain = examined.rows, examined.scale.domain
    whole = examined.raw.native not in _CUT and not are_pairs(examined.meanings)
    examined.findings += row_findings(rows, examined.medians, examined.scale, rate, whole)
    examined.sequences = sequences[:: max(1, -(-len(sequences) // MOST))]
    noise = measured_noise(examined.sequences)
    position_noise = 0.0 if examined.source.options.published else noise.position
    examined.faults = {
        s.name: faults
        for s in examined.sequences
        if (faults := find_faults(s, domain, position_noise))
    }
    examined.findings += sequence_findings(examined.sequences, examined.faults, noise, domain)
    if sequences:
        looked, number = len(examined.sequences), len(sequences)
        part = f"; {looked} of them were examined for faults" if looked < number else ""
        text = f"data={examined.source.group} yields {number} sequences{part}"
        examined.findings.append(Finding("sequences", "note", text))
    examined.findings.sort(key=lambda finding: _LEVELS.index(finding.level))
    return examined
