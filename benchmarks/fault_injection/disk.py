"""Disks that are full while a run writes: the error says so, and what was there stays readable.

Where the system lets us mount, the disk is a real one of a few megabytes in memory. Everywhere,
a limit on the size of files breaks writing off in the middle of them.
"""

from __future__ import annotations

import logging
import os
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from benchmarks.fault_injection.campaign import Work, on_jobs
from benchmarks.fault_injection.jobs import Job
from benchmarks.fault_injection.kills import broken
from benchmarks.fault_injection.report import Row
from nnode.files import PARTIAL

#: Bytes left on the disk in memory.
ROOM = (0, 36864, 49152, 65536, 131072)
#: Bytes that any one file may have.
LIMITS = (0, 200, 33000, 40000, 60000, 120000)
#: Size of the disk in memory.
_DISK = 24 << 20

_WORDS = ("cannot be written", "cannot be kept", "No space left", "File too large")


def disk(
    root: Path, folder: Path, names: list[str] | None = None, *, mount: bool = True
) -> list[Row]:
    """Run each job over its own finished results, with less and less room.

    Args:
        root: of the repository, with its scripts.
        folder: of the campaign; what it writes is removed where nothing was lost.
        names: of the jobs; None takes all but the benchmark, which writes as the study does.
        mount: whether a disk in memory is tried as well.
    """

    def plan(chosen: list[Job]) -> tuple[list[float], Work]:
        return [1.0] * len(chosen), lambda job, place, within: _of_job(root, place, job, mount)

    return on_jobs(folder, "disk", "full disks", plan, names, but=["benchmark_discovery"])


def _of_job(root: Path, place: Path, job: Job, mount: bool) -> list[Row]:
    finished = place / "finished"
    assert _run(root, job, finished, place / "output.txt") == 0, "it fails with room"
    limited = Row("disk", f"{job.name}, size of files", 0)
    for limit in LIMITS:
        run = place / f"limit{limit}"
        shutil.copytree(finished, run)
        _try(root, job, run, limited, f"{limit} bytes", partial(_limit, limit))
        shutil.rmtree(run)
    if not mount:
        return [limited]
    full = Row("disk", f"{job.name}, disk in memory", 0)
    for room in ROOM:
        with _mounted(place / f"disk{room}") as where:
            if where is None:
                full.facts = {"mounting": "not allowed"}
                break
            shutil.copytree(finished, where / "run")
            _fill(where, room)
            _try(root, job, where / "run", full, f"{room} bytes left", lambda: None)
    return [limited, full]


def _try(root: Path, job: Job, run: Path, row: Row, what: str, prelude: Callable[[], None]) -> None:
    """One run over finished results; the checks after it."""
    start = time.monotonic()
    row.tried += 1
    output = run.parents[1] / "output.txt" if run.name == "run" else run.parent / "output.txt"
    status = _run(root, job, run, output, prelude)
    words = output.read_text()
    row.facts["refused"] = row.facts.get("refused", 0) + (status != 0)
    if status != 0 and not any(word in words for word in _WORDS):
        row.losses.append(f"{what}: status {status} without a word of the disk: {words[-900:]}")
    if "Traceback" in words:
        row.losses.append(f"{what}: a traceback in place of words: {words[-1800:]}")
    if status is None or status < 0:
        row.losses.append(f"{what}: it ended by signal, or not at all ({status})")
    row.losses += [f"{what}: {path} is left" for path in sorted(run.rglob(f"*{PARTIAL}"))]
    row.losses += [f"{what}: {words}" for words in broken(run)]
    try:
        kept = job.kept(run)
        assert kept or job.name == "discover", "what was finished is gone"
    except Exception as error:
        row.losses.append(f"{what}: {type(error).__name__}: {error}")
    row.seconds += time.monotonic() - start


def _run(
    root: Path, job: Job, folder: Path, output: Path, prelude: Callable[[], None] = lambda: None
) -> int | None:
    again = job.again(folder)
    # a training that goes on, so that it has something to write
    given = job.first if again is None else [*again, "trainer.max_epochs=8"]
    child = job.child(root, given, folder, output, prelude)
    status = child.status(300)
    child.kill()
    return status


def _limit(size: int) -> None:
    """No file of this process may be longer; what it prints goes through a pipe."""
    # its words are not what is limited
    reader, writer = os.pipe()
    words = os.dup(1)
    if os.fork() == 0:
        os.close(writer)
        while part := os.read(reader, 65536):
            os.write(words, part)
        os._exit(0)
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
    logging.debug("%s has %d bytes left", where, shutil.disk_usage(where).free)
