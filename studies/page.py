"""A study's page: a template in Markdown says where its tables, figures and players stand.

A template ``studies/<name>/page.md.j2`` is text with headings of level 2 to 4 and with these calls,
whose body is the caption (digits of columns that are not named: those of ``""``)::

    {% call table("costs", digits={"p": 3}, least=["held out"]) %}Mean cost (m² s).{% endcall %}
    {% call figure("laws", "Ten panels of speed against gap.") %}Speed by gap.{% endcall %}
    {{ player("replay") }}
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from nnode.data.store import Store
from nnode.pages.page import Block, FigureBlock, Heading, Provenance, TableBlock, Text
from nnode.pages.replay import ReplayBlock
from nnode.pages.tables import DIGITS, number

_BLOCK = re.compile(r"^(?:(?P<level>#{2,4}) (?P<heading>.+)|\0(?P<place>\d+)\0)$", re.M)


def page(
    study: str,
    tables: Mapping[str, pd.DataFrame],
    figures: Mapping[str, Figure | ReplayBlock],
    stores: Iterable[Store] = (),
    **values: Any,
) -> list[Block]:
    """The blocks of a study's page in the order of its template.

    Args:
        study: name of the folder with the template.
        tables, figures: by the names that the template gives them.
        stores: prepared data, whose files are named with their hashes.
        values: all else that the template refers to.

    Raises:
        KeyError: the template names a table or a figure that is not there.
        jinja2.UndefinedError: the template refers to a value that is not there.
    """
    placed: list[Block] = []

    def place(block: Block) -> str:
        placed.append(block)
        return f"\n\n\0{len(placed) - 1}\0\n\n"

    def table(
        name: str,
        digits: int | dict[str, int] = DIGITS,
        least: Iterable[str] = (),
        among: Iterable[Any] | None = None,
        row: Iterable[str] = (),
        head: int | None = None,
        *,
        caller: Callable[[], str],
    ) -> str:
        frame = tables[name]
        shown = frame.head(head) if head else frame
        if isinstance(digits, dict):
            digits = {c: digits.get(c, digits.get("", DIGITS)) for c in map(str, shown)}
        bold = least_cells(shown, least, among, row)
        return place(TableBlock(name, shown, _line(caller()), bold, digits, frame))

    def figure(name: str, alt: str, *, caller: Callable[[], str]) -> str:
        drawn = figures[name]
        assert isinstance(drawn, Figure)
        return place(FigureBlock(name, drawn, _line(caller()), alt))

    def player(name: str) -> str:
        replay = figures[name]
        assert isinstance(replay, ReplayBlock)
        return place(replay)

    environment = Environment(
        loader=PackageLoader("studies", study),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,  # Markdown; the page lets no HTML through
    )
    environment.filters["digits"] = number
    text = environment.get_template("page.md.j2").render(
        table=table, figure=figure, player=player, tables=tables, **values
    )
    hashes = {
        f"SHA-256 of {file['name']}": file["sha256"]
        for store in stores
        for file in store.manifest["files"].values()
    }
    return [*_blocks(text, placed), Provenance(hashes)]


def _line(text: str) -> str:
    return " ".join(text.split())


def _blocks(text: str, placed: list[Block]) -> list[Block]:
    blocks: list[Block] = []
    end = 0
    for match in [*_BLOCK.finditer(text), None]:
        between = text[end : match.start() if match else None].strip()
        if between:
            blocks.append(Text(between))
        if match and match["heading"]:
            blocks.append(Heading(match["heading"], len(match["level"])))
        elif match:
            blocks.append(placed[int(match["place"])])
        end = match.end() if match else end
    return blocks


def least_cells(
    frame: pd.DataFrame,
    columns: Iterable[str] = (),
    among: Iterable[Any] | None = None,
    row: Iterable[str] = (),
) -> pd.DataFrame:
    """Which cells are set in bold: the least ones.

    Args:
        columns: in each of these the least cell.
        among: labels of the rows that are compared; None: all.
        row: columns that are compared in each row.
    """
    bold = pd.DataFrame(False, frame.index, frame.columns)
    for name in columns:
        bold.loc[
            frame[name].loc[list(frame.index if among is None else among)].astype(float).idxmin(),
            name,
        ] = True
    if compared := list(row):
        bold[compared] = frame[compared].eq(frame[compared].min(axis=1), axis=0)
    return bold
