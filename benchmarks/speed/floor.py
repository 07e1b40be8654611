"""The arithmetic that no engine can do without: a network's softplus values and derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from benchmarks.speed.problems import Problem
from nnode.model import Law
from nnode.simulation.kernels.functions import FLAGS, torch_softplus

#: Numbers of a row: 8 kB at most, which stay in the first-level cache.
_ROW = 1024


@njit(error_model="numpy", fastmath=FLAGS)
def rows(x: Any, times: int) -> None:
    """Replace every number by its softplus minus the derivative of that, ``times`` times."""
    for _ in range(times):
        # in place: every round needs the last one, so that none can be left out
        for i in range(len(x)):
            value, slope = torch_softplus(x[i])
            x[i] = value - slope


def evaluations(problem: Problem) -> int:
    """Softplus values in one simulation of a problem, and so derivatives in one gradient.

    One per neuron, step and vehicle that follows another; 0 for models without a speed network.
    """
    shape = problem.shape
    neurons = sum(
        term.network.sizes[1]
        for term in problem.system.terms
        if isinstance(term, Law) and term.network
    )
    return neurons * shape.sequences * (shape.agents - 1) * shape.steps


def floor_call(problem: Problem) -> Callable[[], None] | None:
    """A call that computes as many softplus values and derivatives as one gradient needs.

    One thread, the solver's polynomials and precision, no memory beyond the first-level cache,
    nothing else computed. None where a model needs no softplus.
    """
    times = -(-evaluations(problem) // _ROW)
    if not times:
        return None
    x = np.random.default_rng(1).standard_normal(_ROW).astype(problem.batch.x.numpy().dtype)
    return lambda: rows(x, times)
