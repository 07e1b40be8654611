"""What a file of trajectories holds and what is wrong with it: ``nnode check``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
from omegaconf import DictConfig

from nnode.app.cli.typed import changes, group_defaults, plain_options
from nnode.data.check.examine import Examination, examine
from nnode.data.clusters import index_of
from nnode.data.identity import identify
from nnode.data.limits import AGREE, INTERVAL, USUAL, Range
from nnode.data.quality import Finding
from nnode.data.readers.columns import floats, quoted
from nnode.data.sequence import Domain, Sequence
from nnode.data.split import split
from nnode.data.units import certainty, share
from nnode.discover.inputs import LEAST
from nnode.errors import ConfigError, NNodeError, printable
from nnode.machine import how_made
from nnode.pages.page import Block, FigureBlock, Heading, Provenance, TableBlock, Text, write_page

#: Stands before what is printed of each level.
_SIGNS = {"error": "ERROR", "warning": "WARN", "note": "note"}


@dataclass(frozen=True, repr=False)
class Check:
    """What a file of trajectories holds; printed, it is the summary, a notebook shows the findings.

    Attributes:
        examination: all that was found, in SI units.
        options: overrides with which the commands read the file.
    """

    examination: Examination
    options: list[str]

    @property
    def findings(self) -> list[Finding]:
        """What is wrong, the worst first: ``level``, ``kind``, ``text``."""
        return self.examination.findings

    @property
    def probability(self) -> float:
        """Of the units, whatever the rate of frames."""
        return share(self.examination.scales)

    def __repr__(self) -> str:
        return summary(self.examination, self.options)

    def _repr_html_(self) -> str:
        table = _rows(self.findings).to_html() if self.findings else ""
        return f"<p>{escape(sentence(self.examination))}</p>{table}"

    def write(self, folder: str | Path) -> Path:
        """Write the page ``check.html`` with its tables; returns its path."""
        return write_page(
            [*blocks(self.examination, self.options), _made()],
            Path(folder),
            title=f"Check of {self.examination.path.name}",
            subtitle=sentence(self.examination),
            stem="check",
        )[0]


def check_file(
    file: str | Path, domain: Domain | None = None, frame_rate: float | None = None
) -> Check:
    """Examine a file before anything is made of it.

    Args:
        file: a table, or trajectories in a format that nnode reads.
        domain: ``traffic`` or ``crowd``; None guesses.
        frame_rate: 1/s, where time is counted in frames; None guesses.

    Raises:
        ConfigError: no such file, or an option out of its range.
        DataError: a file that is no table of trajectories.
    """
    if domain not in (None, "traffic", "crowd"):
        raise ConfigError(f"domain={domain}: expected traffic, crowd, or null to guess")
    if frame_rate is not None and not 0 < frame_rate < float("inf"):
        raise ConfigError(f"frame_rate={frame_rate}: expected a positive number, 1/s")
    found = examine(Path(file).expanduser(), domain, frame_rate)
    return Check(found, command(found))


def check(config: DictConfig, folder: Path) -> None:
    """Examine a file, print what was found, and write ``check.html`` into ``folder``.

    Raises:
        NNodeError: see :func:`check_file`.
    """
    found = check_file(config.file, cast(Domain | None, config.domain), config.frame_rate)
    print(found)
    print(f"page: {found.write(folder)}")


def command(found: Examination) -> list[str]:
    """The overrides, as they can be typed, with which the commands read the file."""
    source = found.source
    values = plain_options(source.options)
    defaults = group_defaults("data", source.group, "prepare_data")
    own = plain_options(type(source.options)())
    # what was not found here stays as the group has it
    kept = {k: v for k, v in values.items() if v != own[k] and k != "name"}
    return [f"data={source.group}", *changes("data", kept, defaults)]


def sentence(found: Examination) -> str:
    """What there is, in a sentence."""
    levels = [one.level for one in found.findings]
    errors, looks = levels.count("error"), levels.count("warning")
    wrong = f"{errors} error{'s' * (errors != 1)} and {looks} warning{'s' * (looks != 1)}"
    who = "people" if found.scale.domain == "crowd" else "vehicles"
    return (
        f"{len(set(found.rows.agent.tolist()))} {who}, {len(found.rows)} positions, sampled "
        f"every {found.rows.dt:.4g} s: {wrong}."
    )


def summary(found: Examination, lines: list[str]) -> str:
    """The whole in plain text."""
    text = [f"{found.path}: {sentence(found)}"]
    if found.meanings:
        known = ", ".join(f"{m} = {one.column}" for m, one in found.meanings.items())
        text.append(f"columns: {known}")
        text.append(f"units: {_units(found)} ({certainty(share(found.scales))})")
    else:
        text.append(f"format: {found.raw.native}, whose reader knows its units")
    text += [f"{_SIGNS[one.level]:>5}  {one.kind}: {one.text}" for one in found.findings]
    words = " ".join(lines)
    text += ["", "to prepare the data:", f"  nnode prepare_data {words}"]
    text += ["to calibrate and to diagnose a model:"]
    text += [f"  {line}" for line in _next(found, words)]
    text += ["in Python:", *(f"  {line}" for line in python_lines(found))]
    return "\n".join(printable(line) for line in text)


def _next(found: Examination, words: str) -> list[str]:
    """Commands that go on with the data, as far as these suffice for them."""
    kept = _kept(found)
    held = [] if _heldout(found, kept) else ["data.split.heldout=0"]
    lines = [" ".join([f"nnode train {_model(found)} {words}", *held])]
    if len(kept) >= LEAST:
        lines.append(f"nnode discover {_model(found)} {words}")
    else:
        lines.append(f"# a diagnosis needs at least {LEAST} sequences, there are {len(kept)}")
    return lines


def _kept(found: Examination) -> list[Sequence]:
    """The sequences that are left when faulty ones are sorted out."""
    domain, kept = found.scale.domain, found.sequences
    agents, _ = identify(kept, domain, found.source.options.agents) if kept else ([], [])
    unique = [replace(s, agents=own) for s, own in zip(kept, agents, strict=True)]
    return [s for s in unique if s.name not in found.faults]


def _heldout(found: Examination, kept: list[Sequence]) -> bool:
    """Whether some of the sequences can be held out."""
    try:
        return bool(split(index_of(kept), found.source.options.split).heldout) if kept else True
    except NNodeError:
        return False


def _model(found: Examination) -> str:
    """The domain's simplest model of an acceleration or a force."""
    return "model=sf" if found.scale.domain == "crowd" else "model=idm"


