"""Two runs in one folder: the second one is refused, and a killed first one blocks nobody."""

from __future__ import annotations

import time
from pathlib import Path

from benchmarks.fault_injection.campaign import Work, on_jobs
from benchmarks.fault_injection.child import Child
from benchmarks.fault_injection.jobs import Job
from benchmarks.fault_injection.report import Row
from nnode.lock import LOCK

_REFUSED = "another run works in"


def folder(root: Path, place: Path, names: list[str] | None = None, repeats: int = 4) -> list[Row]:
    """Start each job twice in one folder, and again after the first one was killed.

    Args:
        root: of the repository, with its scripts.
        place: of the campaign; what it writes is removed where nothing was lost.
        names: of the jobs; None takes all.
        repeats: so many second runs, and as many after a kill, per job.
    """

    def plan(chosen: list[Job]) -> tuple[list[float], Work]:
        return [1.0] * len(chosen), lambda job, own, within: [_of_job(root, own, job, repeats)]

    return on_jobs(place, "folder", "shared folders", plan, names)


def _of_job(root: Path, place: Path, job: Job, repeats: int) -> Row:
    row, start = Row("folder", job.name, 0), time.monotonic()
    _start(root, job, place / "straight", place / "straight.txt").status()
    straight = job.results(place / "straight")
    for number in range(repeats):
        run = place / f"run{number}"
        first = _start(root, job, run, place / "first.txt")
        if not _at_work(run, first):
            row.losses.append(f"the first run ended: {(place / 'first.txt').read_text()[-900:]}")
            continue
        second = _start(root, job, run, place / "second.txt")
        status, words = second.status(120), (place / "second.txt").read_text()
        row.tried += 1
        if first.status(0) is None and (status != 1 or _REFUSED not in words):
            row.losses.append(f"the second run was not refused: {status}, {words[-900:]}")
        if number % 2 == 0:
            if first.status(300) != 0 or job.results(run) != straight:
                row.losses.append("the first run did not come to its result beside a second one")
            if (run / LOCK).exists():
                row.losses.append("the lock of a run that ended is left")
            continue
        first.kill()
        third = _start(root, job, run, place / "third.txt")
        row.tried += 1
        if third.status(300) != 0:
            words = (place / "third.txt").read_text()
            row.losses.append(f"a killed run's lock blocked the next one: {words[-900:]}")
        elif job.results(run) != straight:
            row.losses.append("after a kill the result is another one")
        third.kill()
    row.seconds = time.monotonic() - start
    return row


def _start(root: Path, job: Job, run: Path, output: Path) -> Child:
    return job.child(root, job.again(run) or job.first, run, output)


def _at_work(run: Path, child: Child) -> bool:
    """Wait until a run has taken its folder."""
    while not ((run / LOCK).exists() and (run / LOCK).stat().st_size):
        if child.status(0.01) is not None:
            return False
    return True
