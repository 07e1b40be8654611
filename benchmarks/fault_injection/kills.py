"""Runs that are killed at any moment and started again: what is there is whole, nothing is lost.

Half of the kills come at a random time, the other half at a random one of the run's own file
operations, where a half-written state would lie bare.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from benchmarks.fault_injection.campaign import Work, on_jobs
from benchmarks.fault_injection.child import Child
from benchmarks.fault_injection.jobs import Job
from benchmarks.fault_injection.report import Row
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.data.store import MANIFEST, Store
from nnode.errors import StudyError
from nnode.files import PARTIAL

#: So many kills in a row, at most, before a run may end.
_ROW = 6

_EVENTS = frozenset({"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir"})


def kills(
    root: Path, folder: Path, number: int, seed: int, names: list[str] | None = None
) -> list[Row]:
    """Kill ``number`` runs, spread over the jobs.

    Args:
        root: of the repository, with its scripts.
        folder: of the campaign; what it writes is removed where nothing was lost.
        number: of kills over all jobs.
        seed: of the moments.
        names: of the jobs; None takes all.
    """

    def plan(chosen: list[Job]) -> tuple[list[float], Work]:
        whole = sum(job.share for job in chosen)
        shares = {job.name: max(1, number * job.share // whole) for job in chosen}
        shares[chosen[0].name] += max(0, number - sum(shares.values()))

        def kill(job: Job, place: Path, within: Callable[[float], None]) -> list[Row]:
            rng = random.Random(f"{job.name}-{seed}")
            return [_Killed(root, place, job, rng).all(shares[job.name], within)]

        return [float(job.share) for job in chosen], kill

    return on_jobs(folder, "kills", "kills", plan, names)


class _Killed:
    """The kills of one job."""

    def __init__(self, root: Path, place: Path, job: Job, rng: random.Random) -> None:
        self.root, self.place, self.job, self.rng = root, place, job, rng
        self.row = Row("kills", job.name, 0)
        self.straight: Any = None
        self.seconds, self.events, self.ended, self.resumed = 0.0, 0, 0, 0

    def all(self, number: int, within: Callable[[float], None]) -> Row:
        """Kill until ``number`` runs were killed, and compare each end with the straight run's.

        Args:
            within: is told which part is done.
        """
        start = time.monotonic()
        self._straight()
        run = 0
        while self.row.tried < number:
            run += 1
            folder = self.place / f"run{run}"
            again = True
            while again and self.row.tried < number:
                self._until_the_end(folder, number)
                within(self.row.tried / number)
                # a run that is asked for again, over finished results, must not lose them
                again = self.rng.random() < 0.3
            if self.row.losses:
                break
            shutil.rmtree(folder)
        self.row.seconds = time.monotonic() - start
        self.row.facts = {"ends compared": self.ended, "resumed": self.resumed}
        return self.row

    def _straight(self) -> None:
        folder, count = self.place / "straight", self.place / "events"
        self._run(folder, lambda: _count_events(folder, count)).status()
        begin = time.monotonic()  # the second one finds what was compiled on the way
        shutil.rmtree(folder)
        child = self._run(folder, lambda: _count_events(folder, count))
        if child.status() != 0:
            words = (self.place / "output.txt").read_text()
            raise StudyError(f"{self.job.name} fails without any kill: {words[-2000:]}")
        self.seconds = time.monotonic() - begin
        self.events = int(count.read_text())
        self.straight = self.job.results(folder)

    def _run(self, folder: Path, prelude: Callable[[], object] = lambda: None) -> Child:
        given = self.job.again(folder)
        self.resumed += given is not None
        overrides = self.job.first if given is None else given
        return self.job.child(self.root, overrides, folder, self.place / "output.txt", prelude)

    def _until_the_end(self, folder: Path, number: int) -> None:
        for attempt in range(_ROW + 1):
            before = self.job.kept(folder)
            last = attempt == _ROW or self.row.tried >= number
            if last:
                child = self._run(folder)
                status = child.status(600)
            elif self.rng.random() < 0.5:
                child = self._run(folder)
                status = child.status(self.rng.uniform(0, self.seconds))
            else:
                event = self.rng.randrange(self.events)
                child = self._run(folder, partial(_die_at, folder, event))
                status = child.status(600)
            child.kill()
            status = child.status() if status is None else status
            if status == -signal.SIGKILL:
                self.row.tried += 1
                self._look(folder, before)
                continue
            if status != 0:
                words = (self.place / "output.txt").read_text()
                self._lose(f"{folder.name} ended with status {status}: {words[-1500:]}")
                return
            self._compare(folder)
            return

    def _look(self, folder: Path, before: float | set[str]) -> None:
        self.row.losses += broken(folder)
        try:
            now = self.job.kept(folder)
        except Exception as error:
            self._lose(f"{folder.name}: {type(error).__name__}: {error}")
            return
        if not now >= before:  # type: ignore[operator]
            self._lose(f"{folder.name}: there was {before}, after the kill there is {now}")

    def _compare(self, folder: Path) -> None:
        self.ended += 1
        try:
            found = self.job.results(folder)
        except Exception as error:
            self._lose(f"{folder.name} has no result: {type(error).__name__}: {error}")
            return
        if found != self.straight:
            self._lose(f"{folder.name}: {_difference(self.straight, found)}")
        left = [str(p) for p in folder.rglob(f".*{PARTIAL}")]
        if left:
            self._lose(f"{folder.name}: what was half written is left: {', '.join(left)}")

    def _lose(self, words: str) -> None:
        self.row.losses.append(words)


def broken(folder: Path) -> list[str]:
    """The results in a folder that are not whole, in words."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not any(part.startswith(".") for part in path.parts[-3:]):
            try:
                read_whole(path)
            except Exception as error:
                found.append(f"{path} is not whole: {type(error).__name__}: {error}")
    return found


