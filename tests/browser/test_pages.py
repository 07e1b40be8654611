"""Reports in a browser: offline, by keyboard, on a phone, and with sufficient contrast."""

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
    with Browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def pages(traffic: Case, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:  # noqa: F811
    """Pages by name: a diagnosis and a check of simulated data, and the published studies."""
    folder = tmp_path_factory.mktemp("report")
    inputs, outcome = with_faults(traffic), deepcopy(traffic.found)
    outcome.diagnosis.data_faults = inputs.data_faults
    draw(inputs, outcome, traffic.options, CONFIG, ["nnode evaluate X"], folder)()
    check_file(saved(cars(), folder)).write(folder)
    studies = {name: STUDIES / name / "study.html" for name in ("traffic", "crowd")}
    return {"report": folder / "report.html", "check": folder / "check.html", **studies}


def opened(browser: Browser, page: Path, width: int) -> None:
    browser.open(page.as_uri(), width)
    browser.evaluate(f"window.checks = {CHECKS[CHECKS.index('({') :].rstrip().rstrip(';')}; 1")


def faults(browser: Browser, check: str) -> Any:
    return browser.evaluate(f"checks.{check}")


PAGES = list(itertools.product(("report", "check", "traffic", "crowd"), WIDTHS))


@pytest.mark.parametrize(("name", "width"), PAGES)
def test_page_is_accessible_and_self_contained(
    browser: Browser, pages: dict[str, Path], name: str, width: str
) -> None:
    opened(browser, pages[name], WIDTHS[width])
    assert browser.complaints == []
    assert browser.requests == [pages[name].as_uri()]
    for check in (
        "external()",
        "headings()",
        "unlabelled()",
        "lowContrast(4.5)",  # WCAG 2.2, level AA
        "smallText(12)",  # px
        f"overflow({WIDTHS[width]})",
    ):
        assert faults(browser, check) == [], check


@pytest.mark.parametrize(("name", "width"), PAGES)
def test_tab_reaches_all_controls(
    browser: Browser, pages: dict[str, Path], name: str, width: str
) -> None:
    opened(browser, pages[name], WIDTHS[width])
    number = browser.evaluate("checks.interactive().length")
    assert number > 5
    for index in range(number):
        browser.press("Tab")
        focus = browser.evaluate("checks.focus()")
        assert focus["index"] == index, focus["name"]
        assert focus["visible"], f"{focus['name']} shows no focus"


def test_keys_skip_the_contents_and_scroll_tables(browser: Browser, pages: dict[str, Path]) -> None:
    opened(browser, pages["report"], WIDTHS["phone"])
    browser.press("Tab")
    assert browser.evaluate("document.activeElement.className") == "skip"
    browser.press("Enter")
    browser.press("Tab")
    assert browser.evaluate("!!document.activeElement.closest('main')")
    scrollable = (
        "[...document.querySelectorAll('.scroll')].find((e) => e.scrollWidth > e.clientWidth + 40)"
    )
    browser.evaluate(f"window.box = {scrollable}; box.focus(); 1")
    for _ in range(3):
        browser.press("ArrowRight")
    position = "new Promise((done) => setTimeout(() => done(box.scrollLeft), 400))"
    assert browser.evaluate(position) > 0


def test_links_and_print_open_folded_parts(browser: Browser, pages: dict[str, Path]) -> None:
    opened(browser, pages["report"], WIDTHS["phone"])
    parts = "[...document.querySelectorAll('details')].map((part) => part.open)"
    assert browser.evaluate(parts) == [False] * browser.evaluate(f"{parts}.length")
    link = "document.querySelector('nav a[href=\"#independent-clusters\"]')"
    browser.evaluate(f"{link}.click(); 1")
    inside = "document.querySelector('#table-clusters').checkVisibility()"
    assert browser.evaluate(inside)
    for check in (
        "unlabelled()",
        "lowContrast(4.5)",
        "smallText(12)",
        f"overflow({WIDTHS['phone']})",
    ):
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


def test_checks_detect_the_faults_of_a_page(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text(BAD)
    opened(browser, page, WIDTHS["phone"])
    for complaint in ("oh", "nothing is not defined", "ERR_NAME_NOT_RESOLVED"):
        assert any(complaint in text for text in browser.complaints)
    assert browser.requests == [page.as_uri(), "https://nowhere.example/x.png"]
    assert len(faults(browser, "external()")) == 1
    assert faults(browser, "headings()") == ["h3 follows h1"]
    assert len(faults(browser, "unlabelled()")) == 6  # alt, head, scope, name, main, language
    assert faults(browser, "lowContrast(4.5)") == ['p "pale": contrast 2.85']
    assert faults(browser, "smallText(12)") == ['p "small": 8px']
    assert 'div "wide" ends at 908 of 360 px' in faults(browser, "overflow(360)")
    browser.press("Tab")
    assert browser.evaluate("checks.focus().index") == 1  # out of order
    browser.press("Tab")
    assert not browser.evaluate("checks.focus().visible")
