"""Progress bars on terminals and log lines elsewhere."""

from __future__ import annotations

import logging
import os
import pty
import re
import sys
import threading
import time
from pathlib import Path

import pytest

from benchmarks.fault_injection.child import Child
from nnode import progress
from nnode.calibrate.progress import Reporter
from nnode.progress import Stages
from studies.progress import TaskProgress


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_time_left_follows_from_shares_of_stages(clock: list[float]) -> None:
    stages = Stages("work", {"reading": 1.0, "thinking": 3.0})
    stages.begin("reading")
    assert stages.text() == "reading"
    clock[0] = 5.0
    stages.begin("thinking")
    assert stages.text() == "thinking, about 15 s left"
    clock[0] = 10.0
    stages.within(1 / 3)
    assert stages.text() == "thinking, about 10 s left"
    stages.within(7.0)  # longer than estimated
    assert stages.text() == "thinking, about 0 s left"
    clock[0] = 11.0
    assert stages.text() == "thinking, longer than estimated"
    stages.begin("reading")  # the stages are repeated
    clock[0] = 13.0
    stages.within(0.5)
    assert stages.text() == "reading, about 14 s left"
    clock[0] = 17.0
    assert stages.text() == "reading, about 10 s left"


def test_log_lines_every_ten_seconds(
    clock: list[float], caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with caplog.at_level(logging.INFO), Stages("work", {"a": 1.0, "b": 1.0}) as stages:
        stages.begin("a")
        for clock[0] in (1.0, 9.0, 10.0, 11.0, 19.0, 21.0):
            stages.within(clock[0] / 25)
        stages.begin("b")
    assert [record.message for record in caplog.records] == [
        "work: a, about 40 s left",
        "work: a, about 29 s left",
    ]
    assert capfd.readouterr() == ("", "")


def test_log_lines_during_long_steps(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(progress, "LINE_EVERY", 0.05)
    monkeypatch.setattr(progress, "_LOOK_EVERY", 0.01)
    for work in (Stages("work", {"a": 1.0}), Reporter(7), TaskProgress("study", 3, 1, 2.0)):
        caplog.clear()
        with caplog.at_level(logging.INFO), work:
            if isinstance(work, Stages):
                work.begin("a")
            time.sleep(0.5)
        assert 2 <= len(caplog.records) <= 11
        assert caplog.records[0].message in (
            "work: a",
            "training: step 0 of 7",
            "study: 1 of 3 tasks",
        )
    assert "progress" not in {thread.name for thread in threading.enumerate()}


@pytest.mark.parametrize("forks", [False, True])
def test_terminal_shows_a_bar_on_standard_error(tmp_path: Path, forks: bool) -> None:
    leader, follower = pty.openpty()

    def work() -> None:
        os.dup2(follower, 2)
        sys.stdout, sys.stderr = open(1, "w"), open(2, "w")  # noqa: SIM115
        logging.basicConfig(stream=sys.stderr, format="%(message)s", force=True)
        with Stages("work", {"a": 1.0, "b": 1.0}, forks=forks) as stages:
            stages.begin("a")
            stages.begin("b")
            logging.warning("a message")
            stages.within(0.5)
        print("result: 7")

    child = Child(work, tmp_path / "out")
    os.close(follower)
    shown = b""
    while child.status(0) is None or b"\x1b[?25h" not in shown:
        try:
            shown += os.read(leader, 65536)
        except OSError:  # the terminal's other end is closed
            break
    assert child.status() == 0
    assert (tmp_path / "out").read_text() == "result: 7\n"
    assert re.search(rb"work .*0:00:00", shown)
    if not forks:  # in a separate line above the bar
        assert re.search(
            rb"\na message *\r?\n", re.sub(rb"\x1b\[[0-9;?]*[a-zA-Z]|\r", b"\n", shown)
        )
