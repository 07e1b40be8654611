"""Malformed files for every reader and loader, in a child process with little memory.

Only the package's own errors may come of them, short and without control characters; no program may
start, and no file be written outside the folder. The child watches itself with an audit hook, its
parent watches the child.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any
from unicodedata import category

from benchmarks.fault_injection.campaign import check_names
from benchmarks.fault_injection.child import Child
from benchmarks.fault_injection.report import Row
from benchmarks.fault_injection.targets import Target, quiet, targets
from nnode.errors import LONGEST, NNodeError
from nnode.progress import Stages

#: Bytes of address space that a child may take beyond what it has when it starts.
ROOM = 2 << 30
#: Seconds that one input may take.
SLOW = 10
#: What a message must not hold: control and format characters, surrogates, separators of lines.
_HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
#: So many losses of a target are told in full.
_TOLD = 20

_STARTS = frozenset(
    {
        "os.system",
        "os.exec",
        "os.posix_spawn",
        "os.spawn",
        "subprocess.Popen",
        "os.fork",
        "os.forkpty",
        "socket.connect",
        "pty.spawn",
    }
)
_WRITES = frozenset(
    {
        "os.mkdir",
        "os.rename",
        "os.remove",
        "os.rmdir",
        "os.link",
        "os.symlink",
        "os.truncate",
        "shutil.move",
        "shutil.rmtree",
    }
)


class _TooSlow(BaseException):
    """An input takes longer than a reader may."""


class _Watch:
    """Counts what a reader must never do; an audit hook stays as long as its process."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.events = str(folder), Counter[str]()
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event in _STARTS:
            self.events[f"{event} {arguments[:1]!r}"[:200]] += 1
        elif event in _WRITES or (event == "open" and self._writes(arguments)):
            for path in arguments[:2] if event in ("os.rename", "shutil.move") else arguments[:1]:
                if isinstance(path, str | bytes | os.PathLike):
                    place = os.path.abspath(os.fsdecode(path))
                    if not place.startswith((self.folder, "/dev/null")):
                        self.events[f"{event} {place}"[:200]] += 1

    @staticmethod
    def _writes(arguments: tuple[Any, ...]) -> bool:
        _, mode, flags = arguments
        if isinstance(mode, str):
            return any(sign in mode for sign in "wax+")
        return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


def fuzz(folder: Path, inputs: int, seed: int, names: list[str] | None = None) -> list[Row]:
    """Give every target its share of ``inputs`` malformed files.

    Args:
        folder: of the campaign; all files lie in ``folder/fuzz``, and are removed at the end.
        inputs: number of files over all targets.
        seed: the same seed makes the same files.
        names: of the targets; None takes all.
    """
    scratch, outside = folder / "fuzz", folder / "outside"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    known = targets(scratch, outside)
    check_names("targets", names or [], [target.name for target in known])
    chosen = {target: target.share for target in known if names is None or target.name in names}
    rows = []
    shares = {target.name: float(share) for target, share in chosen.items()}
    with Stages("malformed files", shares, forks=True) as bar:
        for target, share in chosen.items():
            bar.begin(target.name)
            number = round(inputs * share / sum(shares.values()))
            rows.append(_all_of(target, number, seed, scratch, bar.within))
            if outside.exists():
                rows[-1].losses.append(f"{outside} was made")
                shutil.rmtree(outside) if outside.is_dir() else outside.unlink()
    shutil.rmtree(scratch)
    return rows


def make(target: Target, seed: int, number: int) -> bytes:
    """The malformed file of a number."""
    rng = random.Random(f"{target.name}-{seed}-{number}")
    return target.damage(rng.choice(target.seeds), rng)


def _all_of(
    target: Target, inputs: int, seed: int, scratch: Path, within: Callable[[float], None]
) -> Row:
    """All inputs of a target; a child that dies is a loss, and another one continues after it."""
    row, start, first = Row("fuzz", target.name, 0), time.monotonic(), 0
    counts = Counter(read=0, refused=0)
    megabytes, notes = 0.0, scratch / "notes.json"
    while first < inputs:
        notes.unlink(missing_ok=True)
        child = Child(partial(_work, target, first, inputs, seed, scratch, notes))
        before, last = -1, time.monotonic()
        while child.status(0.1) is None:
            at = _read_number(scratch)
            if at != before:
                before, last = at, time.monotonic()
                within(at / inputs)
            elif time.monotonic() - last > 6 * SLOW:
                child.kill()
        if notes.is_file():
            noted = json.loads(notes.read_text())
            row.tried += noted["tried"]
            row.losses += noted["losses"]
            counts.update(noted["counts"])
            megabytes = max(megabytes, noted["megabytes"])
        if child.status(0) == 0:
            break
        at = _read_number(scratch)
        row.losses.append(f"input {at}: the process ended with status {child.status(0)}")
        row.tried += 1
        first = at + 1
    row.seconds = time.monotonic() - start
    row.facts = {**counts, "MB": round(megabytes)}
    return row


def _read_number(scratch: Path) -> int:
    with suppress(OSError, ValueError):
        return int((scratch / "number").read_text())
    return -1


def _work(target: Target, first: int, last: int, seed: int, scratch: Path, notes: Path) -> None:
    """The child: all inputs from ``first`` on."""
    sys.dont_write_bytecode = True
    quiet()
    address = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (address + ROOM, address + ROOM))
    signal.signal(signal.SIGALRM, _too_slow)
    watch, path, counts = _Watch(scratch), scratch / target.file, Counter[str]()
    counter = os.open(scratch / "number", os.O_RDWR | os.O_CREAT)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    losses: list[str] = []
    for number in range(first, last):
        os.pwrite(counter, f"{number:09d}".encode(), 0)
        path.write_bytes(make(target, seed, number))
        watch.events.clear()
        signal.setitimer(signal.ITIMER_REAL, SLOW)
        try:
            target.read(path)
            counts["read"] += 1
        except NNodeError as error:
            counts["refused"] += 1
            losses += [f"input {number}: {what}" for what in _unfit(str(error))]
        except (Exception, _TooSlow) as error:
            where = "".join(traceback.format_tb(error.__traceback__)[-3:])
            losses.append(f"input {number}: {type(error).__name__}: {error}\n{where}"[:900])
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        losses += [f"input {number} did {what}" for what in watch.events]
        if (number - first) % 500 == 499 or number == last - 1:
            after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            noted = losses[:_TOLD] + [""] * (len(losses) - _TOLD)
            noted_row = {"tried": number - first + 1, "counts": counts, "losses": noted}
            notes.write_text(json.dumps({**noted_row, "megabytes": (after - before) / 1024}))


def _unfit(message: str) -> list[str]:
    """What a message must not be: long, or something that a terminal obeys."""
    control = sorted({ascii(c) for c in message if c not in "\n\t" and category(c) in _HIDDEN})
    found = [f"a message of {len(message)} characters"] if len(message) > LONGEST else []
    return found + ([f"a message with {', '.join(control)}"] if control else [])


def _too_slow(number: int, frame: FrameType | None) -> None:
    raise _TooSlow(f"longer than {SLOW} s")
