"""How far a work is, with the time left: a bar on a terminal, a line now and then elsewhere."""

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

#: Seconds between lines where no terminal shows the bar.
LINE_EVERY = 10.0
#: Seconds between looks whether a line is due.
_LOOK_EVERY = 0.5


class OnTerminal:
    """Shows a bar where standard error is a terminal, for as long as the context lasts.

    Elsewhere the log gets a line about every ten seconds, also during a long step.

    Args:
        columns: of the bar.
        forks: whether the work forks processes; the bar then moves, and a line is written, only
            when the work reports its state, without a thread.
    """

    def __init__(self, *columns: ProgressColumn, forks: bool = False) -> None:
        self._bar: Progress | None = None
        self._ended, self._lines = threading.Event(), threading.Lock()
        self._beat: threading.Thread | None = None
        self._forks = forks
        #: handlers of the log that write to the terminal, above the bar for as long as it is there
        self._moved: list[tuple[logging.StreamHandler[Any], Any]] = []
        if sys.stderr.isatty():
            # what is printed belongs to the results; the bar shall not be among them in a file
            self._bar = Progress(
                *columns,
                console=Console(stderr=True),
                auto_refresh=not forks,
                redirect_stdout=not forks,  # what children print is theirs
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
                    (one, one.setStream(sys.stderr))  # which the bar has made its own
                    for one in logging.getLogger().handlers
                    if isinstance(one, logging.StreamHandler)
                    and one.stream.isatty()
                    and one.stream is not sys.stderr
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
        """Whether the last line is so long ago that another one may be written; it then counts."""
        with self._lines:
            now = time.monotonic()
            due = now - self._last_line >= LINE_EVERY
            if due:
                self._last_line = now
            return due

    def line(self) -> str:
        """How far the work is, in words."""
        raise NotImplementedError

    def log_if_due(self) -> None:
        """Write a line to the log where the last one is long ago."""
        if self.line_is_due():
            log.info("%s", self.line())

    def _report(self) -> None:
        while not self._ended.wait(_LOOK_EVERY):
            self.log_if_due()


class Stages(OnTerminal):
    """A work of several stages, one after the other; use as a context manager.

    Args:
        title: of the work.
        shares: stage to its usual share of the whole time, in any unit.
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
        """A stage begins; those before it are done. An earlier one starts the estimate anew."""
        names = list(self.shares)
        before = sum(self.shares[name] for name in names[: names.index(stage)])
        if before < self._before:
            self._start = time.monotonic()
        self._stage, self._before = stage, before
        self.within(0.0)

    def within(self, part: float) -> None:
        """So much of the stage is done, between 0 and 1; called often."""
        self.done = self._before + self.shares[self._stage] * min(max(part, 0.0), 1.0)
        self._reported = time.monotonic()
        if self._bar:
            self._bar.update(self._task, completed=self.done, text=self.text())
            if self._forks:
                self._bar.refresh()
        else:
            self.log_if_due()

    def line(self) -> str:
        """Title, stage and time left."""
        return f"{self.title}: {self.text()}"

    def text(self) -> str:
        """Stage and time left."""
        passed, since = self._reported - self._start, time.monotonic() - self._reported
        if not self.done or passed < 1:
            return self._stage
        left = passed * (1 - self.done) / self.done - since
        if left < 0:
            return f"{self._stage}, longer than estimated"
        return f"{self._stage}, about {left:.0f} s left"
