"""Malformed files for every reader and loader, in a child process with little memory.

Hypothesis makes the files. Only the package's own errors may come of them, short and without
control characters; no program may start, and no file be written outside the folder. The child
watches itself with an audit hook. Hypothesis makes the files of a loss as small as it can.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import os
import resource
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unicodedata import category

import torch
from hypothesis import HealthCheck, given, seed, settings

from benchmarks.fault_injection.child import Child
from benchmarks.fault_injection.row import Row
from benchmarks.fault_injection.targets import OUTSIDE, Target
from nnode.errors import LONGEST, NNodeError

#: Bytes of address space that a child may take beyond what it has when it starts.
ROOM = 2 << 30
#: Seconds that one input may take; after a multiple of them the process is ended.
SLOW = 10
#: What a message must not hold: control and format characters, surrogates, separators of lines.
_HIDDEN = ("Cc", "Cf", "Cs", "Zl", "Zp")

#: Beginnings of the names of audit events that start a program, and of those that write.
_STARTS = (
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.fork",
    "subprocess.Popen",
    "socket.connect",
    "pty.spawn",
)
_WRITES = (
    "os.mkdir",
    "os.rename",
    "os.remove",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
    "shutil.move",
    "shutil.rmtree",
)


class _Watch:
    """Notes what a reader must never do; an audit hook stays as long as its process."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.reading = str(folder), False
        self.events: list[str] = []
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.reading:
            return
        if event.startswith(_STARTS):
            self.events.append(f"{event} {arguments[:1]!r}"[:200])
        elif event in _WRITES or (event == "open" and self._writes(*arguments)):
            # the second argument of other events is no path
            for path in arguments[: 2 if event in ("os.rename", "shutil.move") else 1]:
                if isinstance(path, str | bytes | os.PathLike):
                    place = os.path.abspath(os.fsdecode(path))
                    if not place.startswith((self.folder, "/dev/null")):
                        self.events.append(f"{event} {place}"[:200])

    @staticmethod
    def _writes(_: Any, mode: Any, flags: Any) -> bool:
        if isinstance(mode, str):
            return any(sign in mode for sign in "wax+")
        return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


def fuzz(targets: list[Target], scratch: Path, inputs: int, number: int) -> Iterator[Row]:
    """Give every target its share of ``inputs`` malformed files.

    Args:
        scratch: receives all files.
        inputs: number of files over all targets; where something is lost, more are tried.
        number: the same seed makes the same files.
    """
    for target in targets:
        row, counts = Row(target.name), scratch / "counts.json"
        words = scratch / "words.txt"
        share = max(1, round(inputs / len(targets)))
        status = Child(partial(_work, target, share, number, scratch, counts), words).status()
        row.facts = json.loads(counts.read_text())
        row.tried = row.facts.pop("tried")
        if status != 0:
            said = words.read_text(errors="replace")
            row.losses.append(f"status {status}, last file {target.file}: {said[-5000:]}")
        if scratch.with_name(OUTSIDE).exists():
            row.losses.append(f"{scratch.with_name(OUTSIDE)} was made")
        yield row.ended()


def _work(target: Target, inputs: int, number: int, scratch: Path, counts: Path) -> None:
    """The child: all inputs of a target; it ends with an error where one is a loss."""
    sys.dont_write_bytecode = True
    torch.set_num_threads(1)
    # words of the libraries would cost more than the reading
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    faulthandler.enable()
    address = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (address + ROOM, address + ROOM))
    watch, path, counted = _Watch(scratch), scratch / target.file, Counter(read=0, refused=0)
    counts.write_text(json.dumps(counted | {"tried": 0}))

    @seed(number)
    @settings(
        max_examples=inputs,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(target.inputs)
    def promised(content: bytes) -> None:
        path.write_bytes(content)
        counted["tried"] += 1
        counts.write_text(json.dumps(counted))
        watch.events, watch.reading = [], True
        faulthandler.dump_traceback_later(6 * SLOW, exit=True)
        start, message = time.monotonic(), ""
        try:
            target.read(path)
            counted["read"] += 1
        except NNodeError as error:
            counted["refused"] += 1
            message = str(error)
        finally:
            watch.reading = False
            faulthandler.cancel_dump_traceback_later()
        assert time.monotonic() - start < SLOW, "it took too long"
        assert not watch.events, f"did {watch.events}"
        assert len(message) <= LONGEST, f"a message of {len(message)} characters"
        control = {ascii(c) for c in message if c not in "\n\t" and category(c) in _HIDDEN}
        assert not control, f"a message with {control}"

    try:
        promised()
    finally:
        counts.write_text(json.dumps(counted))
