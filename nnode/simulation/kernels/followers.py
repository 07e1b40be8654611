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
from numba import njit, types

from nnode.model.expression import symbols
from nnode.model.names import check_symbols
from nnode.model.terms import LaneDynamics
from nnode.model.text import plain
from nnode.simulation.kernels.functions import LOOP
from nnode.simulation.kernels.loops import Loop
from nnode.simulation.kernels.runs import compiled, fill
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
#: Rows, first index, number, uniform parameters, t, dt, driven leaders, sums.
_RATES = types.void(types.float64[::1], types.int64, types.int64, *[types.float64] * 5)


@dataclass(frozen=True)
class FollowerSource:
    """Source code of a model's rates.

    Attributes:
        lane: flat; formulas contain only the positions and speeds of the vehicles ahead.
    """

    kind: ClassVar[str] = "follower"
    lane: LaneDynamics

    @cached_property
    def constants(self) -> list[str]:
        """Symbols with one value in a run."""
        used = symbols([*self.lane.rates.values(), *self.lane.starts.values()])
        others = {*self.lane.rates, *AHEAD, "t", "dt"}
        return sorted(name for name in used if name not in others)

    def text(self) -> str:
        """The module's source.

        Raises:
            ConfigError: a name in the formulas is not a valid symbol.
        """
        lane = self.lane
        check_symbols([*lane.rates, *self.constants])
        grouped = [f"{group}{s}" for group in _GROUPS for s in lane.rates]
        rows = {row: i for i, row in enumerate(grouped)}
        rows |= {name: len(grouped) + column for name, column in AHEAD.items()}
        rows |= {name: len(grouped) + 4 + i for i, name in enumerate(self.constants)}
        places = [f"_{row} = np.uint64({i * _PITCH})" for row, i in rows.items()]
        formula = "\n".join(f"d{s}/dt = {plain(rate)}" for s, rate in lane.rates.items())
        constants = "\n".join([*places, "OPTIONS = dict(LOOP, cache=True)", ""])
        loop = Loop([], options="OPTIONS")
        return (
            fill("shared", "head", formula=formula, chunk=WIDTH, constants=constants)
            + loop.function("rates", {f"rate_{s}": rate for s, rate in lane.rates.items()})
            + loop.function("starts", lane.starts)
        )


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
    _compiled()(
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
def _compiled() -> Callable[..., None]:
    """:func:`_simulate`, compiled."""
    function, whole, rows = types.FunctionType(_RATES), types.int64, types.float64[:, ::1]
    paths = types.float64[:, :, ::1]
    signature = types.void(
        function, function, rows, paths, rows, whole, rows, types.float64, whole, whole, paths
    )
    run: Callable[..., None] = njit(signature, nogil=True, cache=True, **LOOP)(_simulate)
    return run


def _simulate(
    rates: Callable[..., None],
    starts: Callable[..., None],
    constants: np.ndarray,
    ahead: np.ndarray,
    start: np.ndarray,
    order: int,
    pushes: np.ndarray,
    h: float,
    stride: int,
    parts: int,
    out: np.ndarray,
) -> None:
    """Fill the states ``(K, M, N)`` of N runs at the samples."""
    samples, m, number = out.shape
    buffer, push = np.zeros((5 * m + 4 + len(constants)) * _PITCH), np.zeros(WIDTH)
    rows = buffer.reshape(-1, _PITCH)
    states, rate, rate_before, before, between = (
        rows[:m],
        rows[m : 2 * m],
        rows[2 * m : 3 * m],
        rows[3 * m : 4 * m],
        rows[4 * m : 5 * m],
    )
    for low in range(0, number, WIDTH):
        _load(rows[5 * m + 4 :], constants, low)
        _load(states, start, low)
        _look_ahead(rows[5 * m :], push, ahead, pushes, 0, low)
        if m > order:
            starts(buffer, 0, WIDTH, h, 0.0, h, h, h)
            _add_starts(states[order:], start[order:], low)
        _rates(rates, buffer, push, rate[order - 1], 0.0, h)
        _store(out[0], low, states)
        for step in range((samples - 2 + stride) // stride * parts):
            _step(rates, buffer, m, order, push, ahead, pushes, step, low, h)
            first = step // parts * stride
            for part in range(1, min(stride, samples - first)):
                s = part / stride
                _interpolate(between, s, h, before, states, rate_before, rate)
                _store(out[first + part], low, between)
            if (step + 1) % parts == 0 and first + stride < samples:
                _store(out[first + stride], low, states)


@njit(cache=True, **LOOP)
def _step(
    rates: Callable[..., None],
    buffer: np.ndarray,
    m: int,
    order: int,
    push: np.ndarray,
    ahead: np.ndarray,
    pushes: np.ndarray,
    step: int,
    low: int,
    h: float,
) -> None:
    """A step of ``h`` s by the classic Runge-Kutta method; the rates before it are given."""
    rows, t = buffer.reshape(-1, _PITCH), step * h
    rate, pushed, total = rows[m : 2 * m], rows[m + order - 1], rows[4 * m : 5 * m]
    rows[2 * m : 3 * m], rows[3 * m : 4 * m], total[:] = rate, rows[:m], rate
    for stage in range(3):
        part = h if stage == 2 else h / 2
        for c in range(m):
            _move(rows[c], rows[3 * m + c], part, rate[c])
        if stage != 1:
            _look_ahead(rows[5 * m :], push, ahead, pushes, 2 * step + 1 + stage // 2, low)
        _rates(rates, buffer, push, pushed, t + part, h)
        for c in range(m):
            _move(total[c], total[c], 1.0 if stage == 2 else 2.0, rate[c])
    for c in range(m):
        _move(rows[c], rows[3 * m + c], h / 6, total[c])
    _rates(rates, buffer, push, pushed, t + h, h)


@njit(cache=True, **LOOP)
def _rates(
    rates: Callable[..., None],
    buffer: np.ndarray,
    push: np.ndarray,
    pushed: np.ndarray,
    t: float,
    h: float,
) -> None:
    """The rates at present; ``pushed`` is the one to which the push is added."""
    rates(buffer, 0, WIDTH, h, t, h, h, h)
    _move(pushed, pushed, 1.0, push)


@njit(cache=True, **LOOP)
def _add_starts(states: np.ndarray, start: np.ndarray, low: int) -> None:
    for c in range(len(states)):
        for k in range(min(WIDTH, start.shape[1] - low)):
            states[c, k] += start[c, low + k]


@njit(cache=True, **LOOP)
def _load(rows: np.ndarray, values: np.ndarray, low: int) -> None:
    """Values of the block's runs; behind the last run of all, its value is repeated."""
    for i in range(len(values)):
        for k in range(WIDTH):
            rows[i, k] = values[i, min(low + k, values.shape[1] - 1)]


@njit(cache=True, **LOOP)
def _look_ahead(
    rows: np.ndarray, push: np.ndarray, ahead: np.ndarray, pushes: np.ndarray, at: int, low: int
) -> None:
    """The states of the vehicles ahead, and the pushes, of the block's runs."""
    for c in range(4):
        _repeat(rows[c], ahead[at, c], low)
    if len(pushes):
        _repeat(push, pushes[at], low)


@njit(cache=True, **LOOP)
def _repeat(row: np.ndarray, values: np.ndarray, low: int) -> None:
    """The followers' values ``(F,)``, which are the same in all runs, for the block."""
    f = low % len(values)
    for k in range(WIDTH):
        row[k] = values[f]
        f = f + 1 if f + 1 < len(values) else 0


@njit(cache=True, **LOOP)
def _store(out: np.ndarray, low: int, rows: np.ndarray) -> None:
    for c in range(len(out)):
        for k in range(min(WIDTH, out.shape[1] - low)):
            out[c, low + k] = rows[c, k]


@njit(cache=True, **LOOP)
def _move(to: np.ndarray, start: np.ndarray, seconds: float, rate: np.ndarray) -> None:
    for k in range(WIDTH):
        to[k] = start[k] + seconds * rate[k]


@njit(cache=True, **LOOP)
def _interpolate(
    to: np.ndarray,
    s: float,
    h: float,
    before: np.ndarray,
    after: np.ndarray,
    rate_before: np.ndarray,
    rate_after: np.ndarray,
) -> None:
    """States after the share ``s`` of a step of ``h`` s, by the cubic Hermite polynomial."""
    share_before, share_after = (1 + 2 * s) * (1 - s) ** 2, s**2 * (3 - 2 * s)
    bend_before, bend_after = h * s * (1 - s) ** 2, -h * s**2 * (1 - s)
    for c in range(len(to)):
        for k in range(WIDTH):
            to[c, k] = (
                share_before * before[c, k]
                + share_after * after[c, k]
                + bend_before * rate_before[c, k]
                + bend_after * rate_after[c, k]
            )
