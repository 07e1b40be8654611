"""Content and problems of a file of trajectories: ``nnode check``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
from omegaconf import DictConfig

from nnode.app.cli.typed import changed_options, changes, group_defaults
from nnode.data.check.examine import Examination, examine
from nnode.data.clusters import index_of
from nnode.data.identity import identify
from nnode.data.limits import AGREE, INTERVAL, USUAL
from nnode.data.quality import Finding
from nnode.data.readers.columns import floats, quoted
from nnode.data.sequence import Domain, Sequence
from nnode.data.split import split
from nnode.data.units import certainty
from nnode.diagnosis.inputs import LEAST
from nnode.errors import ConfigError, NNodeError, printable
from nnode.machine import how_made
from nnode.pages.page import Block, FigureBlock, Heading, Provenance, TableBlock, Text, write_page

#: Stands before what is printed of each level.
_SIGNS = {"error": "ERROR", "warning": "WARN", "note": "note"}


@dataclass(frozen=True, repr=False)
class Check:
    """Content and problems of a file of trajectories.

    Its text is the summary, and a notebook shows the findings.

    Attributes:
        examination: all results, in SI units.
    """

    examination: Examination

    @property
    def findings(self) -> list[Finding]:
        """Problems, the worst first: ``level``, ``kind``, ``text``."""
        return self.examination.findings

    @property
    def probability(self) -> float:
        """Probability of the units, summed over frame rates."""
        return self.examination.share

    @cached_property
    def options(self) -> list[str]:
        """The overrides, quoted for the shell, with which the commands read the file."""
        source = self.examination.source
        defaults = group_defaults("data", source.group, "prepare_data")
        # options that were not recognised keep the group's values
        return [f"data={source.group}", *changes("data", changed_options(source.options), defaults)]

    @property
    def sentence(self) -> str:
        """What there is, in a sentence."""
        rows, levels = self.examination.rows, [finding.level for finding in self.findings]
        errors, warnings = levels.count("error"), levels.count("warning")
        wrong = f"{errors} error{'s' * (errors != 1)} and {warnings} warning{'s' * (warnings != 1)}"
        who = "people" if self.examination.scale.domain == "crowd" else "vehicles"
        return (
            f"{len(set(rows.agent.tolist()))} {who}, {len(rows)} positions, "
            f"sampled every {rows.dt:.4g} s: {wrong}."
        )

    @property
    def python(self) -> list[str]:
        """Lines of Python that read the file with all recognised options and calibrate a model."""
        source = self.examination.source
        options = changed_options(source.options)
        path = options.pop("path", "")
        arguments = [repr(path)] if path else []
        arguments += [f"{k}={value!r}" for k, value in {"data": source.group, **options}.items()]
        heldout = "" if self._can_hold_out else ", heldout=0"
        return [
            "import nnode",
            f"data = nnode.sequences({', '.join(arguments)})",
            f"nnode.fit(data, model={self._model!r}{heldout})",
        ]

    def __repr__(self) -> str:
        examination = self.examination
        text = [f"{examination.path}: {self.sentence}"]
        if examination.meanings:
            columns = ", ".join(
                f"{m} = {guess.column}" for m, guess in examination.meanings.items()
            )
            units = f"units: {_units(examination)} ({certainty(examination.share)})"
            text += [f"columns: {columns}", units]
        else:
            text.append(f"format: {examination.raw.native}, whose reader knows its units")
        text += [f"{_SIGNS[f.level]:>5}  {f.kind}: {f.text}" for f in self.findings]
        prepare, *others = self._commands(" ")
        text += ["", "to prepare the data:", f"  {prepare}"]
        text += ["to calibrate and to diagnose a model:", *(f"  {line}" for line in others)]
        text += ["in Python:", *(f"  {line}" for line in self.python)]
        return "\n".join(printable(line) for line in text)

    def _repr_html_(self) -> str:
        table = _rows(self.findings).to_html() if self.findings else ""
        return f"<p>{escape(self.sentence)}</p>{table}"

    def write(self, folder: str | Path) -> Path:
        """Write the page ``check.html`` with its tables, and return its path."""
        shell, python = "\n".join(self._commands(" \\\n    ")), "\n".join(self.python)
        usage = f"```sh\n{shell}\n```\n\nIn Python:\n\n```python\n{python}\n```"
        return write_page(
            [
                Heading("Findings"),
                *_findings(self.findings),
                Heading("Commands"),
                Text(usage),
                *_columns(self.examination),
                *_units_blocks(self.examination),
                Heading("Speeds, sampling and presence"),
                *_figures(self.examination),
                Provenance(how_made(("numpy", "pandas", "scipy", "matplotlib"))),
            ],
            Path(folder),
            title=f"Check of {self.examination.path.name}",
            subtitle=self.sentence,
            stem="check",
        )[0]

    def _commands(self, separator: str) -> list[str]:
        """The commands for the data, as far as there are enough sequences for them.

        Args:
            separator: text between the options.
        """
        options, number = separator.join(self.options), len(self._sound_sequences)
        heldout = "" if self._can_hold_out else " data.split.heldout=0"
        return [
            f"nnode prepare_data {options}",
            f"nnode train model={self._model} {options}{heldout}",
            f"nnode discover model={self._model} {options}"
            if number >= LEAST
            else f"# a diagnosis needs at least {LEAST} sequences, there are {number}",
        ]

    @property
    def _model(self) -> str:
        """The domain's simplest model of an acceleration or a force."""
        return "sf" if self.examination.scale.domain == "crowd" else "idm"

    @cached_property
    def _sound_sequences(self) -> list[Sequence]:
        """The sequences without faults."""
        sequences, options = self.examination.sequences, self.examination.source.options
        if not sequences:
            return []
        agents, _ = identify(sequences, self.examination.scale.domain, options.agents)
        unique = [replace(s, agents=names) for s, names in zip(sequences, agents, strict=True)]
        return [s for s in unique if s.name not in self.examination.faults]

    @property
    def _can_hold_out(self) -> bool:
        """Whether some of the sequences can be held out; True if there are none."""
        sequences = self._sound_sequences
        if not sequences:
            return True
        try:
            return bool(split(index_of(sequences), self.examination.source.options.split).heldout)
        except NNodeError:
            return False


