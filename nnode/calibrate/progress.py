"""Progress of a training: steps, rate and remaining time."""

from __future__ import annotations

import time

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TextColumn,
    TimeRemainingColumn,
)

from nnode.progress import OnTerminal


class Reporter(OnTerminal):
    """Shows the progress of a run; use as a context manager.

    Args:
        total: number of steps at the end.
        done: steps done before this start.
    """

    def __init__(self, total: int, done: int = 0) -> None:
        super().__init__(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]:.1f} steps/s"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
        )
        self.total, self.done = total, done
        self._begun, self._first, self._note = done, done, ""
        if self._bar:
            self._task = self._bar.add_task(
                "training", total=total, completed=done, rate=0.0, note=""
            )

    def advance(self, note: str = "") -> None:
        """Count a finished step."""
        self.done += 1
        if self.done == self._begun + 1:  # the first step includes compilation
            self._first, self._start = self.done, time.monotonic()
        if self._bar:
            self._bar.update(self._task, completed=self.done, rate=self._rate(), note=note)
        else:
            self._note = note
            self.log_if_due()

    def line(self) -> str:
        """The steps, their rate and the remaining time as text."""
        text = f"training: step {self.done} of {self.total}"
        if self.done == self._first:
            return text
        left = (self.total - self.done) / self._rate()
        return f"{text}, {self._rate():.1f} steps/s, about {left:.0f} s left, {self._note}"

    def _rate(self) -> float:
        """Steps per second since the first one."""
        return (self.done - self._first) / max(time.monotonic() - self._start, 1e-9)