def read_whole(path: Path) -> None:
    """Read all of a result's file; raises where it is not whole."""
    match path.suffix:
        case ".json" if path.name == MANIFEST:
            for _ in Store(path.parent):
                pass
        case ".json":
            json.loads(path.read_text(encoding="utf-8"))
        case ".pt":
            load_checkpoint(path).build()
        case ".csv":
            pd.read_csv(path)
        case ".yaml":
            assert yaml.safe_load(path.read_text(encoding="utf-8")), "it is empty"
        case ".html":
            assert path.read_text(encoding="utf-8").rstrip().endswith("</html>"), (
                "its end is missing"
            )
        case ".png":
            from PIL import Image

            Image.open(path).load()


def _difference(a: Any, b: Any, where: str = "") -> str:
    """The first place in which two results differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in {**a, **b}:
            if a.get(key) != b.get(key):
                return _difference(a.get(key), b.get(key), f"{where}/{key}")
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            if x != y:
                return _difference(x, y, f"{where}[{i}]")
    return f"{where}: {str(a)[:200]} without a kill, {str(b)[:200]} after it"


def _changes(folder: Path, event: str, arguments: tuple[Any, ...]) -> bool:
    """Whether an audit event changes a file of the run."""
    if event not in _EVENTS:
        return False
    if event == "open":
        flags = arguments[2]
        if not (isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
            return False
    path = arguments[0]
    return isinstance(path, str | os.PathLike) and os.path.abspath(path).startswith(str(folder))


def _count_events(folder: Path, count: Path) -> None:
    """Let the process write how many of its file operations there were so far."""
    descriptor, number = os.open(count, os.O_WRONLY | os.O_CREAT), 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal number
        if _changes(folder, event, arguments):
            number += 1
            os.pwrite(descriptor, f"{number:09d}".encode(), 0)

    sys.addaudithook(hook)


def _die_at(folder: Path, last: int) -> None:
    """Let the process die at its file operation number ``last``, before it is done."""
    number = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal number
        if _changes(folder, event, arguments):
            if number == last:
                os.kill(os.getpid(), signal.SIGKILL)
            number += 1

    sys.addaudithook(hook)