def check_file(
    file: str | Path, domain: Domain | None = None, frame_rate: float | None = None
) -> Check:
    """Examine a file before it is used.

    Args:
        file: a table, or trajectories in a format that nnode reads.
        domain: ``traffic`` or ``crowd``; None guesses.
        frame_rate: 1/s, if time is counted in frames; None guesses.

    Raises:
        ConfigError: the file does not exist, or an option is out of its range.
        DataError: the file is not a table of trajectories.
    """
    if domain not in (None, "traffic", "crowd"):
        raise ConfigError(f"domain={domain}: expected traffic, crowd, or null to guess")
    if frame_rate is not None and not 0 < frame_rate < float("inf"):
        raise ConfigError(f"frame_rate={frame_rate}: expected a positive number, 1/s")
    return Check(examine(Path(file).expanduser(), domain, frame_rate))


def check(config: DictConfig, folder: Path) -> None:
    """Examine a file, print the summary, and write ``check.html`` into ``folder``.

    Raises:
        NNodeError: see :func:`check_file`.
    """
    result = check_file(config.file, cast(Domain | None, config.domain), config.frame_rate)
    print(result)
    print(f"page: {result.write(folder)}")


def _units(examination: Examination) -> str:
    scale = examination.scale
    clock = f"frames of 1/{scale.rate:g} s" if scale.rate else scale.time
    speeds = f", speeds in {scale.speed}" if examination.rows.v is not None else ""
    return f"{scale.domain}, positions in {scale.position}, times in {clock}{speeds}"


def _rows(findings: list[Finding]) -> pd.DataFrame:
    rows = [(finding.level, finding.kind, finding.text) for finding in findings]
    return pd.DataFrame(rows, columns=["", "kind", "finding"]).set_index("")


def _findings(findings: list[Finding]) -> list[Block]:
    if not findings:
        return [Text("There are no findings.")]
    caption = (
        "*Error*: results would be wrong. *Warning*: check the data before you continue. *Note*: "
        "information."
    )
    return [TableBlock("findings", _rows(findings), caption)]


