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
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from benchmarks.fault_injection.jobs import Job, kept
from benchmarks.fault_injection.row import Row
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.data.store import MANIFEST, Store
from nnode.errors import StudyError
from nnode.files import PARTIAL

#: So many kills in a row, at most, before a run may end.
_ROW = 6

_EVENTS = frozenset({"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir"})


def kills(jobs: list[Job], scratch: Path, number: int, seed: int) -> Iterator[Row]:
    """Kill ``number`` runs, spread over the jobs.

    Args:
        scratch: receives all files.
        seed: of the moments.
    """
    whole = sum(job.share for job in jobs)
    shares = {job.name: max(1, number * job.share // whole) for job in jobs}
    shares[jobs[0].name] += max(0, number - sum(shares.values()))
    for job in jobs:
        yield _killed(
            job, scratch / job.name, shares[job.name], random.Random(f"{job.name}-{seed}")
        )


def _killed(job: Job, place: Path, number: int, rng: random.Random) -> Row:
    """Kill until ``number`` runs were killed, and compare each end with that of a run without."""
    place.mkdir()
    row = Row(job.name, facts={"ends compared": 0})
    straight, count = place / "straight", place / "events"
    for _ in range(2):  # the second one finds what was compiled on the way
        shutil.rmtree(straight, ignore_errors=True)
        begin = time.monotonic()
        child = job.start(straight, before=partial(_count_events, straight, count))
        if child.status() != 0:
            raise StudyError(f"{job.name} fails without any kill: {job.words(straight)}")
    seconds, events = time.monotonic() - begin, int(count.read_text())
    results = job.ended(straight)
    while row.tried < number and not row.losses:
        folder = place / f"run{row.tried}"
        # a run that is asked for again, over finished results, must not lose them
        repeated = True
        while repeated and row.tried < number and not row.losses:
            _until_the_end(job, folder, row, number, seconds, events, rng)
            if not row.losses:
                row.facts["ends compared"] += 1
                row.losses += _ended(job, folder, results)
            repeated = rng.random() < 0.3
        if not row.losses:
            shutil.rmtree(folder)
    return row.ended()


def _until_the_end(
    job: Job,
    folder: Path,
    row: Row,
    number: int,
    seconds: float,
    events: int,
    rng: random.Random,
) -> None:
    """Start a run again and again, and kill it at most a few times before it ends."""
    for attempt in range(_ROW + 1):
        before = kept(folder)
        patience = 600.0
        last: int | None = None
        if attempt < _ROW and row.tried < number:
            if rng.random() < 0.5:
                patience = rng.uniform(0, seconds)
            else:
                last = rng.randrange(events)
        child = job.start(folder, before=partial(_die_at, folder, last))
        child.status(patience)
        child.kill()
        if child.status() == -signal.SIGKILL:
            row.tried += 1
            row.losses += broken(folder)
            try:
                if gone := before - kept(folder):
                    row.losses.append(f"{folder}: {gone} was there before the kill")
            except Exception as error:
                row.losses.append(f"{folder}: {type(error).__name__}: {error}")
        else:
            if child.status() != 0:
                row.losses.append(f"{folder} ended with {child.status()}: {job.words(folder)}")
            return


def _ended(job: Job, folder: Path, straight: Any) -> list[str]:
    """What is wrong with the end of a run, in words."""
    try:
        if job.ended(folder) != straight:
            return [f"{folder} has other results than the run without kills, {job.name}/straight"]
    except Exception as error:
        return [f"{folder} has no result: {type(error).__name__}: {error}"]
    return [f"{path} is left" for path in folder.rglob(f".*{PARTIAL}")]


def broken(folder: Path) -> list[str]:
    """The results in a folder that are not whole, in words."""
    losses = []
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not any(part.startswith(".") for part in path.parts[-3:]):
            try:
                read_whole(path)
            except Exception as error:
                losses.append(f"{path} is not whole: {type(error).__name__}: {error}")
    return losses


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


def _on_changes(folder: Path, act: Callable[[int], object]) -> None:
    """Before each change of a file in a folder by this process, call with the change's number."""
    number = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal number
        if event not in _EVENTS or not isinstance(arguments[0], str | os.PathLike):
            return
        if event == "open":
            flags = arguments[2]
            if not (isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
                return
        if os.path.abspath(arguments[0]).startswith(str(folder)):
            act(number)
            number += 1

    sys.addaudithook(hook)


def _count_events(folder: Path, count: Path) -> None:
    """Let the process write how many of its file operations there were so far."""
    descriptor = os.open(count, os.O_WRONLY | os.O_CREAT)
    _on_changes(folder, lambda number: os.pwrite(descriptor, f"{number + 1:09d}".encode(), 0))


def _die_at(folder: Path, last: int | None) -> None:
    """Let the process die at its file operation number ``last``, before it is done."""

    def die(number: int) -> None:
        if number == last:
            os.kill(os.getpid(), signal.SIGKILL)

    _on_changes(folder, die)
