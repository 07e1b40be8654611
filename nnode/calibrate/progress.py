"""Progress with rate and time left: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import logging
import sys
import time
from types import TracebackType
from typing import Self

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

log = logging.getLogger(__name__)

#: Seconds between lines where no terminal shows the bar.
LINE_EVERY = 10.0


class OnTerminal:
    """Shows a bar where standard error is a terminal, for as long as the context lasts."""

    def __init__(self, *columns: ProgressColumn) -> None:
        self._bar = Progress(*columns) if sys.stderr.isatty() else None
        self._start = self._last_line = time.monotonic()

    def __enter__(self) -> Self:
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

    def line_is_due(self) -> bool:
        """Whether the last line is so long ago that another one may be written; it then counts."""
        now = time.monotonic()
        due = now - self._last_line >= LINE_EVERY
        if due:
            self._last_line = now
        return due


class Reporter(OnTerminal):
    """Shows how far a run is; use as a context manager.

    Args:
        total: number of steps at the end.
        done: steps done before this start.
    """

    def __init__(self, total: int, done: int = 0, what: str = "training") -> None:
        super().__init__(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]:.1f} steps/s"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
        )
        self.total, self.done, self.what = total, done, what
        self._first = done
        if self._bar:
            self._task = self._bar.add_task(what, total=total, completed=done, rate=0.0, note="")

    def advance(self, note: str = "") -> None:
        """One step more is done."""
        self.done += 1
        rate = (self.done - self._first) / max(time.monotonic() - self._start, 1e-9)
        if self._bar:
            self._bar.update(self._task, completed=self.done, rate=rate, note=note)
        elif self.line_is_due():
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