def _columns(examination: Examination) -> list[Block]:
    if not examination.meanings or examination.raw.table is None:
        return []
    frame = examination.raw.table.frame
    reasons = {
        "named": "column name",
        "like": "similar column name",
        "holds": "content",
    }
    by = {guess.column: (meaning, guess) for meaning, guess in examination.meanings.items()}
    rows = {}
    for column in map(str, frame.columns):
        meaning, guess = by.get(column, ("not used", None))
        cells = frame[column]
        values = pd.Series(floats(cells)).dropna()
        numeric = len(values) > 0
        rows[column] = {
            "meaning": meaning,
            "recognised by": "" if guess is None else reasons[guess.sure],
            "minimum": f"{values.min():.6g}" if numeric else "",
            "maximum": f"{values.max():.6g}" if numeric else "",
            "distinct values": cells.dropna().map(quoted).nunique(),
            "missing values": int(cells.isna().sum()),
        }
    table = pd.DataFrame(rows).T.rename_axis("column")
    return [
        Heading("Columns"),
        TableBlock("columns", table, "Recognised meaning of each column."),
    ]


def _units_blocks(examination: Examination) -> list[Block]:
    scale, measured = examination.scale, examination.medians
    ranges = USUAL[scale.domain]
    values = [
        (
            "speed of moving agents (m/s)",
            measured.speed * scale.metres / scale.seconds,
            ranges.get("speed"),
        ),
        (
            "distance to the nearest agent (m)",
            measured.nearest * scale.metres,
            ranges.get("nearest"),
        ),
        ("length (m)", measured.length * scale.metres, ranges.get("length")),
        ("sway (1/s)", measured.sway / scale.seconds, ranges.get("sway")),
        ("sampling interval (s)", measured.dt * scale.seconds, INTERVAL),
        (
            "speed from positions / speed in the file",
            measured.ratio * scale.metres / (scale.per_second * scale.seconds),
            AGREE,
        ),
    ]
    rows = {
        name: {
            "median": value,
            "usual range": f"{usual.low:g} to {usual.high:g}",
            "source": usual.source,
        }
        for name, value, usual in values
        if np.isfinite(value) and usual is not None
    }
    blocks: list[Block] = [
        Heading("Units and time scale"),
        Text(f"Assumed: {_units(examination)} ({certainty(examination.share)})."),
        TableBlock(
            "medians",
            pd.DataFrame(rows).T,
            "Medians in SI units, and usual ranges.",
        ),
    ]
    if len(examination.scales) > 1:
        columns = ["domain", "positions", "times", "frames/s", "speeds", "probability"]
        table = pd.DataFrame(
            [
                (s.domain, s.position, s.time, s.rate, s.speed, s.probability)
                for s in examination.scales
            ],
            columns=columns,
        )
        blocks.append(
            TableBlock(
                "units",
                table.head(6),
                "Combinations of units by the agreement of these medians with the usual ranges. "
                "The CSV file contains all combinations.",
                digits={"probability": 3},
                full=table,
            )
        )
    return blocks


def _figures(examination: Examination) -> list[Block]:
    from nnode.plots import check as plots  # loads Matplotlib, which takes a second
    from nnode.plots.quality import faults_figure

    rows, domain = examination.rows, examination.scale.domain
    shown: list[Block] = [
        FigureBlock(
            "speeds",
            plots.speeds(rows, USUAL[domain]["speed"]),
            "Speeds over ten samples, and sampling steps. Shaded: usual range.",
            "Histograms of speeds in m/s and of sampling steps in s.",
        ),
        FigureBlock(
            "presence",
            plots.presence(rows, domain),
            "Positions of a part of the agents over time (top), and number of agents (bottom).",
            "Paths over time, and the number of agents over time.",
        ),
    ]
    if examination.faults:
        shown.append(
            FigureBlock(
                "faults",
                faults_figure(examination.sequences, examination.faults, domain, 10),
                f"Sequences of data={examination.source.group} with marked faults; the first 10 of "
                f"{len(examination.faults)}.",
                "Positions over time of faulty sequences, faults marked.",
            )
        )
    return shown
