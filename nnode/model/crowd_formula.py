"""The accelerations of a crowd by PyTorch, from the formula of its model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from nnode.model.arrays import Code, computed
from nnode.model.scene import Scene
from nnode.model.term import State, Term
from nnode.model.terms import (
    NOBODY,
    OTHERS,
    POINTS,
    SMALLEST,
    WALLS,
    CrowdDynamics,
    own_values,
    values_of,
)


def settings_of(terms: Sequence[Any], law: CrowdDynamics) -> dict[str, float]:
    """Symbol to value of what terms have fixed."""
    return {name: float(getattr(terms[i], part)) for name, (i, part) in law.settings.items()}


def people_of(terms: Sequence[Any], law: CrowdDynamics, scene: Scene) -> dict[str, Tensor]:
    """Symbol to ``(B, N)`` or ``(B, 1)`` values of what people have from the data."""
    found = {name: terms[i].inputs(scene)[part] for name, (i, part) in law.inputs.items()}
    found["people"], found["points"] = scene.count[:, 0], scene.wall_count[:, 0]
    found["start"], found["pace"] = scene.start[:, None], scene.pace
    return {name: value.to(scene.destination.dtype) for name, value in found.items()}


def rates_of(
    terms: Sequence[Term], law: CrowdDynamics, state: State, code: Mapping[str, Code] | None = None
) -> Tensor:
    """``(B, N, 2)`` m/s² of a crowd's formula, m/s where it is of first order."""
    x, scene = state.x, state.scene
    v = state.v
    if v is None:
        v = torch.zeros_like(x) if law.order == 1 else state.others[1]
    given: dict[str, Tensor] = {"t": state.t.to(x.dtype)}
    given |= dict(zip(law.owned, values_of(law, own_values(terms, law)), strict=True))
    given |= {name: x.new_tensor(value) for name, value in settings_of(terms, law).items()}
    own = dict(zip(("x", "y", "vx", "vy"), (*x.unbind(-1), *v.unbind(-1)), strict=True))
    own |= dict(zip(("goal_x", "goal_y"), scene.destination.unbind(-1), strict=True))
    own |= people_of(terms, law, scene)
    sums: dict[str, Tensor] = {}
    for over, found in law.sums.items():
        if not found:
            continue
        seen, real = _SEEN[over](state, x, v)
        if over in (OTHERS, SMALLEST):
            seen |= {f"{name}_j": own[name][:, None] for name in law.inputs}
        known = own | sums if over == SMALLEST else own
        values = given | {name: value[:, :, None] for name, value in known.items()} | seen
        each = computed(list(found.values()), values, code=code)
        reduced = _least if over == SMALLEST else _sum
        sums |= {
            name: reduced(value, real).expand(x.shape[:2])
            for name, value in zip(found, each, strict=True)
        }
    rate = computed(law.rate, given | own | sums, code=code)
    return torch.stack([part.expand(x.shape[:2]) for part in rate], -1)


def _sum(value: Tensor, real: Tensor) -> Tensor:
    """Over the third axis, of what exists."""
    return (value * real).sum(2)


def _least(value: Tensor, real: Tensor) -> Tensor:
    """The smallest over the third axis, of what exists; the slope is that of the first of them."""
    value = torch.where(real > 0, value, NOBODY)
    nobody = value.new_full((*value.shape[:2], 1), NOBODY)
    value = torch.cat([value, nobody], 2)
    return value.gather(2, value.detach().argmin(2, keepdim=True))[..., 0]


_Seen = tuple[dict[str, Tensor], Tensor]


def _others(state: State, x: Tensor, v: Tensor) -> _Seen:
    """What everybody (second axis) sees of the others (third), and 1 where they are others."""
    other, speed = state.seen or (x, v)
    dx, dv = x[:, :, None] - other[:, None], v[:, :, None] - speed[:, None]
    apart = ~torch.eye(x.shape[1], dtype=torch.bool, device=x.device)
    seen = {"dx": dx[..., 0], "dy": dx[..., 1], "dvx": dv[..., 0], "dvy": dv[..., 1]}
    return seen, (state.scene.agent[:, None, :] & apart).to(x.dtype)


def _points(state: State, x: Tensor, v: Tensor) -> _Seen:
    wall, normal, real = state.scene.walls_of_each()
    dx = x[:, :, None] - wall
    seen = {"dx": dx[..., 0], "dy": dx[..., 1]}
    return seen | {"normal_x": normal[..., 0], "normal_y": normal[..., 1]}, real.to(x.dtype)


def _walls(state: State, x: Tensor, v: Tensor) -> _Seen:
    ends, real = walls_of(state.scene)
    dx, along = x[:, :, None] - ends[:, None, :, :2], ends[:, None, :, 2:]
    seen = {"dx": dx[..., 0], "dy": dx[..., 1]}
    return seen | {"along_x": along[..., 0], "along_y": along[..., 1]}, real[:, None].to(x.dtype)


def walls_of(scene: Scene) -> tuple[Tensor, Tensor]:
    """``(B, W, 4)`` first ends of walls and the way to their second ends, m; ``(B, W)`` whether
    there is a wall."""
    real = ~scene.segment.isnan().any(-1)
    ends = torch.where(real[..., None], scene.segment, 0.0)
    return torch.cat([ends[..., :2], ends[..., 2:] - ends[..., :2]], -1), real


_SEEN = {OTHERS: _others, POINTS: _points, WALLS: _walls, SMALLEST: _others}
