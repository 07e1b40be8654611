"""Variables on which deviations of vehicles may depend."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import PADDING_GAP, Batch
from nnode.diagnosis.residuals.variables import Variable, clock, knots_of, since_start, waves_of
from nnode.model.effects.lane import gaps
from nnode.model.term import State

#: Number of knots of a curve.
KNOTS = 33
#: The shortest and the longest waves, along the road in m and in time in s.
ROAD, CLOCK = (30.0, 300.0), (5.0, 60.0)


def _followers(state: State) -> Tensor:
    return state.scene.follower[..., None].to(state.x.dtype)


def _gap(state: State) -> Tensor:
    return gaps(state.x)


def _next_gap(state: State) -> Tensor:
    gap = gaps(state.x)
    ahead = torch.cat([gap[:, 1:], gap[:, -1:]], 1)
    # the follower of the leader has no next gap
    return torch.where(ahead > PADDING_GAP / 2, gap, ahead)


def _rear_gap(state: State) -> Tensor:
    gap = gaps(state.x)
    return torch.cat([gap[:, :1], gap[:, :-1]], 1)


def _position(state: State) -> Tensor:
    return state.x[..., 0]


def _speed(state: State) -> Tensor:
    assert state.rate is not None
    return state.rate[..., 0]


def _speed_difference(state: State) -> Tensor:
    rate = _speed(state)
    return torch.cat([rate[:, 1:] - rate[:, :-1], torch.zeros_like(rate[:, :1])], 1)


def _leader_speed(state: State) -> Tensor:
    speed = state.scene.measured_rate_at(state.t)[..., 0]
    leader_speed = torch.where(state.scene.leader, speed, 0.0).sum(1, keepdim=True)
    return leader_speed.expand(speed.shape)


def _rank(state: State) -> Tensor:
    number = state.scene.agent.sum(1, keepdim=True)
    place = torch.arange(state.x.shape[1], dtype=state.x.dtype)
    return (number - 1 - place).to(state.x.dtype)


def platoon_variables(batch: Batch) -> list[Variable]:
    """The variables of vehicles in whole platoons, with knots where there are data.

    Args:
        batch: smoothed windows; windows of one sequence bear its name.
    """
    samples, x, v = _follower_samples(batch), batch.x[..., 0], batch.v[..., 0]
    last = batch.agent.sum(1) - 1
    gap = _measured_gap(batch)
    behind = torch.cat([gap[..., :1], gap[..., :-1]], -1)
    leader_speed = v[:, torch.arange(len(batch)), last][..., None].expand(x.shape)
    rank = (last[:, None] - torch.arange(x.shape[2])).expand(x.shape)

    def of(name: str, unit: str, value: Callable[[State], Tensor], seen: Tensor) -> Variable:
        return _variable(name, unit, value, seen[samples].numpy())

    return [
        *vehicle_variables(batch),
        of("rear gap", "m", _rear_gap, behind),
        of("speed of the leader", "m/s", _leader_speed, leader_speed),
        of("place in the platoon", "1", _rank, rank),
    ]


def place_variables(ahead: np.ndarray, behind: np.ndarray) -> list[Variable]:
    """The variables of followers' places in platoons.

    Args:
        ahead, behind: ``(F,)`` numbers of vehicles of the platoon, in the order of the followers'
            states.
    """

    def of(name: str, number: np.ndarray) -> Variable:
        def value(state: State) -> Tensor:
            of_states = torch.from_numpy(number).repeat(len(state.x) // len(number))
            return of_states[:, None].expand(state.x.shape[:2]).to(state.x.dtype)

        return _variable(name, "1", value, number)

    return [of("place in the platoon", ahead), of("vehicles behind", behind)]


def vehicle_variables(batch: Batch) -> list[Variable]:
    """The variables of vehicles and of those ahead, with knots where there are data.

    Args:
        batch: smoothed windows; windows of one sequence bear its name.
    """
    samples, x, v = _follower_samples(batch), batch.x[..., 0], batch.v[..., 0]
    gap = _measured_gap(batch)
    difference = torch.cat([torch.diff(v), torch.zeros_like(v[..., :1])], -1)
    times = batch.start[:, None] + batch.dt * torch.arange(len(x))[:, None, None]
    start_of: dict[str, float] = {}
    for name, start in zip(batch.names, batch.start.tolist(), strict=True):
        start_of[name] = min(start_of.get(name, start), start)
    since = times - torch.tensor([start_of[name] for name in batch.names])[:, None]
    ahead = torch.cat([gap[..., 1:], gap[..., -1:]], -1)
    ahead = torch.where(ahead.isnan() | (ahead > PADDING_GAP / 2), gap, ahead)

    def of(name: str, unit: str, value: Callable[[State], Tensor], seen: Tensor) -> Variable:
        return _variable(name, unit, value, seen.expand(x.shape)[samples].numpy())

    def waves(
        name: str,
        unit: str,
        value: Callable[[State], Tensor],
        seen: Tensor,
        between: tuple[float, float],
    ) -> list[Variable]:
        values = seen.expand(x.shape)[samples]
        return waves_of(name, unit, value, values, between, {"": _followers})

    return [
        of("gap", "m", _gap, gap),
        of("speed", "m/s", _speed, v),
        of("speed difference", "m/s", _speed_difference, difference),
        of("next gap", "m", _next_gap, ahead),
        of("position", "m", _position, x),
        of("clock time", "s", clock, times),
        of("time since the start", "s", since_start(start_of), since),
        *waves("position", "m", _position, x, ROAD),
        *waves("clock time", "s", clock, times, (max(CLOCK[0], 4 * batch.dt), CLOCK[1])),
    ]


def _variable(name: str, unit: str, value: Callable[[State], Tensor], seen: np.ndarray) -> Variable:
    """A variable with knots at quantiles of the values that were seen."""
    return Variable(name, unit, value, knots_of(seen.astype(float), KNOTS), _followers)


def _follower_samples(batch: Batch) -> Tensor:
    """``(K, B, N)`` True at samples of followers."""
    samples = batch.valid.clone()
    samples[:, torch.arange(len(batch)), batch.agent.sum(1) - 1] = False
    return samples


def _measured_gap(batch: Batch) -> Tensor:
    """``(K, B, N)`` m; NaN at the last place."""
    x = batch.x[..., 0]
    return torch.cat([torch.diff(x), torch.full_like(x[..., :1], torch.nan)], -1)
