"""The interface of all solvers, and the arithmetic of their time steps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.errors import ConfigError, DataError, SimulationError
from nnode.model.system import System

#: Default steps, s, by domain and order: the paper's for traffic and for crowds at 25 frames/s;
#: crowds recorded at 16 frames/s use the sampling interval. Car following of second order uses the
#: interval of most recordings (Treiber & Kanagaraj 2015).
DEFAULT_STEP = {("traffic", 1): 0.002, ("traffic", 2): 0.1}
_CROWD_STEP = 0.0625

#: Largest number of steps in a sampling interval. In an interval of 1 s the steps are then 1 µs, in
#: which vehicles and people change their speeds by at most 1e-5 m/s.
MOST_STEPS = 10**6


@dataclass
class Trajectory:
    """A simulation at the sampling times of its batch, in float64.

    Attributes:
        x: ``(K, B, N, D)`` m, in the coordinates of the batch.
        v: ``(K, B, N, D)`` m/s in second-order models, else None.
        given: ``(B, N)`` True for agents that follow their measured paths, as a leader with
            ``model.leader=measured``. Their error is 0 by construction, so the model's errors
            exclude them. None if there are none.
    """

    x: Tensor
    v: Tensor | None
    given: Tensor | None = None


class Solver(Protocol):
    """A differentiable simulation of a model on a batch."""

    def __call__(self, system: System, batch: Batch) -> Trajectory:
        """Simulate from the first measured state, at the batch's sampling times."""


def simulated_batch(system: System, batch: Batch) -> tuple[Batch, Tensor | None]:
    """The batch in the precision of simulations.

    Simulations in float64 use the measured positions. Simulations in float32 use positions
    relative to an origin of each sequence, because rounding errors grow with the distance from the
    origin. Positions are not shifted if the model depends on them, as with a speed zone.

    Returns:
        The batch; and the origins ``(B, D)``, m, or None if positions are not shifted.
    """
    if batch.dtype == batch.x.dtype:
        return batch, None
    origin = None if system.depends_on_position else batch.origins()
    return batch.relative_to(origin), origin


def observed(system: System, y: Tensor, batch: Batch, origin: Tensor | None) -> Trajectory:
    """The trajectory of simulated states, in the coordinates of the batch.

    Args:
        y: ``(..., B, N, M)`` states, positions first.
        batch: the measured batch, before :func:`simulated_batch`.
        origin: ``(B, D)`` origins of the states, m; None for 0.
    """
    y = y.to(batch.x.dtype)
    if origin is not None:
        dim = origin.shape[1]
        y = torch.cat([y[..., :dim] + origin[:, None], y[..., dim:]], -1)
    return Trajectory(*system.observe(y, batch), system.given(batch))


def substeps(sampling: float, dt: float | None, system: System) -> int:
    """The whole number of steps in a sampling interval.

    Args:
        sampling: sampling interval, s.
        dt: step, s; None takes the largest one that divides ``sampling`` and is at most
            the default of the model's domain and order.

    Raises:
        ConfigError: ``dt`` is not positive or does not divide the sampling interval, or there are
            more than :data:`MOST_STEPS` steps.
        DataError: the sampling interval is not a positive number, as for a single sample.
    """
    if not (math.isfinite(sampling) and sampling > 0):
        raise DataError(
            f"the sampling interval of the data is {sampling:g} s, expected a positive number; "
            "a sequence needs at least two samples at rising times"
        )
    if dt is not None and not (math.isfinite(dt) and dt > 0):
        raise ConfigError(f"solver.dt={dt} must be a positive number of seconds")
    default = DEFAULT_STEP.get((system.domain, system.order), _CROWD_STEP)
    ratio = sampling / (dt or default)
    if ratio > MOST_STEPS * (1 + 1e-6):
        raise ConfigError(
            f"steps of {dt or default:g} s (solver.dt) are {ratio:.3g} in the sampling interval of "
            f"{sampling:g} s, expected at most {MOST_STEPS:.0e}; take a larger solver.dt, or "
            "solver.dt=null, and check that the times of the data are in seconds"
        )
    if dt is None:
        return max(1, math.ceil(ratio - 1e-6))
    number = round(ratio)
    # recorded times, and so sampling intervals, have rounding errors
    if number < 1 or abs(ratio - number) > 1e-6 * max(1.0, ratio):
        near = " or ".join(f"{value:.6g}" for value in _dividing_steps(sampling, dt))
        raise ConfigError(
            f"solver.dt={dt:g} s does not divide the sampling interval {sampling:g} s of the "
            f"data; use solver.dt={near}, or solver.dt=null to let it be chosen"
        )
    return number


def _dividing_steps(sampling: float, dt: float) -> list[float]:
    """The nearest steps at or below and above ``dt`` that divide ``sampling``, preferably with few
    decimals."""

    def short(number: int) -> bool:
        return float(f"{sampling / number:.3g}") == float(f"{sampling / number:.9g}")

    first = max(1, math.ceil(sampling / dt))
    smaller = next((n for n in range(first, 4 * first) if short(n)), first)
    larger = next((n for n in range(first - 1, 0, -1) if short(n)), None)
    return [sampling / n for n in (smaller, larger) if n]


def check_finite(trajectory: Trajectory, batch: Batch) -> Trajectory:
    """Return the trajectory if it is finite.

    Raises:
        SimulationError: a number is not finite; the message states sequence, agent and time.
    """
    bad = (~trajectory.x.isfinite()).any(-1) & batch.valid
    if bool(bad.any()):
        k, b, n = (int(i) for i in bad.nonzero()[0])
        raise SimulationError(
            f"the simulation of sequence {batch.names[b]} blew up: agent {n} at "
            f"{k * batch.dt:g} s after the start is not a finite number; check the sequence, "
            "start from other parameters, or take a smaller solver.dt"
        )
    return trajectory
