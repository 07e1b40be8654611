"""Pages: a self-contained HTML file, the same in Markdown, and the tables as CSV."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from markdown_it import MarkdownIt

from nnode.errors import ConfigError
from nnode.files import csv_cell, csv_text
from nnode.pages.page import (
    Block,
    FigureBlock,
    Heading,
    Provenance,
    TableBlock,
    Text,
    write_page,
)
from nnode.pages.tables import markdown, number
from nnode.plots.style import dress, new_figure

#: Elements without an end tag.
VOID = {"meta", "img", "br", "hr", "link", "input"}


class Reader(HTMLParser):
    """Parses elements in order, texts of tables, and unclosed elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.bold: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "table" in self.open and {"td", "th"} & set(self.open):
            self.tables[-1][-1][-1] += data
            if "strong" in self.open:
                self.bold.append(data)

    def all(self, name: str) -> list[str]:
        return [attributes[name] for _, attributes in self.elements if name in attributes]


def costs() -> pd.DataFrame:
    frame = pd.DataFrame(
        np.random.default_rng(3).normal(20, 30, (3, 4)),
        index=pd.Index(["Lin", "Log", "N2"], name="model"),
        columns=["1-1_1", "1-1_2", "1-2_1", "average"],
    )
    frame.loc["Log", "1-1_2"] = np.nan
    return frame


def nested() -> pd.DataFrame:
    index = pd.MultiIndex.from_tuples([("SF", 1.0), ("SF", 3.0), ("NN", 1.0)], names=["law", "T"])
    columns = pd.MultiIndex.from_product([["training", "held out"], ["J", "n"]])
    values = [[1.25, 80, -0.5, 26], [1e-6, 79, 3.5e9, 25], [0.0, 1, np.inf, 2]]
    frame = pd.DataFrame(values, index=index, columns=columns)
    return frame.astype({("training", "n"): int, ("held out", "n"): int})


def blocks() -> list[Block]:
    figure = new_figure(6.0, 3.0)
    ax = figure.subplots()
    ax.plot([0, 1], [1, 2])
    dress(ax, x="gap (m)", y="speed (m/s)")
    frame = costs()
    return [
        Text("See [costs](#table-costs), [speeds](#figure-speeds), [below](#costs-in-m²-s-1)."),
        Heading("Costs in m² s"),
        TableBlock("costs", frame, "Costs, *least* in bold.", bold=frame.eq(frame.min()), digits=3),
        Heading("Costs in m² s", 3),
        TableBlock("nested", nested(), "By part & horizon <T>."),
        Text("A <script>alert(1)</script> & <b>b</b> ![x](https://example.org/x.png)"),
        Heading("Figures"),
        FigureBlock("speeds", figure, "**Speeds** rise.", 'A line that "rises".'),
        TableBlock("rows", pd.DataFrame({"a|b": ["x|y", "z"], "c": [True, False]}), "Two rows."),
        Provenance({"data": "sha256 0123"}),
        Provenance({"machine": "two cores"}),
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page") / "new"
    paths = write_page(blocks(), folder, title="A & B", subtitle="With *care*.")
    assert all(path.is_file() for path in paths)
    names = ["study.html", "study.md", "costs.csv", "nested.csv", "speeds.png", "rows.csv"]
    assert [path.name for path in paths] == names
    files = {path.name for path in folder.rglob("*") if path.is_file()}
    assert files == set(names)  # no other file
    return folder


@pytest.fixture(scope="module")
def html(folder: Path) -> Reader:
    return Reader((folder / "study.html").read_text(encoding="utf-8"))


def test_html_is_valid_and_self_contained(folder: Path, html: Reader) -> None:
    assert html.open == []
    ids = html.all("id")
    assert len(ids) == len(set(ids))
    for link in html.all("href"):
        # links to other sites are allowed
        assert link.startswith(("#", "data:text/csv;", "https://example.org/"))
        assert not link.startswith("#") or unquote(link[1:]) in ids
    assert all(source.startswith("data:image/png;base64,") for source in html.all("src"))
    tags = {tag for tag, _ in html.elements}
    assert not tags & {"script", "link", "iframe", "b"}
    assert len([tag for tag, _ in html.elements if tag == "img"]) == 1
    text = (folder / "study.html").read_text(encoding="utf-8")
    style = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style


def test_html_is_accessible(html: Reader) -> None:
    elements = html.elements
    assert ("html", {"lang": "en"}) in elements
    assert any(a.get("name") == "viewport" for _, a in elements)
    (image,) = (attributes for tag, attributes in elements if tag == "img")
    assert image["alt"] == 'A line that "rises".'
    assert (image["width"], image["height"]) == ("576", "288")
    boxes = [a for tag, a in elements if tag == "div"]
    assert len(boxes) == 4
    for box in boxes:
        assert (box["tabindex"], box["role"]) == ("0", "region")
        assert box["aria-labelledby"] in html.all("id")
    levels = [int(tag[1]) for tag, _ in elements if re.fullmatch(r"h\d", tag)]
    assert levels == [1, 2, 3, 2, 2]
    links = [a["href"] for tag, a in elements if tag == "a"]
    assert links[0] == "#text"  # skips the contents
    assert links[1:4] == ["#costs-in-m²-s", "#costs-in-m²-s-1", "#figures"]


def test_tables_agree_with_csv_files(folder: Path, html: Reader) -> None:
    frame = costs()
    exact = pd.read_csv(folder / "costs.csv", index_col="model")
    pd.testing.assert_frame_equal(exact, frame, check_exact=True)
    head, *rows = html.tables[0]
    assert head == ["model", *frame.columns]
    for row, (label, values) in zip(rows, exact.iterrows(), strict=True):
        shown = [float(cell.replace("−", "-").replace("–", "nan")) for cell in row[1:]]
        assert row[0] == label
        np.testing.assert_allclose(shown, values, atol=0.5001e-3, equal_nan=True)
    least = [f"{x:.3f}".replace("-", "−") for x in frame.min()]
    assert html.bold[:4] == [cell for row in rows for cell in row if cell in least]
    links = [a for tag, a in html.elements if tag == "a" and "download" in a]
    for link in links:
        content = base64.b64decode(link["href"].partition("base64,")[2])
        assert content == (folder / link["download"]).read_bytes()
    assert [link["download"] for link in links] == ["costs.csv", "nested.csv", "rows.csv"]


def test_nested_rows_and_columns(folder: Path, html: Reader) -> None:
    above, head, *rows = html.tables[1]
    assert above == ["", "", "training", "held out"]
    assert head == ["law", "T", "J", "n", "J", "n"]
    assert rows == [
        ["SF", "1", "1.25", "80", "−0.50", "26"],
        ["SF", "3", "1e−6", "79", "3.5e9", "25"],
        ["NN", "1", "0.00", "1", "∞", "2"],
    ]
    exact = pd.read_csv(folder / "nested.csv")
    names = ["law", "T", "training J", "training n", "held out J", "held out n"]
    assert list(exact.columns) == names
    np.testing.assert_array_equal(exact.iloc[:, 2:].to_numpy(), nested().to_numpy())


def test_markdown_has_the_same_tables(folder: Path, html: Reader) -> None:
    text = (folder / "study.md").read_text(encoding="utf-8")
    tables = re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE)
    assert len(tables) == len(html.tables)
    for table, shown in zip(tables, html.tables, strict=True):
        lines = [re.split(r"(?<!\\)\|", line)[1:-1] for line in table.splitlines()]
        cells = [[cell.strip().strip("*").replace("\\|", "|") for cell in row] for row in lines]
        assert cells[2:] == shown[-len(cells[2:]) :]
        assert {len(row) for row in cells} == {len(shown[-1])}
    for link in re.findall(r"\]\(([^#)][^)]*)\)", text):
        assert link.startswith("https://example.org/") or (folder / link).is_file()
    for place in re.findall(r"\(#((?:table|figure)-[^)]*)\)", text):
        assert f'<a id="{place}"></a>' in text
    assert "- data: sha256 0123\n- machine: two cores" in text


