"""How much memory a call needs."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")

_PROCESS = Path("/proc/self")


def peak_memory(call: Callable[[], Result]) -> tuple[Result, dict[str, float | None]]:
    """Call once, and see what the process holds at most meanwhile.

    Returns:
        The call's result, and ``peak_memory_MB``, the largest resident memory of the process during
        the call, MB; ``memory_MB``, by how much that is more than before the call, MB. Both are
        None where the system does not say (other systems than Linux).
    """
    gc.collect()
    try:
        # what earlier calls have freed goes back to the system, and the largest memory is forgotten
        ctypes.CDLL(None).malloc_trim(0)
        (_PROCESS / "clear_refs").write_text("5")
        before = _largest()
    except (AttributeError, OSError):
        return call(), {"peak_memory_MB": None, "memory_MB": None}
    result, peak = call(), _largest()
    return result, {"peak_memory_MB": peak, "memory_MB": peak - before}


def _largest() -> float:
    """The largest resident memory of this process, MB."""
    status = (_PROCESS / "status").read_text().splitlines()
    (line,) = (line for line in status if line.startswith("VmHWM:"))
    return float(line.split()[1]) * 1024 / 1e6
