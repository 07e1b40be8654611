"""The formula of a model of a crowd, made from what its terms say of themselves, and its
accelerations by PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nnode.model.crowd_dynamics import (
    NOBODY,
    OTHERS,
    POINTS,
    SMALLEST,
    WALLS,
    CrowdDynamics,
    CrowdRule,
    with_rule,
)  # fmt: skip
from nnode.model.expression import const
from nnode.model.formula import own_values, owners, parameters_of, rule_of, values_of
from nnode.model.scene import Scene
from nnode.model.tensors import Code, computed
from nnode.model.term import State, Term


class CrowdBase(Term):
    """A term that others may look at: what drives a person, or a force between people."""

    def written(self, law: CrowdDynamics, owner: str, place: int) -> CrowdDynamics:
        """A law with this term, as a formula."""
        return ruled(law, self, owner, place)

    def told(self, law: CrowdDynamics, owner: str, place: int) -> CrowdDynamics:
        """A law with what others may name of this term; its acceleration does not matter."""
        return self.written(law, owner, place)

    def code(self) -> dict[str, Code]:
        """What calls in its formula stand for, by name."""
        return {}

    def forward(self, state: State) -> Tensor:
        """By its rule; a term without one defines its own."""
        return contribution(self, state)


def ruled(
    law: CrowdDynamics, term: Term, owner: str, place: int, own: CrowdRule | None = None
) -> CrowdDynamics:
    """A law with a term that has a rule, or ``own`` in its place."""
    rule = own or term.rule
    if not isinstance(rule, CrowdRule):
        raise NotImplementedError(f"{type(term).__name__} defines neither a rule nor forward")
    parameters, owned, units = parameters_of(term, owner, place)
    return with_rule(law, owner, rule, parameters, owned, units, whose=place)


def formula_of(base: CrowdBase) -> CrowdDynamics:
    """The formula of one term."""
    if (base.shape,) not in _KNOWN:
        _KNOWN[base.shape,] = base.written(CrowdDynamics(), base.name, 0).flat()
    return _KNOWN[base.shape,]


#: Terms' shapes to the formula of all of them, and of the first one beside what it looks at.
_KNOWN: dict[tuple[Any, ...], CrowdDynamics] = {}
_ALONE: dict[tuple[Any, ...], CrowdDynamics] = {}


def crowd_of(terms: Sequence[Term]) -> CrowdDynamics | None:
    """The formula of a model with these terms; None where one is code without a formula."""
    if any(rule_of(term) is None or term.memory for term in terms):
        return None
    key = tuple(term.shape for term in terms)
    if key not in _KNOWN:
        law, names = CrowdDynamics(), owners(terms)
        # a law is known to effects wherever it stands
        for i, term in sorted(enumerate(terms), key=lambda it: not isinstance(it[1], CrowdBase)):
            add = term.written if isinstance(term, CrowdBase) else _ruled(term)
            law = add(law, names[i], i)
        _KNOWN[key] = law.flat()
    return _KNOWN[key]


def _ruled(term: Term) -> Callable[[CrowdDynamics, str, int], CrowdDynamics]:
    return lambda law, owner, place: ruled(law, term, owner, place)


def contribution(term: Term, state: State) -> Tensor:
    """``(B, N, 2)`` m/s²: what one term adds to the accelerations, by its rule."""
    around = [] if state.system is None else list(state.system.terms)
    effect = not isinstance(term, CrowdBase)
    bases = [t for t in around if effect and isinstance(t, CrowdBase)]
    terms = [term, *bases]
    key = tuple(t.shape for t in terms)
    if key not in _ALONE:
        law, names = CrowdDynamics(), owners(terms)
        for i, base in enumerate(bases, start=1):
            law = base.told(law, names[i], i)
        law = replace(law, rate=(const(0), const(0)))
        _ALONE[key] = ruled(law, term, names[0], 0).flat()
    code = {name: call for base in bases for name, call in base.code().items()}
    return rates_of(terms, _ALONE[key], state, code)


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
    given = {name: x.new_tensor(value) for name, value in settings_of(terms, law).items()}
    # parameters are numbers, or ``(B, 1, 1)`` where each simulation has its own
    values = values_of(law, own_values(terms, law))
    own = {s: p[..., 0] if p.ndim else p for s, p in zip(law.owned, values, strict=True)}
    own |= dict(zip(("x", "y", "vx", "vy"), (*x.unbind(-1), *v.unbind(-1)), strict=True))
    own["t"] = state.t.to(x.dtype).reshape(-1, 1)
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
        wide = {name: value[:, :, None] if value.ndim else value for name, value in known.items()}
        each = computed(list(found.values()), given | wide | seen, code=code)
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
