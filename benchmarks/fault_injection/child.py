"""Child processes that share the loaded libraries: a start costs milliseconds, not seconds."""

from __future__ import annotations

import os
import runpy
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path


class Child:
    """A forked process that does ``work`` and ends; its words go to a file.

    Args:
        work: what it does; ``SystemExit`` gives the exit status, other errors status 1.
        output: receives what it prints; None drops it.
    """

    def __init__(self, work: Callable[[], object], output: Path | None = None) -> None:
        self._status: int | None = None
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if self.pid == 0:
            _be_child(work, output)

    def status(self, seconds: float | None = None) -> int | None:
        """The exit status, negative for a signal; None where it still works after ``seconds``."""
        end = None if seconds is None else time.monotonic() + seconds
        while self._status is None:
            pid, raw = os.waitpid(self.pid, os.WNOHANG if end is not None else 0)
            if pid:
                self._status = os.waitstatus_to_exitcode(raw)
            elif end is not None and time.monotonic() >= end:
                break
            else:
                time.sleep(0.002)
        return self._status

    def kill(self) -> None:
        """End it as a crash or a power cut does."""
        if self._status is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
            self.status()


def _be_child(work: Callable[[], object], output: Path | None) -> None:
    """Never returns: whatever happens, the parent's code is not gone on with."""
    status = 1
    try:
        place = os.devnull if output is None else str(output)
        descriptor = os.open(place, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        # a parent such as pytest may have others
        sys.stdout, sys.stderr = (
            os.fdopen(descriptor, "w", closefd=False) for descriptor in (1, 2)
        )
        work()
        status = 0
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def script(root: Path, name: str, overrides: list[str]) -> None:
    """Do what ``python scripts/<name>.py OVERRIDES`` does, in this process."""
    os.chdir(root)
    sys.argv = [str(root / "scripts" / f"{name}.py"), *overrides]
    runpy.run_path(sys.argv[0], run_name="__main__")
