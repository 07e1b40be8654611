"""How much memory a call needs."""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")

_PROCESS = Path("/proc/self")


def peak_memory(call: Callable[[], Result]) -> tuple[Result, dict[str, float | None]]:
    """Call once, and see what the process holds at most meanwhile.

    Returns:
        The call's result, and ``peak_memory_MB``, the largest resident memory of the process during
        the call, MB; ``memory_MB``, by how much that is more than before the call, MB. Where the
        system does not say (other systems than Linux), ``peak_memory_MB`` is the largest since the
        process began, or None, and ``memory_MB`` is None.
    """
    before = _reset()
    result = call()
    if before is not None:
        peak = _status("VmHWM")
        assert peak is not None
        return result, {"peak_memory_MB": peak, "memory_MB": peak - before}
    return result, {"peak_memory_MB": _since_start(), "memory_MB": None}


def _reset() -> float | None:
    """Forget the largest memory so far; what is held now, MB, or None where that cannot be."""
    gc.collect()
    with suppress(AttributeError, OSError):
        # what earlier calls have freed goes back to the system, where the C library can do this
        ctypes.CDLL(None).malloc_trim(0)
    try:
        (_PROCESS / "clear_refs").write_text("5")
    except OSError:
        return None
    return _status("VmHWM")


def _status(key: str) -> float | None:
    """A line of the process's status, MB."""
    with suppress(OSError):
        for line in (_PROCESS / "status").read_text().splitlines():
            name, _, value = line.partition(":")
            if name == key:
                return float(value.split()[0]) * 1024 / 1e6
    return None


def _since_start() -> float | None:
    try:
        import resource
    except ImportError:  # Windows
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most * (1 if sys.platform == "darwin" else 1024) / 1e6
