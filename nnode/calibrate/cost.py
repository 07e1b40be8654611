"""Costs of calibrations: the trajectory cost J of the paper, and costs of car following."""

from __future__ import annotations

import math
from enum import Enum

import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.errors import ConfigError
from nnode.simulation.base import Trajectory

#: Lower bound of gaps in logarithms and quotients, m.
LEAST_GAP = 0.1


class Convention(str, Enum):
    """The cost of a sequence from the distance between simulation and measurement.

    ``integral``: J = 1/2 sum_k dt ||z(t_k) - x(t_k)||², in m² s. The printed costs of the
    traffic tables have this scale.
    ``sum``: J = 1/2 sum_k ||z(t_k) - x(t_k)||², in m². The printed costs of the crowd section
    have this scale.

    For vehicles that follow another vehicle, over all samples after the first (Punzo & Montanino
    2016; Treiber & Kesting 2013 for the logarithm):

    ``spacing``: root mean square error of the gap, m; publications report its mean over pairs.
    ``gap``: mean square error of the gap, m².
    ``relative_gap``: mean square of the gap's relative error.
    ``log_gap``: mean square error of the gap's logarithm.
    ``speed``: mean square error of the speed, (m/s)², for laws of second order.
    """

    integral = "integral"
    sum = "sum"
    spacing = "spacing"
    gap = "gap"
    relative_gap = "relative_gap"
    log_gap = "log_gap"
    speed = "speed"

    @property
    def unit(self) -> str:
        """Unit of the cost."""
        return _UNITS[self]


_UNITS = {
    Convention.integral: "m² s",
    Convention.sum: "m²",
    Convention.spacing: "m",
    Convention.gap: "m²",
    Convention.relative_gap: "1",
    Convention.log_gap: "1",
    Convention.speed: "m²/s²",
}
_OF_PLACES = (Convention.integral, Convention.sum)
#: Costs of vehicles that follow another vehicle.
FOLLOWING = tuple(kind for kind in Convention if kind not in _OF_PLACES)


def squared_error(trajectory: Trajectory, batch: Batch) -> Tensor:
    """``(K, B, N)`` squared distance between simulation and measurement, m²; 0 in the padding.

    Positions ``(K, R, B, N, D)`` of R runs give ``(K, R, B, N)``.
    """
    measured, valid = batch.x, batch.valid[..., None]
    if trajectory.x.ndim > measured.ndim:
        measured, valid = measured[:, None], valid[:, None]
    deviation = trajectory.x - measured
    # masked before squaring, because simulations may blow up after the last sample
    return deviation.masked_fill(~valid, 0.0).square().sum(-1)


def sequence_costs(
    trajectory: Trajectory, batch: Batch, convention: Convention = Convention.integral
) -> Tensor:
    """``(B,)`` cost of every sequence, see :class:`Convention`; ``(R, B)`` for R runs.

    Raises:
        ConfigError: a cost of vehicles for people, or of speeds for a law of first order.
    """
    if convention in _OF_PLACES:
        weight = 0.5 * (batch.dt if convention is Convention.integral else 1.0)
        total: Tensor = weight * squared_error(trajectory, batch).sum((0, -1))
        return total
    v = None if trajectory.v is None else trajectory.v[..., 0]
    deviation, counted = errors(trajectory.x[..., 0], v, batch, convention)
    mean = deviation.square().sum((0, -1)) / counted.sum((0, -1)).clamp(min=1)
    if convention is not Convention.spacing:
        return mean
    # the root has no derivative at 0; NaN, of simulations that blow up, stays NaN
    return torch.where(mean == 0, 1.0, mean).sqrt() * (mean != 0)


def net_gaps(x: Tensor, batch: Batch) -> Tensor:
    """``(..., B, N - 1)`` bumper-to-bumper gaps, m, of positions ``(..., B, N)``. Unknown lengths
    count as 0."""
    return torch.diff(x) - torch.nan_to_num(batch.length)[:, 1:]


def errors(
    x: Tensor, v: Tensor | None, batch: Batch, convention: Convention
) -> tuple[Tensor, Tensor]:
    """The errors that a cost squares, and the mask of those that count; 0 where masked out.

    Args:
        x, v: ``(K, [R,] B, N D)`` simulated positions and speeds, m and m/s.

    Returns:
        ``(K, [R,] B, N D)`` errors of coordinates, or ``(K, [R,] B, N - 1)`` of followers; and
        the mask.

    Raises:
        ConfigError: see :func:`sequence_costs`.
    """
    if convention in _OF_PLACES:
        counted = batch.valid.repeat_interleave(batch.x.shape[-1], -1)
        return torch.where(counted, x - batch.x.flatten(-2), 0.0), counted
    if batch.x.shape[-1] != 1:
        raise ConfigError(
            f"trainer.cost={convention.value} is one of vehicles that follow another; take "
            "integral or sum for people"
        )
    if convention is Convention.speed and v is None:
        raise ConfigError(
            "trainer.cost=speed needs a law of second order, which has speeds; take another cost"
        )
    counted = batch.valid[:, :, 1:].clone()
    counted[0] = False
    measured_x, measured_v = batch.x[..., 0], batch.v[..., 0]
    if x.ndim > measured_x.ndim:
        counted, measured_x, measured_v = counted[:, None], measured_x[:, None], measured_v[:, None]
    if convention is Convention.speed:
        assert v is not None
        deviation = (v - measured_v)[..., :-1]
    else:
        deviation = changed_gap(net_gaps(x, batch), net_gaps(measured_x, batch), convention)
    return torch.where(counted, deviation, 0.0), counted.expand(deviation.shape)


def changed_gap(gap: Tensor, measured: Tensor, convention: Convention) -> Tensor:
    """Error of a gap (m) by the convention of a cost."""
    if convention is Convention.log_gap:
        # without this, a vehicle that blows up to infinity would have the smallest gap
        finite = torch.where(gap.isfinite(), gap, math.nan)
        return finite.clamp(min=LEAST_GAP).log() - measured.clamp(min=LEAST_GAP).log()
    deviation = gap - measured
    return (
        deviation / measured.clamp(min=LEAST_GAP)
        if convention is Convention.relative_gap
        else deviation
    )
