"""Pages of results: text, tables and figures as one HTML file, as Markdown, and as CSV."""

from __future__ import annotations

import base64
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markdown_it import MarkdownIt
from markupsafe import Markup
from matplotlib.figure import Figure

from nnode.errors import ConfigError
from nnode.files import write_text
from nnode.pages import tables
from nnode.pages.replay import ReplayBlock
from nnode.plots.style import save

#: Folder of the figures in the folder of the page.
FIGURES = "figures"

#: Pixels of a style sheet in an inch.
_PIXELS = 96

#: Code in Markdown: fenced lines, and spans within a paragraph.
_CODE = re.compile(
    r"(^```[^`\n]*\n.*?^```[ ]*$|(?<!`)(?P<ticks>`+)(?!`)(?:(?!\n\s*\n).)+?(?<!`)(?P=ticks)(?!`))",
    re.M | re.S,
)

#: Tables with more rows are folded.
ROWS = 12

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass
class Heading:
    """The heading of a section; level 2 is the highest, below the page's title.

    A folded section is opened by its heading, by a link into it, and when the page is printed. In
    Markdown it is an ordinary section.
    """

    text: str
    level: int = 2
    folded: bool = False


@dataclass
class Text:
    """Paragraphs, lists, links, code and emphasis in Markdown; no headings, images or HTML."""

    markdown: str


@dataclass
class TableBlock:
    """A table, and the file ``<name>.csv`` with its numbers in full.

    Attributes:
        name: name of the file; ``[text](#table-<name>)`` refers to the table.
        frame: the shown table; its index labels the rows.
        caption: caption in Markdown, with the units.
        bold: True for the cells in bold.
        digits: number of digits after the point, for all columns or by column.
        full: the content of the CSV file, if it is more than the shown table.
    """

    name: str
    frame: pd.DataFrame
    caption: str
    bold: pd.DataFrame | None = None
    digits: dict[str, int] | int = tables.DIGITS
    full: pd.DataFrame | None = None

    def grid(self) -> tables.Grid:
        """The table as cells of text."""
        return tables.grid(self.frame, digits=self.digits, bold=self.bold)

    def csv(self) -> str:
        """The full table as CSV."""
        return tables.csv(self.frame if self.full is None else self.full)


@dataclass
class FigureBlock:
    """A figure, and the file ``figures/<name>.png``.

    Attributes:
        name: name of the file; ``[text](#figure-<name>)`` refers to the figure.
        figure: a figure of :mod:`nnode.plots`.
        caption: caption in Markdown.
        alt: description of the figure for readers who cannot see it.
    """

    name: str
    figure: Figure
    caption: str
    alt: str


@dataclass
class Provenance:
    """Facts on how a page was made, which stand at its foot. Several blocks are joined."""

    facts: dict[str, str]


Block = Heading | Text | TableBlock | FigureBlock | ReplayBlock | Provenance


def write_page(
    blocks: list[Block], folder: Path, *, title: str, subtitle: str = "", stem: str = "study"
) -> list[Path]:
    """Write ``<stem>.html``, ``<stem>.md``, a CSV per table and a PNG per figure.

    The HTML file contains the style, figures, players and the tables' CSV. It needs no other file
    and no network. The Markdown file refers to the CSV and PNG files. Each file is replaced as a
    whole, the pages last.

    Args:
        blocks: the content of the page, in order.
        folder: folder of the files, created if it is missing.
        subtitle: one sentence in Markdown below the title.

    Returns:
        The paths: HTML, Markdown, then the tables and figures in their order.

    Raises:
        ValueError: two blocks have the same name, a name cannot be that of a file, or a figure has
            no alternative text.
        ConfigError: the folder cannot be written to.
    """
    _check(blocks)
    paths = []
    try:
        for block in blocks:
            if isinstance(block, TableBlock):
                paths.append(write_text(folder / f"{block.name}.csv", block.csv()))
            elif isinstance(block, FigureBlock):
                paths.append(save(block.figure, folder / FIGURES / f"{block.name}.png"))
        markdown = write_text(folder / f"{stem}.md", _markdown(blocks, title, subtitle, stem))
        html = write_text(folder / f"{stem}.html", _html(blocks, folder, title, subtitle))
    except OSError as error:
        raise ConfigError(
            f"the page cannot be written to {folder} ({error}); choose another folder"
        ) from error
    return [html, markdown, *paths]


def write_player(block: ReplayBlock, path: Path, *, title: str) -> Path:
    """Write a page with one player; it needs no other file and no network.

    Raises:
        ConfigError: the path does not end in ``.html``, or cannot be written to.
    """
    if path.suffix.lower() != ".html":
        raise ConfigError(f"a player is a page: expected a path ending in .html, got {path}")
    _check([block])
    try:
        return write_text(path, _html([block], path.parent, title, ""))
    except OSError as error:
        raise ConfigError(
            f"the player cannot be written to {path} ({error}); choose another folder"
        ) from error


