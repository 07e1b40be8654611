"""The trajectory cost J of the paper, and what it is made of."""

from __future__ import annotations

from enum import Enum

from torch import Tensor

from nnode.data.sequence import Batch
from nnode.solvers.base import Trajectory


class Convention(str, Enum):
    """How squared distances become a cost; in both, the mean over sequences is reported.

    ``integral``: J = 1/2 sum_k dt ||z(t_k) - x(t_k)||², in m² s. The printed costs of the
    traffic tables have this scale.
    ``sum``: J = 1/2 sum_k ||z(t_k) - x(t_k)||², in m². The printed costs of the crowd section
    have this scale.
    """

    integral = "integral"
    sum = "sum"


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
    """
    weight = 0.5 * (batch.dt if convention is Convention.integral else 1.0)
    total: Tensor = weight * squared_error(trajectory, batch).sum((0, -1))
    return total