def python_lines(found: Examination) -> list[str]:
    """Lines of Python that read the file and calibrate a model, with all that is told."""
    group, *_ = command(found)
    held = "" if _heldout(found, _kept(found)) else ", heldout=0"
    own = plain_options(type(found.source.options)())
    values = plain_options(found.source.options)
    kept = {k: v for k, v in values.items() if v != own[k] and k not in ("name", "path")}
    path = values.get("path") or ""
    told = [repr(path)] if path else []
    told += [f"data={group.partition('=')[2]!r}", *(f"{k}={v!r}" for k, v in kept.items())]
    return [
        "import nnode",
        f"data = nnode.sequences({', '.join(told)})",
        f"nnode.fit(data, model={_model(found).partition('=')[2]!r}{held})",
    ]


def _units(found: Examination) -> str:
    scale = found.scale
    clock = f"frames of 1/{scale.rate:g} s" if scale.rate else scale.time
    speeds = f", speeds in {scale.speed}" if found.rows.v is not None else ""
    return f"{scale.domain}, positions in {scale.position}, times in {clock}{speeds}"


def blocks(found: Examination, lines: list[str]) -> list[Block]:
    """The page: findings, commands, and the content of the file."""
    return [
        Heading("Findings"),
        *_findings(found.findings),
        Heading("Commands"),
        Text(_usage(found, lines)),
        *_columns(found),
        *_units_blocks(found),
        Heading("Speeds, sampling and presence"),
        *_figures(found),
    ]


def _rows(findings: list[Finding]) -> pd.DataFrame:
    rows = [{"": one.level, "what": one.kind, "in words": one.text} for one in findings]
    return pd.DataFrame(rows).set_index("")


def _findings(findings: list[Finding]) -> list[Block]:
    if not findings:
        return [Text("There are no findings.")]
    caption = (
        "*Error*: results would be wrong. *Warning*: check the data before you continue. *Note*: "
        "information."
    )
    heads = {"what": "kind", "in words": "finding"}
    return [TableBlock("findings", _rows(findings), caption, heads=heads)]


