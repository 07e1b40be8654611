"""TensorBoard in a browser with the curves of a training."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any
from urllib.request import urlopen

import pytest

from nnode.calibrate.logbook import Logbook
from tests.browser.chromium import MISSING, Browser

COSTS = [4.0, 2.0, 1.0]


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of TensorBoard for a run's folder."""
    folder = tmp_path_factory.mktemp("run")
    book = Logbook(folder / "tensorboard", {"model": {"name": "lin"}})
    for step, cost in enumerate(COSTS):
        book.scalars({"cost/train": cost, "parameters/v0": 25.0 + step}, step)
    book.close()
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "tensorboard.main", "--logdir", str(folder)),
            *("--host", "127.0.0.1", "--port", "0", "--load_fast", "false"),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "no_proxy": "127.0.0.1"},
    )
    try:
        assert process.stdout is not None
        yield next(m[0] for line in process.stdout if (m := re.search(r"http://\S+:\d+/", line)))
    finally:
        process.kill()
        process.wait()


def response(address: str, path: str) -> Any:
    """TensorBoard's response after it has read the events."""
    end = time.monotonic() + 20
    while True:
        with urlopen(f"{address}{path}", timeout=10) as answer:
            content = json.load(answer)
        if content or time.monotonic() > end:
            return content
        time.sleep(0.2)


def test_curves_are_served(address: str) -> None:
    tags = response(address, "data/plugin/scalars/tags")
    assert {"cost/train", "parameters/v0"} <= set(tags["tensorboard"])
    rows = response(address, "data/plugin/scalars/scalars?run=tensorboard&tag=cost/train")
    assert [row[1:] for row in rows] == [[step, cost] for step, cost in enumerate(COSTS)]


#: Warnings of TensorBoard and of a browser without a graphics card.
IGNORED = r"Multiple instances of Three\.js|fallback to software WebGL"


@pytest.mark.skipif(bool(MISSING), reason=MISSING)
def test_page_shows_curves_offline_without_errors(address: str) -> None:
    response(address, "data/plugin/scalars/tags")
    with Browser() as browser:
        browser.open(address)
        end = time.monotonic() + 20
        while "cost" not in browser.evaluate("document.body.innerText"):
            assert time.monotonic() < end, browser.evaluate("document.body.innerText")
            time.sleep(0.2)
        assert [url for url in browser.requests if not url.startswith(address)] == []
        assert [text for text in browser.complaints if not re.search(IGNORED, text)] == []
