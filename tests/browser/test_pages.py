"""Reports in a real browser: offline, by keyboard, on a phone, and for eyes that see less."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from nnode.app.check import check_file
from nnode.diagnosis.report.page import draw
from tests.browser.chromium import MISSING, Browser
from tests.data.check.planted import cars, saved
from tests.diagnosis.conftest import Case, traffic  # noqa: F401  a fixture
from tests.diagnosis.report.test_page import CONFIG, with_faults

pytestmark = pytest.mark.skipif(bool(MISSING), reason=MISSING)

CHECKS = (Path(__file__).parent / "checks.js").read_text(encoding="utf-8")
STUDIES = Path(__file__).resolve().parents[2] / "docs" / "studies"
WIDTHS = {"desk": 1200, "phone": 360}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as found:
        yield found


@pytest.fixture(scope="module")
def pages(traffic: Case, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:  # noqa: F811
    """Pages by name: a diagnosis of made-up data, and the studies that are published."""
    folder = tmp_path_factory.mktemp("report")
    inputs, found = with_faults(traffic), deepcopy(traffic.found)
    found.diagnosis.data_faults = inputs.data_faults
    draw(inputs, found, traffic.options, CONFIG, ["nnode evaluate X"], folder)()
    check_file(saved(cars(), folder)).write(folder)
    studies = {name: STUDIES / name / "study.html" for name in ("traffic", "crowd")}
    own = {name: folder / f"{name}.html" for name in ("report", "check")}
    return {**own, **studies}


def opened(browser: Browser, page: Path, width: int) -> None:
    browser.open(page.as_uri(), width)
    browser.evaluate(f"window.checks = {CHECKS[CHECKS.index('({') :].rstrip().rstrip(';')}; 1")


def faults(browser: Browser, check: str) -> Any:
    return browser.evaluate(f"checks.{check}")


PAGES = list(itertools.product(("report", "check", "traffic", "crowd"), WIDTHS))


@pytest.mark.parametrize(("name", "width"), PAGES)
def test_a_page_is_sound(browser: Browser, pages: dict[str, Path], name: str, width: str) -> None:
    opened(browser, pages[name], WIDTHS[width])
    assert browser.complaints == []
    assert browser.requests == [pages[name].as_uri()]
    for check in (
        "elsewhere()",  # parts of the page that are not in its file
        "headings()",
        "silent()",  # pictures, tables and links without words
        "pale(4.5)",  # contrast of WCAG 2.2, level AA
        "small(12)",  # px
        f"wide({WIDTHS[width]})",
    ):
        assert faults(browser, check) == [], check


@pytest.mark.parametrize(("name", "width"), PAGES)
def test_all_that_can_be_used_is_reached_by_tab(
    browser: Browser, pages: dict[str, Path], name: str, width: str
) -> None:
    opened(browser, pages[name], WIDTHS[width])
    number = browser.evaluate("checks.interactive().length")
    assert number > 5
    for place in range(number):
        browser.press("Tab")
        focus = browser.evaluate("checks.focus()")
        assert focus["place"] == place, focus["name"]
        assert focus["seen"], f"{focus['name']} shows no focus"


def test_keys_skip_the_contents_and_scroll_tables(browser: Browser, pages: dict[str, Path]) -> None:
    opened(browser, pages["report"], WIDTHS["phone"])
    browser.press("Tab")
    assert browser.evaluate("document.activeElement.className") == "skip"
    browser.press("Enter")
    browser.press("Tab")
    assert browser.evaluate("!!document.activeElement.closest('main')")
    moves = (
        "[...document.querySelectorAll('.scroll')].find((e) => e.scrollWidth > e.clientWidth + 40)"
    )
    browser.evaluate(f"window.box = {moves}; box.focus(); 1")
    for _ in range(3):
        browser.press("ArrowRight")
    slid = "new Promise((done) => setTimeout(() => done(box.scrollLeft), 400))"
    assert browser.evaluate(slid) > 0


def test_links_and_print_open_folded_parts(browser: Browser, pages: dict[str, Path]) -> None:
    opened(browser, pages["report"], WIDTHS["phone"])
    parts = "[...document.querySelectorAll('details')].map((part) => part.open)"
    assert browser.evaluate(parts) == [False] * browser.evaluate(f"{parts}.length")
    link = "document.querySelector('nav a[href=\"#independent-clusters\"]')"
    browser.evaluate(f"{link}.click(); 1")
    inside = "document.querySelector('#table-clusters').checkVisibility()"
    assert browser.evaluate(inside)
    for check in ("silent()", "pale(4.5)", "small(12)", f"wide({WIDTHS['phone']})"):
        assert faults(browser, check) == [], check
    opened(browser, pages["report"], WIDTHS["desk"])
    browser.evaluate("dispatchEvent(new Event('beforeprint')); 1")
    assert all(browser.evaluate(parts))


BAD = """<!DOCTYPE html><html><head><title>t</title></head><body>
<h1>a</h1><h3>b</h3><p style="color:#999">pale</p><p style="font-size:8px">small</p>
<div style="width:900px">wide</div><img src="https://nowhere.example/x.png" alt="x">
<a href="#a" style="outline:none">one</a><a href="#b" tabindex="2">two</a>
<table><tr><th>x</th></tr></table><script>console.error("oh"); nothing.at.all</script></body></html>
"""


def test_a_bad_page_is_found_out(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text(BAD)
    opened(browser, page, WIDTHS["phone"])
    assert any("oh" in text for text in browser.complaints)
    assert any("nothing is not defined" in text for text in browser.complaints)
    assert any("ERR_NAME_NOT_RESOLVED" in text for text in browser.complaints)
    assert browser.requests == [page.as_uri(), "https://nowhere.example/x.png"]
    assert len(faults(browser, "elsewhere()")) == 1
    assert faults(browser, "headings()") == ["h3 follows h1"]
    assert len(faults(browser, "silent()")) == 6  # alt, head, scope, name, main, language
    assert faults(browser, "pale(4.5)") == ['p "pale": contrast 2.85']
    assert faults(browser, "small(12)") == ['p "small": 8px']
    assert 'div "wide" ends at 908 of 360 px' in faults(browser, "wide(360)")
    browser.press("Tab")
    assert browser.evaluate("checks.focus().place") == 1  # out of order
    browser.press("Tab")
    assert not browser.evaluate("checks.focus().seen")
