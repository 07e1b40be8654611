"""Two runs in one folder: the second one is refused, and a killed first one blocks nobody."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks.fault_injection.child import Child
from benchmarks.fault_injection.jobs import Job
from benchmarks.fault_injection.row import Row
from nnode.lock import LOCK

_REFUSED = "another run works in"


def shared_folders(jobs: list[Job], scratch: Path, repeats: int) -> Iterator[Row]:
    """Start each job twice in one folder, and again after the first one was killed.

    Args:
        scratch: receives all files.
        repeats: so many second runs, and half as many after a kill, per job.
    """
    for job in jobs:
        place, row = scratch / job.name, Row(job.name)
        place.mkdir()
        job.start(place / "straight").status()
        straight = job.ended(place / "straight")
        for number in range(repeats):
            run = place / f"run{number}"
            first = job.start(run)
            if not _at_work(run, first):
                row.losses.append(f"the first run ended: {job.words(run)}")
                continue
            second = job.start(run, output=place / "second.txt")
            status, words = second.status(120), (place / "second.txt").read_text()
            row.tried += 1
            if first.status(0) is None and (status != 1 or _REFUSED not in words):
                row.losses.append(f"the second run was not refused: {status}, {words[-900:]}")
            if number % 2 == 0:
                if first.status(300) != 0 or job.ended(run) != straight:
                    row.losses.append("the first run did not come to its result beside a second")
                if (run / LOCK).exists():
                    row.losses.append("the lock of a run that ended is left")
                continue
            first.kill()
            third = job.start(run)
            row.tried += 1
            if third.status(300) != 0:
                row.losses.append(f"a killed run's lock blocked the next one: {job.words(run)}")
            elif job.ended(run) != straight:
                row.losses.append("after a kill the result is another one")
            third.kill()
        yield row.ended()


def _at_work(run: Path, child: Child) -> bool:
    """Wait until a run has taken its folder."""
    while not ((run / LOCK).exists() and (run / LOCK).stat().st_size):
        if child.status(0.01) is not None:
            return False
    return True
