"""Simulations of followers behind given paths of the vehicles ahead, in compiled code.

A run of a follower is independent of all others. Runs are simulated in blocks. A block is a buffer
with a row of numbers for every state, rate, state of the vehicles ahead and constant. Only the
rates are generated from formulas. The simulation calls them by their address, so that it is
compiled once for all models.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, ClassVar

import numpy as np

from nnode.model.expression import Expr, symbols
from nnode.model.terms import LaneDynamics
from nnode.simulation.kernels.loops import Loop
from nnode.simulation.kernels.runs import Source, compiled
from nnode.simulation.numpy import strides

#: Runs in a block.
WIDTH = 128
#: Distance of rows. With powers of two, rows would compete for the same lines of the cache.
_PITCH = WIDTH + 8
#: Groups of rows, with a row for every state in each: states, rates, rates and states at the
#: beginning of the step, and the weighted sum of rates.
_GROUPS = ("", "rate_", "rate_before_", "before_", "sum_")
#: States of the vehicles ahead in formulas: their columns in the paths ahead.
AHEAD = {"x_1": 0, "v_1": 1, "dx_1": 1, "measured": 1, "x_2": 2, "v_2": 3}


@dataclass(frozen=True)
class FollowerSource(Source):
    """Source code of a model's rates.

    Attributes:
        lane: flat; formulas contain only the positions and speeds of the vehicles ahead.
    """

    kind: ClassVar[str] = "follower"
    width: ClassVar[int] = WIDTH
    pitch: ClassVar[int] = _PITCH
    loop: ClassVar[Loop] = Loop([], options="OPTIONS")
    lane: LaneDynamics

    @cached_property
    def constants(self) -> list[str]:
        """Symbols with one value in a run."""
        used = symbols([*self.lane.rates.values(), *self.lane.starts.values()])
        others = {*self.lane.rates, *AHEAD, "t", "dt"}
        return sorted(name for name in used if name not in others)

    @property
    def rates(self) -> dict[str, Expr]:
        """Row to the rate that is stored there."""
        return {f"rate_{state}": rate for state, rate in self.lane.rates.items()}

    @property
    def names(self) -> list[str]:
        return [*self.lane.rates, *self.constants]

    @property
    def rows(self) -> dict[str, int]:
        """Quantity to its row of the buffer."""
        grouped = [f"{group}{s}" for group in _GROUPS for s in self.lane.rates]
        ahead = {name: len(grouped) + column for name, column in AHEAD.items()}
        constants = {name: len(grouped) + 4 + i for i, name in enumerate(self.constants)}
        return {**{row: i for i, row in enumerate(grouped)}, **ahead, **constants}


@dataclass(frozen=True)
class DriverSource(Source):
    """Source code of the simulation with any rates."""

    kind: ClassVar[str] = "followers"
    names: ClassVar[tuple[str, ...]] = ()
    width: ClassVar[int] = WIDTH
    pitch: ClassVar[int] = _PITCH


def simulate(
    lane: LaneDynamics,
    constants: Mapping[str, Any],
    ahead: np.ndarray,
    start: np.ndarray,
    added: np.ndarray,
    pushes: np.ndarray | None,
    dt: float,
    samples: int,
    longest: float,
) -> np.ndarray:
    """``(K, M, R, F)`` states of R runs of F followers every ``dt`` s, as by
    :func:`nnode.simulation.numpy.simulated`.

    Args:
        lane: the model, see :class:`FollowerSource`.
        constants: symbol to a value of all runs, of followers ``(F,)`` or of runs ``(R, F)``.
        ahead: ``(H, 4, F)`` positions (m) and speeds (m/s) of the first and of the second vehicle
            ahead, twice in a step.
        start: ``(order, R, F)`` states of motion at the start.
        added: ``(M - order, R, F)`` what is added to the formulas of other states at the start.
        pushes: ``(H, F)`` on the highest rate.
        samples: K. longest: step, s.
    """
    source, shape = FollowerSource(lane), start.shape[1:]
    stride, parts = strides(dt, longest)
    values = [np.broadcast_to(constants[name], shape).ravel() for name in source.constants]
    out = np.empty((samples, len(lane.rates), start[0].size))
    module = compiled(source)
    _driver()(
        module.rates,
        module.starts,
        np.array(values, dtype=float).reshape(len(values), -1),
        np.ascontiguousarray(ahead),
        np.concatenate([start, added]).reshape(len(lane.rates), -1),
        len(start),
        np.zeros((0, 0)) if pushes is None else np.ascontiguousarray(pushes),
        dt * stride / parts,
        stride,
        parts,
        out,
    )
    return out.reshape(*out.shape[:2], *shape)


@cache
def _driver() -> Callable[..., None]:
    """The compiled simulation, which takes the rates of any model."""
    module = compiled(DriverSource())
    run = module.simulate
    run.compile(module.SIGNATURE)
    run.disable_compile()
    return run