def test_full_table_is_in_csv_only(tmp_path: Path) -> None:
    full = pd.DataFrame({"x": [1 / 3, 0.1 + 0.2]})
    table = TableBlock("t", pd.DataFrame({"mean": [0.3]}), "Mean.", full=full)
    _, _, path = write_page([table], tmp_path, title="T")
    pd.testing.assert_frame_equal(pd.read_csv(path), full, check_exact=True)
    assert Reader((tmp_path / "study.html").read_text()).tables == [[["mean"], ["0.30"]]]


def test_sections_and_long_tables_are_folded_in_html(tmp_path: Path) -> None:
    rows = pd.DataFrame({"p": [0.5] * 13})
    page = [
        Heading("First"),
        Heading("Last", folded=True),
        Heading("Within", 3),
        TableBlock("t", rows, "Long."),
        Heading("Open"),
        TableBlock("u", rows.head(12), "Short."),
    ]
    write_page(page, tmp_path, title="T")
    text = (tmp_path / "study.html").read_text()
    html = Reader(text)
    assert html.open == []
    parts = [tag for tag, _ in html.elements if tag in ("h2", "h3", "table", "details", "summary")]
    inside = ["details", "summary", "h2", "h3", "details", "summary", "table"]
    assert parts == ["h2", *inside, "h2", "table"]
    assert text.index("</details>\n<h2") > text.index('id="table-t"')
    assert len(html.tables) == 2
    assert "\n## Last\n" in (tmp_path / "study.md").read_text()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.005, "1.00"),
        (-2.5, "−2.50"),
        (0.0, "0.00"),
        (0.0044, "0.0044"),
        (-0.00001, "−1e−5"),
        (123456.0, "123456.00"),
        (2.5e8, "2.5e8"),
        (float("nan"), "–"),
        (float("-inf"), "−∞"),
        (None, "–"),
        (np.int64(-7), "−7"),
        (np.float32(0.5), "0.50"),
        (np.bool_(True), "yes"),
        ("1-1_1", "1-1_1"),
    ],
)
def test_number_formats(value: object, text: str) -> None:
    assert number(value) == text


