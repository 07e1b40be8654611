"""What the compiled functions are told about a simulation, and how threads share it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.solvers.fused.laws import LawKernel


@dataclass(frozen=True)
class Plan:
    """Everything of a simulation that carries no gradient."""

    kernel: LawKernel
    jobs: tuple[np.ndarray, ...]  # for every thread rows of run, first simulation, width, slot
    size: int
    slots: int
    steps: int
    per: int
    dt: Any
    number: np.ndarray
    end: np.ndarray
    measured: np.ndarray
    samples: int

    def start(self, grad: np.ndarray) -> Tensor:
        """The gradient ``(B, N)`` of the start, without leaders whose place is measured."""
        found = torch.from_numpy(grad)
        if not len(self.measured):
            return found
        last = torch.from_numpy(self.number)[:, None] - 1
        return found.masked_fill(last == torch.arange(found.shape[1]), 0.0)


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
