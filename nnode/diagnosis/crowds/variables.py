"""Variables on which deviations of people may depend."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from nnode.diagnosis.residuals.variables import Variable, clock, knots_of, since_start, waves_of
from nnode.model.crowd_formula import dot, norm, walls_of
from nnode.model.effects.crowd import heading
from nnode.model.term import State

Of = Callable[[State], Tensor]

#: Number of knots of a curve; of curves over the position, which may have short waves.
KNOTS, FINE = 9, 25
#: The shortest and the longest waves, along x in m and in time in s.
WAY, CLOCK = (1.5, 10.0), (1.5, 10.0)
#: Width of the kernel of the local density, m.
KERNEL = 1.0
#: Distance of the nearest person if there is none, m.
NOBODY = 100.0
#: Distance of an absent wall, m.
FAR = 1e4


def _ahead(state: State) -> Tensor:
    return heading(state.velocity)


def _left(state: State) -> Tensor:
    return -right_of(heading(state.velocity))


def _along(axis: int) -> Of:
    def direction(state: State) -> Tensor:
        out = torch.zeros_like(state.x)
        out[..., axis] = 1.0
        return out

    return direction


def _position(axis: int) -> Of:
    return lambda state: state.x[..., axis]


def _nearest(state: State) -> tuple[Tensor, Tensor]:
    """Distance ``(B, N)`` of the nearest person, and the unit vector from him ``(B, N, 2)``."""
    pair = Neighbours.of(state)
    far = torch.where(pair.acts > 0, pair.d, NOBODY)
    d, j = far.min(2)
    index = j[..., None, None].expand(*j.shape, 1, 2)
    return d, pair.n.gather(2, index)[:, :, 0]


def _distance(state: State) -> Tensor:
    return _nearest(state)[0]


def _away_from_nearest(state: State) -> Tensor:
    return _nearest(state)[1]


def _bearing(state: State) -> Tensor:
    """Degrees to the left of one's way at which the nearest person is."""
    towards, ahead = -_nearest(state)[1], _ahead(state)
    sine = ahead[..., 0] * towards[..., 1] - ahead[..., 1] * towards[..., 0]
    return torch.rad2deg(torch.atan2(sine, dot(ahead, towards)))


def _approach(state: State) -> Tensor:
    """Speed at which the nearest person comes closer, m/s."""
    pair = Neighbours.of(state)
    far = torch.where(pair.acts > 0, pair.d, NOBODY)
    j = far.argmin(2)[..., None]
    closing = dot(pair.dv, pair.n)
    return closing.gather(2, j)[..., 0]


def _density(state: State) -> Tensor:
    return local_density(Neighbours.of(state), KERNEL)


def _speed(state: State) -> Tensor:
    return torch.linalg.vector_norm(state.velocity, dim=-1)


def _nearest_wall(state: State) -> tuple[Tensor, Tensor]:
    d, n = wall_distance(state)
    distance, w = d.min(2)
    index = w[..., None, None].expand(*w.shape, 1, 2)
    return distance, n.gather(2, index)[:, :, 0]


def _wall(state: State) -> Tensor:
    return _nearest_wall(state)[0]


def _away_from_wall(state: State) -> Tensor:
    return _nearest_wall(state)[1]


def crowd_variables(state: State, start_of: dict[str, float]) -> list[Variable]:
    """The variables of people, with knots where there are data.

    Args:
        state: many moments of the measured and smoothed paths.
        start_of: clock time of the first sample of each sequence, s, by name.
    """
    agent = state.scene.agent
    x, y, ahead, left = "along x", "along y", "ahead", "to the left"
    axes: dict[str, Of] = {x: _along(0), y: _along(1)}
    personal: dict[str, Of] = {ahead: _ahead, left: _left}
    definitions: list[tuple[str, str, Of, dict[str, Of], int]] = [
        ("position x", "m", _position(0), axes, FINE),
        ("position y", "m", _position(1), axes, KNOTS),
        ("clock time", "s", clock, axes, KNOTS),
        ("time since the start", "s", since_start(start_of), personal, KNOTS),
        ("speed", "m/s", _speed, personal, KNOTS),
    ]
    if bool((agent.sum(1) > 1).any()):
        definitions += [
            (
                "distance to the nearest person",
                "m",
                _distance,
                {"away from him": _away_from_nearest, **personal},
                KNOTS,
            ),
            ("bearing of the nearest person", "degrees", _bearing, personal, KNOTS),
            ("speed of approach of the nearest person", "m/s", _approach, personal, KNOTS),
            ("local density", "1/m²", _density, personal, KNOTS),
        ]
    if not state.scene.segment.isnan().any(-1).all():
        definitions.append(
            (
                "distance to the nearest wall",
                "m",
                _wall,
                {"away from it": _away_from_wall, ahead: _ahead},
                KNOTS,
            )
        )
    variables = []
    for name, unit, value, directions, n_knots in definitions:
        observed = value(state)[agent].numpy().astype(float)
        knots = knots_of(observed, n_knots)
        for level, direction in directions.items():
            variables.append(Variable(name, unit, value, knots, direction, level))
    variables += waves_of("position x", "m", _position(0), state.x[..., 0][agent], WAY, axes)
    return variables + waves_of("clock time", "s", clock, clock(state)[agent], CLOCK, axes)


def wall_distance(state: State) -> tuple[Tensor, Tensor]:
    """Distance and direction to the nearest point of each wall: ``(B, N, W)`` m, ``FAR`` for
    absent walls; unit vectors from the wall ``(B, N, W, 2)``."""
    ends, real = walls_of(state.scene)
    start, along = ends[:, None, :, :2], ends[:, None, :, 2:]
    offset = state.x[:, :, None] - start
    share = (dot(offset, along) / dot(along, along).clamp(min=1e-12)).clamp(0, 1)
    away = offset - share[..., None] * along
    d = norm(away)
    return torch.where(real[:, None], d, FAR), away / d[..., None]


def right_of(direction: Tensor) -> Tensor:
    """``(..., 2)``: the direction turned to the right by a quarter."""
    return torch.stack([direction[..., 1], -direction[..., 0]], -1)


@dataclass(frozen=True)
class Neighbours:
    """The state of person j (third axis) relative to person i (second axis).

    Attributes:
        d: ``(B, N, N)`` distance, m.
        n: ``(B, N, N, 2)`` unit vector from j to i.
        dv: ``(B, N, N, 2)`` velocity of j relative to i, m/s.
        acts: ``(B, N, N)`` 1 where j is a real person other than i, else 0.
    """

    d: Tensor
    n: Tensor
    dv: Tensor
    acts: Tensor

    @classmethod
    def of(cls, state: State) -> Neighbours:
        """Everyone's neighbours, where ``state.others`` has them."""
        x, v = state.x, state.velocity
        neighbour_positions, neighbour_velocities = state.others
        dx = x[:, :, None] - neighbour_positions[:, None]
        d = norm(dx)
        apart = ~torch.eye(x.shape[1], dtype=torch.bool, device=x.device)
        acts = (state.scene.agent[:, None, :] & apart).to(x.dtype)
        return cls(d, dx / d[..., None], neighbour_velocities[:, None] - v[:, :, None], acts)


def local_density(pair: Neighbours, kernel: float) -> Tensor:
    """``(B, N)`` 1/m²: of the others, by a Gaussian of width ``kernel`` (m)."""
    spread = torch.exp(-(pair.d**2) / (2 * kernel**2)) / (2 * torch.pi * kernel**2)
    return (spread * pair.acts).sum(2)