def test_digits_by_column() -> None:
    frame = pd.DataFrame({"a": [1.23456], "b": [1.23456]}, index=["x"])
    block = TableBlock("t", frame, "T.", digits={"a": 4})
    assert [cell.text for cell in block.grid().rows[0][1]] == ["1.2346", "1.23"]
    assert pd.read_csv(io.StringIO(block.csv())).shape == (1, 3)


def test_invalid_pages_are_refused(tmp_path: Path) -> None:
    frame = pd.DataFrame({"a": [1.0]})
    figure = new_figure(2.0, 2.0)
    invalid: dict[str, list[Block]] = {
        "tables are named t": [TableBlock("t", frame, "T."), TableBlock("T", frame, "T.")],
        "'a/b' cannot be used": [TableBlock("a/b", frame, "T.")],
        "figure f has no alternative": [FigureBlock("f", figure, "F.", " ")],
        "has level 1": [Heading("Title", 1)],
        "rows and columns of the frame": [TableBlock("t", frame, "T.", bold=frame.T.eq(1))],
    }
    for message, page in invalid.items():
        with pytest.raises(ValueError, match=message):
            write_page(page, tmp_path / "x", title="T")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="page cannot be written to"):
        write_page([Text("t")], tmp_path / "file", title="T")


HOSTILE = (
    "<script>alert(1)</script>",
    "![x](https://example.org/x.png)",
    "[x](https://example.org)",
    "a|b",
    "`<b>`",
    "*a* _b_ **c**",
    "&lt;i&gt; \\<i>",
    "a\n\n# b\x1b[31m",
)


@pytest.mark.parametrize("name", HOSTILE)
def test_text_from_files_is_escaped_in_markdown(tmp_path: Path, name: str) -> None:
    frame = pd.DataFrame({name: [name]}, index=pd.Index([name], name=name))
    page = [Heading(name), TableBlock("t", frame, f"Of {markdown(name)}."), Provenance({"a": name})]
    write_page(page, tmp_path, title=name, subtitle=f"S {markdown(name)}", stem="page")
    text = (tmp_path / "page.md").read_text()
    assert "\x1b" not in text
    html = MarkdownIt("commonmark", {"xhtmlOut": False}).enable("table").render(text)
    shown = Reader(html)
    tags = {tag for tag, _ in shown.elements}
    table_tags = {"table", "thead", "tbody", "tr", "th", "td"}
    assert tags <= {"h1", "h2", "p", "a", "hr", "ul", "li"} | table_tags
    assert shown.all("href") == ["t.csv"]
    plain = re.sub(r"\s+", " ", name).replace("\x1b", r"\x1b")
    assert [cell.strip() for row in shown.tables[0] for cell in row] == [plain] * 4


@pytest.mark.parametrize(
    "text",
    [
        "<script>alert(1)</script>",
        "`a` <img src=x> `b`",
        "`` ` `` <img src=x>",
        "` a\n\n<img src=x> `",
        "```sh\nls\n```\n<img src=x>",
        "```\nnever ended <img src=x>",
        "![x](https://example.org/x.png)",
    ],
)
def test_paragraphs_contain_no_html_and_no_images(tmp_path: Path, text: str) -> None:
    write_page([Text(text)], tmp_path, title="a", stem="page")
    html = MarkdownIt("commonmark", {"xhtmlOut": False}).render((tmp_path / "page.md").read_text())
    assert not {tag for tag, _ in Reader(html).elements} & {"script", "img"}


def test_code_is_not_escaped(tmp_path: Path) -> None:
    code = "If `a < b` then a < b.\n\n```python\nif a < b: pass\n```"
    write_page([Text(code)], tmp_path, title="a", stem="page")
    text = (tmp_path / "page.md").read_text()
    assert "If `a < b` then a &lt; b." in text
    assert "if a < b: pass" in text


def test_csv_cells_are_no_formulas(tmp_path: Path) -> None:
    escaped = {
        "=1+1": "'=1+1",
        "+a": "'+a",
        "-a": "'-a",
        "@a": "'@a",
        "\ta": "'\ta",
        "\ra": "'\ra",
        "'=a": "''=a",
    }
    unchanged = {"-1.5": "-1.5", "+3e2": "+3e2", "plain": "plain", "": "", None: "", -2: "-2"}
    cells = [*escaped, *unchanged]
    frame = pd.DataFrame({"=name": cells, "x": np.arange(-6.0, 7)})
    text = csv_text(frame)
    table = pd.read_csv(io.StringIO(text), keep_default_na=False, dtype=str)
    assert list(table) == ["'=name", "x"]
    assert list(table["'=name"]) == [*escaped.values(), *unchanged.values()]
    assert [float(x) for x in table["x"]] == list(frame["x"])
    strings = [cell for cell in cells if isinstance(cell, str)]
    assert [csv_cell(cell) for cell in table["'=name"][: len(strings)]] == strings
    assert TableBlock("t", frame, "").csv() == text
