"""Handling of SIGINT (Ctrl-C) and SIGTERM as requests to save and stop."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any

from nnode.errors import NNodeError


class Interrupted(NNodeError):
    """A signal stopped a run, which has saved its state.

    Attributes:
        signal: number of the signal.
    """

    def __init__(self, message: str, number: int) -> None:
        super().__init__(message)
        self.signal = number


class InterruptGuard:
    """Inside the context, the first SIGINT or SIGTERM only sets :attr:`requested`.

    A second signal acts as without the guard. Outside the main thread signals cannot be caught,
    and the guard does nothing.
    """

    def __init__(self) -> None:
        self.requested: int | None = None
        self._before: dict[int, Any] = {}

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.requested = number
        self._restore()

    def _restore(self) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)

    def __enter__(self) -> InterruptGuard:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._restore()


class BreakingGuard(InterruptGuard):
    """Inside the context, the first SIGINT or SIGTERM raises KeyboardInterrupt at once.

    For work that may be interrupted anywhere; :attr:`requested` is the number of the signal.

    Args:
        consequence: what the interruption leaves, the end of the message of :class:`Interrupted`,
            which then replaces KeyboardInterrupt at the end of the context.
    """

    def __init__(self, consequence: str = "") -> None:
        super().__init__()
        self._consequence = consequence

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        super().__exit__(kind, error, trace)
        if self._consequence and isinstance(error, KeyboardInterrupt):
            number = self.requested or signal.SIGINT
            name = signal.Signals(number).name
            raise Interrupted(f"stopped by {name}{self._consequence}", number) from None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        super()._handle(number, frame)
        raise KeyboardInterrupt
