"""A study's page: a template in Markdown that places tables, figures and a player of sequences.

A template ``studies/<name>/page.md.j2`` is text with headings of level 2 to 4. The results of the
study are its variable ``study``. A call makes a table or a figure, and its body is the caption::

    {% call table("costs", study.costs(), digits={"p": 3}) %}Mean cost (m² s).{% endcall %}
    {% call figure("laws", study.draw_laws(), "Ten panels of curves.") %}Speed by gap.{% endcall %}
    {% call player(study.scenes(), 100) %}Pairs as simulated by idm.{% endcall %}
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any, Literal

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from nnode.data.store import Store
from nnode.pages.page import Block, FigureBlock, Heading, Provenance, TableBlock, Text
from nnode.pages.replay import ReplayBlock, Scene
from nnode.pages.tables import DIGITS, number

Axis = Literal[0, 1]

#: Lines that are a heading, or that stand for a placed block.
_SEPARATE = re.compile(r"^(#{2,4} .+|\0\d+)$", re.M)


def page(
    name: str, study: Any = None, stores: Iterable[Store] = (), **constants: Any
) -> list[Block]:
    """The blocks of a study's page in the order of its template.

    Args:
        name: folder with the template.
        study: results, whose attributes and methods the template uses.
        stores: prepared data, whose files are named with their hashes.
        constants: further variables of the template.

    Raises:
        jinja2.UndefinedError: the template refers to something that does not exist.
    """
    placed: list[Block] = []

    def place(block: Block) -> str:
        placed.append(block)
        return f"\n\n\0{len(placed) - 1}\n\n"

    def table(
        name: str,
        frame: pd.DataFrame,
        digits: int | dict[str, int] = DIGITS,
        lowest: Iterable[str] = (),
        among: Iterable[Any] | None = None,
        axis: Axis = 0,
        head: int | None = None,
        *,
        caller: Callable[[], str],
    ) -> str:
        """Digits of columns that are not named are those of ``""``; ``lowest``: lowest_cells."""
        shown = frame.head(head) if head else frame
        if isinstance(digits, dict):
            digits = {c: digits.get(c, digits.get("", DIGITS)) for c in map(str, shown)}
        bold = lowest_cells(shown, lowest, among, axis)
        return place(TableBlock(name, shown, _line(caller()), bold, digits, frame))

    def figure(name: str, drawn: Figure, alt: str, *, caller: Callable[[], str]) -> str:
        return place(FigureBlock(name, drawn, _line(caller()), alt))

    def player(scenes: list[Scene], total: int, *, caller: Callable[[], str]) -> str:
        caption = (
            f"{_line(caller())} Outlines are measured agents. Arrows lead from the simulated to "
            "the measured position. The player opens on the sequence with the median error."
        )
        alt = f"Player of {len(scenes)} sequences: agents as measured and as simulated."
        return place(ReplayBlock("replay", scenes, caption, alt, total=total))

    environment = Environment(
        loader=PackageLoader("studies", name),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,  # Markdown; the page lets no HTML through
    )
    environment.filters["digits"] = number
    text = environment.get_template("page.md.j2").render(
        table=table, figure=figure, player=player, study=study, **constants
    )
    blocks: list[Block] = []
    for part in map(str.strip, _SEPARATE.split(text)):
        if part.startswith("\0"):
            blocks.append(placed[int(part[1:])])
        elif part.startswith("##"):
            level, heading = part.split(" ", 1)
            blocks.append(Heading(heading, len(level)))
        elif part:
            blocks.append(Text(part))
    hashes = {
        f"SHA-256 of {file['name']}": file["sha256"]
        for store in stores
        for file in store.manifest["files"].values()
    }
    return [*blocks, Provenance(hashes)] if hashes else blocks


def _line(text: str) -> str:
    return " ".join(text.split())


def lowest_cells(
    frame: pd.DataFrame,
    columns: Iterable[str],
    rows: Iterable[Any] | None = None,
    axis: Axis = 0,
) -> pd.DataFrame:
    """The cells that are set in bold: the least cell of each column, or of each row.

    Args:
        columns: labels of the compared columns.
        rows: labels of the compared rows; None: all.
        axis: 0 compares the rows of each column, 1 the columns of each row.
    """
    compared = frame[list(columns)].astype(float)
    compared = compared if rows is None else compared.loc[list(rows)]
    lowest = compared.eq(compared.min(axis=axis), axis=0 if axis else 1)
    return lowest.reindex_like(frame).eq(True)
