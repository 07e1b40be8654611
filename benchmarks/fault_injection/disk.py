"""Disks that are full while a run writes: the error says so, and what was there stays readable.

Where the system lets us mount, the disk is a real one of a few megabytes in memory. Everywhere,
a limit on the size of files breaks writing off in the middle of them.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.fault_injection.jobs import Job, kept
from benchmarks.fault_injection.kills import broken
from benchmarks.fault_injection.row import Row
from nnode.files import PARTIAL

#: Bytes left on the disk in memory.
ROOM = (0, 36864, 49152, 65536, 131072)
#: Bytes that any one file may have.
LIMITS = (0, 200, 33000, 40000, 60000, 120000)
#: Size of the disk in memory.
_DISK = 24 << 20
#: A resumed training goes on, so that it has something to write.
_LONGER = ["trainer.max_epochs=8"]

_WORDS = ("cannot be written", "cannot be kept", "No space left", "File too large")


def full_disks(jobs: list[Job], scratch: Path) -> Iterator[Row]:
    """Run each job over its own finished results, with less and less room.

    Args:
        scratch: receives all files.
    """
    for job in jobs:
        place = scratch / job.name
        finished = place / "finished"
        place.mkdir()
        assert job.start(finished).status(300) == 0, f"it fails with room: {job.words(finished)}"
        row = Row(f"{job.name}, size of files", facts={"refused": 0})
        for limit in LIMITS:
            run = place / f"limit{limit}"
            shutil.copytree(finished, run)
            _try(job, run, row, f"{limit} bytes", kept(finished), partial(_limit, limit))
            shutil.rmtree(run)
        yield row.ended()
        row = Row(f"{job.name}, disk in memory", facts={"refused": 0})
        for room in ROOM:
            with _mounted(place / f"disk{room}") as disk:
                if disk is None:
                    row.facts = {"mounting": "not allowed"}
                    break
                shutil.copytree(finished, disk / "run")
                _fill(disk, room)
                _try(job, disk / "run", row, f"{room} bytes left", kept(finished))
        yield row.ended()


def _try(
    job: Job,
    run: Path,
    row: Row,
    what: str,
    earlier: set[Any],
    before: Callable[[], None] = lambda: None,
) -> None:
    """One run over finished results; the checks after it."""
    row.tried += 1
    output = run.parents[1] / "output.txt"
    child = job.start(run, before=before, longer=_LONGER, output=output)
    status = child.status(300)
    child.kill()
    words, losses = output.read_text(), broken(run)
    row.facts["refused"] += status != 0
    if status != 0 and not any(word in words for word in _WORDS):
        losses.append(f"status {status} without a word of the disk: {words[-900:]}")
    if "Traceback" in words:
        losses.append(f"a traceback in place of words: {words[-1800:]}")
    if status is None or status < 0:
        losses.append(f"it ended by signal, or not at all ({status})")
    losses += [f"{path} is left" for path in sorted(run.rglob(f"*{PARTIAL}"))]
    try:
        assert kept(run) >= earlier, "what was finished is gone"
    except Exception as error:
        losses.append(f"{type(error).__name__}: {error}")
    row.losses += [f"{what}: {loss}" for loss in losses]


def _limit(size: int) -> None:
    """Go on in a process whose files may not be longer. What it prints is not limited: this process
    copies it from a pipe, and ends as the other one does."""
    reader, writer = os.pipe()
    limited = os.fork()
    if limited:
        os.close(writer)
        while part := os.read(reader, 65536):
            os.write(1, part)
        status = os.waitstatus_to_exitcode(os.waitpid(limited, 0)[1])
        if status < 0:
            os.kill(os.getpid(), -status)
        os._exit(status)
    os.close(reader)
    os.dup2(writer, 1)
    os.dup2(writer, 2)
    os.close(writer)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


@contextmanager
def _mounted(place: Path) -> Iterator[Path | None]:
    """A disk in memory at ``place``; None where mounting is not allowed."""
    place.mkdir(parents=True)
    options = ["-t", "tmpfs", "-o", f"size={_DISK}", "tmpfs", str(place)]
    try:
        done = subprocess.run(["mount", *options], capture_output=True, check=False).returncode == 0
    except OSError:
        done = False
    try:
        yield place if done else None
    finally:
        if done:
            with suppress(OSError):
                (place / "filler").unlink()
            subprocess.run(["umount", str(place)], capture_output=True, check=False)
            place.rmdir()


def _fill(where: Path, room: int) -> None:
    """Leave ``room`` bytes on a disk."""
    with open(where / "filler", "wb", buffering=0) as file:
        with suppress(OSError):
            while True:
                file.write(bytes(1 << 16))
        with suppress(OSError):
            while True:
                file.write(bytes(512))
        file.truncate(file.tell() - room)
