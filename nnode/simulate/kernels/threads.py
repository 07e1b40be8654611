"""Work on several threads: compiled functions release Python's lock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="nnode-fused")


def run_all(call: Callable[[np.ndarray], None], jobs: Sequence[np.ndarray]) -> None:
    """Run a compiled function on every share of the jobs, one thread each."""
    if len(jobs) == 1:
        call(jobs[0])
        return
    others = [_pool(len(jobs) - 1).submit(call, share) for share in jobs[1:]]
    call(jobs[0])
    for other in others:
        other.result()
