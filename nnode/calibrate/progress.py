"""Progress with rate and time left: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import logging
import sys
import time
from types import TracebackType

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

log = logging.getLogger(__name__)

#: Seconds between lines where no terminal shows the bar.
LINE_EVERY = 10.0


class Reporter:
    """Shows how far a run is; use as a context manager.

    Args:
        total: number of steps at the end.
        done: steps done before this start.
    """

    def __init__(self, total: int, done: int = 0, what: str = "training") -> None:
        self.total, self.done, self.what = total, done, what
        self._start, self._first = time.monotonic(), done
        self._last_line = self._start
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]:.1f} steps/s"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[note]}"),
            )
            self._task = self._bar.add_task(what, total=total, completed=done, rate=0.0, note="")

    def __enter__(self) -> Reporter:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar:
            self._bar.stop()

    def advance(self, note: str = "") -> None:
        """One step more is done."""
        self.done += 1
        now = time.monotonic()
        rate = (self.done - self._first) / max(now - self._start, 1e-9)
        if self._bar:
            self._bar.update(self._task, completed=self.done, rate=rate, note=note)
        elif now - self._last_line >= LINE_EVERY:
            self._last_line = now
            left = (self.total - self.done) / max(rate, 1e-9)
            log.info(
                "%s: step %d of %d, %.1f steps/s, %.0f s left  %s",
                self.what,
                self.done,
                self.total,
                rate,
                left,
                note,
            )