def _check(blocks: list[Block]) -> None:
    named = [b for b in blocks if isinstance(b, TableBlock | FigureBlock | ReplayBlock)]
    for what, kind in (("tables", TableBlock), ("figures", FigureBlock | ReplayBlock)):
        names = Counter(block.name.casefold() for block in named if isinstance(block, kind))
        twice = [name for name, count in names.items() if count > 1]
        if twice:
            raise ValueError(f"several of the page's {what} are named {', '.join(twice)}")
    for block in named:
        if not _NAME.fullmatch(block.name):
            raise ValueError(f"{block.name!r} cannot be used as a file name")
        if not isinstance(block, TableBlock) and not block.alt.strip():
            raise ValueError(f"figure {block.name} has no alternative text")
    for heading in (block for block in blocks if isinstance(block, Heading)):
        if not 2 <= heading.level <= 4:
            raise ValueError(f"heading {heading.text!r} has level {heading.level}, expected 2 to 4")


def _facts(blocks: list[Block]) -> dict[str, str]:
    provenances = (block for block in blocks if isinstance(block, Provenance))
    return {name: fact for block in provenances for name, fact in block.facts.items()}


def _markdown(blocks: list[Block], title: str, subtitle: str, stem: str) -> str:
    text = _ENVIRONMENT.get_template("page.md").render(
        title=title,
        subtitle=subtitle,
        blocks=blocks,
        stem=stem,
        figures=FIGURES,
        facts=_facts(blocks),
    )
    return text.strip() + "\n"


def _markdown_table(block: TableBlock) -> str:
    grid = block.grid()
    names = [tables.column_name(name) for name in block.frame.columns]
    head = grid.head[-1]
    labels = [cell.text for cell in head[: len(head) - len(names)]]
    sides = ["---:" if cell.right else "---" for cell in head[len(labels) :]]
    lines = [list(map(tables.markdown, labels + names)), ["---"] * len(labels) + sides]
    for row in grid.rows:
        texts = [(tables.markdown(cell.text), cell.bold) for part in row for cell in part]
        lines.append([f"**{text}**" if bold else text for text, bold in texts])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _without_html(markdown: str) -> str:
    """The text of a block without HTML and images, as on the HTML page."""
    parts, end = [], 0
    for code in _CODE.finditer(markdown.strip()):
        parts += [_plain(markdown.strip()[end : code.start()]), code.group()]
        end = code.end()
    return "".join([*parts, _plain(markdown.strip()[end:])])


def _plain(text: str) -> str:
    return text.replace("<", "&lt;").replace("![", "\\![")


def _html(blocks: list[Block], folder: Path, title: str, subtitle: str) -> str:
    text = MarkdownIt("commonmark", {"html": False}).disable(["image", "heading", "lheading"])
    taken: Counter[str] = Counter()
    parts: list[dict[str, Any]] = []
    contents: list[dict[str, Any]] = []
    fold: int | None = None  # level of the folded section that is open

    def add(kind: str, block: TableBlock | FigureBlock | ReplayBlock, **content: Any) -> None:
        caption = Markup(text.renderInline(block.caption.strip()))
        parts.append({"kind": kind, "name": block.name, "caption": caption, **content})

    for block in [*blocks, None]:
        if fold and (block is None or (isinstance(block, Heading) and block.level <= fold)):
            parts.append({"kind": "end of fold"})
            fold = None
        match block:
            case Heading(words, level, folded):
                slug = _slug(words, taken)
                fold = level if folded and fold is None else fold
                part = {"kind": "heading", "text": words, "level": level, "id": slug}
                parts.append({**part, "folded": folded and fold == level})
                if level <= 3:
                    contents.append(parts[-1])
            case Text(markdown):
                parts.append({"kind": "text", "html": Markup(text.render(markdown))})
            case TableBlock():
                grid, csv = block.grid(), _base64(block.csv().encode())
                add("table", block, grid=grid, csv=csv, folded=len(block.frame) > ROWS)
            case FigureBlock():
                width, height = (round(_PIXELS * side) for side in block.figure.get_size_inches())
                png = _base64((folder / FIGURES / f"{block.name}.png").read_bytes())
                add("figure", block, alt=block.alt.strip(), png=png, width=width, height=height)
            case ReplayBlock():
                data, said = block.data()
                add("replay", block, alt=block.alt.strip(), data=Markup(data), said=said)
    return _ENVIRONMENT.get_template("page.html").render(
        title=title,
        subtitle=Markup(text.renderInline(subtitle)),
        parts=parts,
        folds=any(part.get("folded") for part in parts),
        contents=contents,
        facts=_facts(blocks),
    )


_ENVIRONMENT = Environment(
    loader=PackageLoader("nnode.pages", "template"),
    autoescape=select_autoescape(),  # of HTML; Markdown has filters
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {
    "escaped": tables.markdown,
    "harmless": _without_html,
    "table": _markdown_table,
}


def _slug(words: str, taken: Counter[str]) -> str:
    """The anchor of a heading, as Markdown viewers derive it; unique on the page."""
    slug = re.sub(r"[^\w\- ]", "", words.lower()).strip().replace(" ", "-") or "section"
    taken[slug] += 1
    return slug if taken[slug] == 1 else f"{slug}-{taken[slug] - 1}"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