def _usage(found: Examination, lines: list[str]) -> str:
    words = " \\\n    ".join(lines)
    commands = [f"nnode prepare_data {words}"]
    commands += _next(found, words)
    shell, python = "\n".join(commands), "\n".join(python_lines(found))
    return f"```sh\n{shell}\n```\n\nIn Python:\n\n```python\n{python}\n```"


def _columns(found: Examination) -> list[Block]:
    if not found.meanings or found.raw.table is None:
        return []
    frame = found.raw.table.frame
    how = {
        "named": "column name",
        "like": "similar column name",
        "holds": "content",
    }
    by = {one.column: (meaning, one) for meaning, one in found.meanings.items()}
    rows = {}
    for column in map(str, frame.columns):
        meaning, one = by.get(column, ("not used", None))
        cells = frame[column]
        values = pd.Series(floats(cells)).dropna()
        numeric = len(values) > 0
        rows[column] = {
            "meaning": meaning,
            "because": "" if one is None else how[one.sure],
            "least": f"{values.min():.6g}" if numeric else "",
            "greatest": f"{values.max():.6g}" if numeric else "",
            "different": cells.dropna().map(quoted).nunique(),
            "empty": int(cells.isna().sum()),
        }
    table = pd.DataFrame(rows).T.rename_axis("column")
    heads = {
        "because": "recognised by",
        "least": "minimum",
        "greatest": "maximum",
        "different": "distinct values",
        "empty": "missing values",
    }
    caption = "Recognised meaning of each column."
    return [Heading("Columns"), TableBlock("columns", table, caption, heads=heads)]


def _units_blocks(found: Examination) -> list[Block]:
    scale, known = found.scale, found.known
    usual = USUAL[scale.domain]
    values = {
        "speed of moving agents (m/s)": (known.speed * scale.metres / scale.seconds, "speed"),
        "distance to the nearest agent (m)": (known.nearest * scale.metres, "nearest"),
        "length (m)": (known.length * scale.metres, "length"),
        "sway (1/s)": (known.sway / scale.seconds, "sway"),
        "sampling interval (s)": (known.dt * scale.seconds, INTERVAL),
        "speed from positions / speed in the file": (
            known.ratio * scale.metres / (scale.per_second * scale.seconds),
            AGREE,
        ),
    }
    rows = {}
    for name, (value, where) in values.items():
        range_ = usual.get(where) if isinstance(where, str) else where
        if np.isfinite(value) and isinstance(range_, Range):
            rows[name] = {
                "here": value,
                "usual": f"{range_.low:g} to {range_.high:g}",
                "source": range_.source,
            }
    blocks: list[Block] = [
        Heading("Units and time scale"),
        Text(f"Assumed: {_units(found)} ({certainty(share(found.scales))})."),
        TableBlock(
            "medians",
            pd.DataFrame(rows).T,
            "Medians in SI units, and usual ranges.",
            heads={"here": "median", "usual": "usual range"},
        ),
    ]
    if len(found.scales) > 1:
        table = pd.DataFrame(
            [
                {
                    "of": s.domain,
                    "positions": s.position,
                    "times": s.time,
                    "frames/s": s.rate,
                    "speeds": s.speed,
                    "probability": s.probability,
                }
                for s in found.scales
            ]
        )
        blocks.append(
            TableBlock(
                "units",
                table.head(6),
                "Combinations of units by the agreement of these medians with the usual ranges. "
                "The CSV file contains all combinations.",
                digits={"probability": 3},
                full=table,
                heads={"of": "domain"},
            )
        )
    return blocks


def _figures(found: Examination) -> list[Block]:
    from nnode.plots import check as plots  # loads Matplotlib, which takes a second
    from nnode.plots.quality import faults_figure

    rows, domain = found.rows, found.scale.domain
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
    if found.faults:
        shown.append(
            FigureBlock(
                "faults",
                faults_figure(found.sequences, found.faults, domain, 10),
                f"Sequences of data={found.source.group} with marked faults; the first 10 of "
                f"{len(found.faults)}.",
                "Positions over time of faulty sequences, faults marked.",
            )
        )
    return shown


def _made() -> Provenance:
    return Provenance(how_made(("numpy", "pandas", "scipy", "matplotlib")))
