"""How far a study's tasks are, with the time left: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import time

from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

from nnode.progress import OnTerminal


class TaskProgress(OnTerminal):
    """Counts tasks, and tells the time left by their expected costs; use as a context manager.

    Args:
        title: of the work.
        total: number of tasks, those that were done before included.
        done: how many were done before.
        cost: of those that are not done, in any unit.
    """

    def __init__(self, title: str, total: int, done: int, cost: float) -> None:
        super().__init__(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
        )
        self.title, self.total, self.done = title, total, done
        self._cost, self._spent = cost, 0.0
        if self._bar:
            self._task = self._bar.add_task(title, total=cost, text=self._text())

    def advance(self, cost: float) -> None:
        """One task more is done."""
        self.done += 1
        self._spent += cost
        self.tick()

    def tick(self) -> None:
        """Show what is known now; called often."""
        if self._bar:
            self._bar.update(self._task, completed=self._spent, text=self._text())
        else:
            self.log_if_due()

    def line(self) -> str:
        """Tasks that are done, and the time left."""
        return f"{self.title}: {self._text()}"

    def _text(self) -> str:
        count = f"{self.done} of {self.total} tasks"
        if not self._spent:
            return count
        passed = time.monotonic() - self._start
        left = passed * max(self._cost - self._spent, 0.0) / self._spent
        return f"{count}, {left:.0f} s left"
