"""Progress of a task with the remaining time: a bar on a terminal, otherwise lines in the log."""

from __future__ import annotations

import logging
import sys
import threading
import time
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn

log = logging.getLogger(__name__)

#: Seconds between lines in the log.
LINE_EVERY = 10.0
#: Seconds between checks whether a line is due.
_LOOK_EVERY = 0.5


class OnTerminal:
    """Shows a bar within the context if standard error is a terminal.

    Otherwise a line is written to the log about every ten seconds, also during a long step.

    Args:
        columns: columns of the bar.
        forks: whether the task forks processes; then there is no thread, and the bar and the log
            are updated only when the task reports its state.
    """

    def __init__(self, *columns: ProgressColumn, forks: bool = False) -> None:
        self._bar: Progress | None = None
        self._ended, self._lines = threading.Event(), threading.Lock()
        self._beat: threading.Thread | None = None
        self._forks = forks
        #: handlers of the log that write to the terminal, which must write above the bar
        self._moved: list[tuple[logging.StreamHandler[Any], Any]] = []
        if sys.stderr.isatty():
            # on standard error, because standard output has the results and may be a file
            self._bar = Progress(
                *columns,
                console=Console(stderr=True),
                auto_refresh=not forks,
                redirect_stdout=not forks,  # children print by themselves
                redirect_stderr=not forks,
            )
        self._start = self._last_line = time.monotonic()

    def __enter__(self) -> Self:
        if not self._bar and not self._forks:
            self._beat = threading.Thread(target=self._report, name="progress", daemon=True)
            self._beat.start()
        if self._bar:
            self._bar.start()
            if not self._forks:
                self._moved = [
                    (handler, handler.setStream(sys.stderr))  # which the bar has replaced
                    for handler in logging.getLogger().handlers
                    if isinstance(handler, logging.StreamHandler)
                    and handler.stream.isatty()
                    and handler.stream is not sys.stderr
                ]
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        if self._beat is not None:
            self._beat.join()
        for handler, stream in self._moved:
            handler.setStream(stream)
        if self._bar:
            self._bar.stop()

    def line_is_due(self) -> bool:
        """Whether it is time for another line; if so, it counts as written now."""
        with self._lines:
            now = time.monotonic()
            due = now - self._last_line >= LINE_EVERY
            if due:
                self._last_line = now
            return due

    def line(self) -> str:
        """The state of the task as text."""
        raise NotImplementedError

    def log_if_due(self) -> None:
        """Write a line to the log if it is due."""
        if self.line_is_due():
            log.info("%s", self.line())

    def _report(self) -> None:
        while not self._ended.wait(_LOOK_EVERY):
            self.log_if_due()


class Stages(OnTerminal):
    """A task of several consecutive stages; use as a context manager.

    Args:
        title: title of the task.
        shares: stage to its usual share of the time, in any unit.
        forks: see :class:`OnTerminal`.
    """

    def __init__(self, title: str, shares: dict[str, float], *, forks: bool = False) -> None:
        super().__init__(
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[text]}"),
            forks=forks,
        )
        whole = sum(shares.values())
        self.title, self.shares = title, {name: x / whole for name, x in shares.items()}
        self.done, self._before, self._stage, self._reported = 0.0, 0.0, "", self._start
        if self._bar:
            self._task = self._bar.add_task(title, total=1.0, text="")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar and error is None:
            self._bar.update(self._task, completed=1.0, text="")
        super().__exit__(kind, error, trace)

    def begin(self, stage: str) -> None:
        """Begin a stage and end those before it. An earlier stage restarts the estimate."""
        names = list(self.shares)
        before = sum(self.shares[name] for name in names[: names.index(stage)])
        if before < self._before:
            self._start = time.monotonic()
        self._stage, self._before = stage, before
        self.within(0.0)

    def within(self, part: float) -> None:
        """Report which part of the stage is done, between 0 and 1."""
        self.done = self._before + self.shares[self._stage] * min(max(part, 0.0), 1.0)
        self._reported = time.monotonic()
        if self._bar:
            self._bar.update(self._task, completed=self.done, text=self.text())
            if self._forks:
                self._bar.refresh()
        else:
            self.log_if_due()

    def line(self) -> str:
        """Title, stage and remaining time."""
        return f"{self.title}: {self.text()}"

    def text(self) -> str:
        """Stage and remaining time."""
        passed, since = self._reported - self._start, time.monotonic() - self._reported
        if not self.done or passed < 1:
            return self._stage
        left = passed * (1 - self.done) / self.done - since
        if left < 0:
            return f"{self._stage}, longer than estimated"
        return f"{self._stage}, about {left:.0f} s left"
