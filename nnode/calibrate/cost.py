"""What a calibration minimises: the trajectory cost J of the paper, and those of car following."""

from __future__ import annotations

from enum import Enum

import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.errors import ConfigError
from nnode.simulation.base import Trajectory

#: Gaps below this count as this in logarithms and quotients, m.
LEAST_GAP = 0.1


class Convention(str, Enum):
    """How the distance between simulation and measurement becomes a cost of a sequence.

    ``integral``: J = 1/2 sum_k dt ||z(t_k) - x(t_k)||², in m² s. The printed costs of the
    traffic tables have this scale.
    ``sum``: J = 1/2 sum_k ||z(t_k) - x(t_k)||², in m². The printed costs of the crowd section
    have this scale.

    Of vehicles that follow another, over all samples after the first (Punzo & Montanino 2016;
    Treiber & Kesting 2013 for the logarithm):

    ``spacing``: root mean square error of the gap, m; the mean over pairs that the field reports.
    ``gap``: mean square error of the gap, m².
    ``relative_gap``: mean square of the gap's relative error.
    ``log_gap``: mean square error of the gap's logarithm.
    ``speed``: mean square error of the speed, (m/s)²; of laws of second order.
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
        """Of the cost."""
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
#: Those of vehicles that follow another.
FOLLOWING = tuple(kind for kind in Convention if kind not in _OF_PLACES)


def squared_error(trajectory: Trajectory, batch: Batch) -> Tensor:
    """``(K, B, N)`` squared distance between simulation and measurement, m²; 0 in the padding.

    Runs side by side, ``(K, R, B, N, D)`` positions, give ``(K, R, B, N)``.
    """
    measured, valid = batch.x, batch.valid[..., None]
    if trajectory.x.ndim > measured.ndim:
        measured, valid = measured[:, None], valid[:, None]
    away = trajectory.x - measured
    # masked before squaring: past its last sample a simulation may leave the finite numbers
    return away.masked_fill(~valid, 0.0).square().sum(-1)


def sequence_costs(
    trajectory: Trajectory, batch: Batch, convention: Convention = Convention.integral
) -> Tensor:
    """``(B,)`` cost of every sequence: summed over samples and agents, see :class:`Convention`.

    Runs side by side give ``(R, B)``.

    Raises:
        ConfigError: an objective of vehicles for people, or of speeds for a law of first order.
    """
    if convention in _OF_PLACES:
        weight = 0.5 * (batch.dt if convention is Convention.integral else 1.0)
        total: Tensor = weight * squared_error(trajectory, batch).sum((0, -1))
        return total
    v = None if trajectory.v is None else trajectory.v[..., 0]
    away, seen = errors(trajectory.x[..., 0], v, batch, convention)
    mean = away.square().sum((0, -1)) / seen.sum((0, -1)).clamp(min=1)
    if convention is not Convention.spacing:
        return mean
    # of an exact simulation the root has no slope
    return torch.where(mean > 0, mean, 1.0).sqrt() * (mean > 0)


def net_gaps(x: Tensor, batch: Batch) -> Tensor:
    """``(..., B, N - 1)`` bumper to bumper, m, of positions ``(..., B, N)``; lengths that are not
    known count as 0."""
    return torch.diff(x) - torch.nan_to_num(batch.length)[:, 1:]


def errors(
    x: Tensor, v: Tensor | None, batch: Batch, convention: Convention
) -> tuple[Tensor, Tensor]:
    """What is squared, and which of it counts; 0 where it does not.

    Args:
        x, v: ``(K, [R,] B, N D)`` simulated, m and m/s.

    Returns:
        ``(K, [R,] B, N D)`` errors of coordinates, or ``(K, [R,] B, N - 1)`` of followers.
    """
    if convention in _OF_PLACES:
        seen = batch.valid.repeat_interleave(batch.x.shape[-1], -1)
        return torch.where(seen, x - batch.x.flatten(-2), 0.0), seen
    if batch.x.shape[-1] != 1:
        raise ConfigError(
            f"trainer.cost={convention.value} is one of vehicles that follow another; take "
            "integral or sum for people"
        )
    if convention is Convention.speed and v is None:
        raise ConfigError(
            "trainer.cost=speed needs a law of second order, which has speeds; take another cost"
        )
    seen = batch.valid[:, :, 1:].clone()
    seen[0] = False
    measured_x, measured_v = batch.x[..., 0], batch.v[..., 0]
    if x.ndim > measured_x.ndim:
        seen, measured_x, measured_v = seen[:, None], measured_x[:, None], measured_v[:, None]
    if convention is Convention.speed:
        assert v is not None
        away = (v - measured_v)[..., :-1]
    else:
        away = changed_gap(net_gaps(x, batch), net_gaps(measured_x, batch), convention)
    return torch.where(seen, away, 0.0), seen.expand(away.shape)


def changed_gap(gap: Tensor, measured: Tensor, convention: Convention) -> Tensor:
    """Error of a gap (m) by an objective."""
    if convention is Convention.log_gap:
        return gap.clamp(min=LEAST_GAP).log() - measured.clamp(min=LEAST_GAP).log()
    away = gap - measured
    return away / measured.clamp(min=LEAST_GAP) if convention is Convention.relative_gap else away
