"""The right-hand side of a crowd model, evaluated from its formula."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.model.arrays import Code, Formulas
from nnode.model.scene import Scene
from nnode.model.term import State, Term
from nnode.model.terms import (
    NOBODY,
    OTHERS,
    POINTS,
    SMALLEST,
    SMOOTHING,
    WALLS,
    CrowdDynamics,
    parameter_values,
)


def settings_of(terms: Sequence[Any], law: CrowdDynamics) -> dict[str, float]:
    """Symbol to value of the terms' fixed settings."""
    return {name: float(getattr(terms[i], part)) for name, (i, part) in law.settings.items()}


def people_of(terms: Sequence[Any], law: CrowdDynamics, scene: Scene) -> dict[str, Tensor]:
    """Symbol to the values ``(B, N)`` or ``(B, 1)`` of people's properties from the data."""
    values = {name: terms[i].inputs(scene)[part] for name, (i, part) in law.inputs.items()}
    values["people"], values["points"] = scene.count[:, 0], scene.wall_count[:, 0]
    values["start"], values["pace"] = scene.start[:, None], scene.pace
    values["goal_x"], values["goal_y"] = scene.destination.unbind(-1)
    return {name: value.to(scene.destination.dtype) for name, value in values.items()}


class CrowdRates:
    """The right-hand side of a crowd's formula, by PyTorch or NumPy.

    Arrays of people have the shape ``(B, N)``. Arrays of neighbours have the shape ``(M, B, N)``,
    where the M neighbours are people, wall points or walls. An axis has length 1 where all values
    along it are equal.

    Args:
        terms: the model's terms.
        law: the formula of the terms.
        scene: surroundings of the B simulations.
        parameters: name to value; None takes the terms' parameters.
        code: name to the function that calls of this name evaluate.
        numpy: whether to compute by NumPy, which excludes formulas with code.
    """

    def __init__(
        self,
        terms: Sequence[Term],
        law: CrowdDynamics,
        scene: Scene,
        parameters: Mapping[str, Tensor] | None = None,
        code: Mapping[str, Code] | None = None,
        numpy: bool = False,
    ) -> None:
        self.law, self._code, self._numpy = law, code, numpy
        symbol_values = parameter_values(terms, law, parameters)
        like = scene.destination
        symbol_values |= {
            name: like.new_tensor(value) for name, value in settings_of(terms, law).items()
        }
        symbol_values |= people_of(terms, law, scene)
        self._known = self._arrays(symbol_values)
        self._places: dict[str, dict[str, Any]] = {}
        self._real: dict[str, Any] = {}
        for over, sums in law.sums.items():
            if sums:
                places, real = _PLACES[over](scene)
                self._places[over] = self._arrays(places)
                self._real[over] = self._arrays({over: real.to(like.dtype)})[over]

    def __call__(self, t: Any, states: Any, others: Any, part: slice = slice(None)) -> list[Any]:
        """Both components of the rates, ``(B, N)``, m/s² or m/s.

        Args:
            t: s, a number or ``(B, 1)``.
            states: ``(4, B, N)`` positions and velocities.
            others: ``(4, B, N)`` positions and velocities of the others.
            part: the simulations that the states belong to.
        """
        person = dict(zip(("x", "y", "vx", "vy"), states, strict=True)) | {"t": t}
        person |= {
            name: value[part] if value.ndim else value for name, value in self._known.items()
        }
        sums: dict[str, Any] = {}
        for over, summands in self.law.sums.items():
            if not summands:
                continue
            places, relative = {k: v[:, part] for k, v in self._places[over].items()}, {}
            if over in (OTHERS, SMALLEST):
                places = dict(zip(("x", "y", "vx", "vy"), map(_of_each, others), strict=True))
                relative = {f"{name}_j": _of_each(person[name]) for name in self.law.inputs}
            for name, value in places.items():
                relative |= {f"d{name}": person[name] - value} if name in person else {name: value}
            context = person | sums if over == SMALLEST else person
            terms = Formulas(summands.values())(context | relative, code=self._code)
            real = self._real[over][:, part]
            for name, value in zip(summands, terms, strict=True):
                sums[name] = _smallest(value, real) if over == SMALLEST else (value * real).sum(0)
        return Formulas(self.law.rate)(person | sums, code=self._code)

    def _arrays(self, values: Mapping[str, Tensor]) -> dict[str, Any]:
        if not self._numpy:
            return dict(values)
        return {name: np.array(value.detach().numpy(), order="C") for name, value in values.items()}


def rates_of(
    terms: Sequence[Term], law: CrowdDynamics, state: State, code: Mapping[str, Code] | None = None
) -> Tensor:
    """``(B, N, 2)`` rates of a crowd's formula, m/s², or m/s for a law of first order."""
    x, v = state.x, state.v
    if v is None:
        v = torch.zeros_like(x) if law.order == 1 else state.others[1]
    states = torch.cat([x, v], -1)
    others = states if state.measured_others is None else torch.cat(state.measured_others, -1)
    components = CrowdRates(terms, law, state.scene, code=code)(
        state.t.to(x.dtype).reshape(-1, 1), states.movedim(-1, 0), others.movedim(-1, 0)
    )
    return torch.stack([part.expand(x.shape[:2]) for part in components], -1)


def _of_each(values: Any) -> Any:
    """Reshape the values ``(B, M)`` of others to ``(M, B, 1)``."""
    return values.T[..., None]


def _smallest(value: Any, real: Any) -> Any:
    """The minimum over the first axis where ``real``; its gradient is that of the first minimum."""
    if isinstance(value, np.ndarray):
        return np.where(real > 0, value, NOBODY).min(0, initial=NOBODY)
    value = torch.where(real > 0, value, NOBODY)
    value = torch.cat([value, value.new_full((1, *value.shape[1:]), NOBODY)])
    return value.gather(0, value.detach().argmin(0, keepdim=True))[0]


_Places = tuple[dict[str, Tensor], Tensor]


def _others(scene: Scene) -> _Places:
    """No fixed values; and ``(N, B, N)`` True where the first axis' person is another person."""
    apart = ~torch.eye(scene.agent.shape[1], dtype=torch.bool, device=scene.agent.device)
    return {}, (scene.agent[:, None, :] & apart).movedim(2, 0)


def _points(scene: Scene) -> _Places:
    wall, normal, real = (part.movedim(2, 0) for part in scene.walls_of_each())
    axes = zip("xy", wall.unbind(-1), normal.unbind(-1), strict=True)
    return {k: v for c, x, n in axes for k, v in ((c, x), (f"normal_{c}", n))}, real


def _walls(scene: Scene) -> _Places:
    ends, real = walls_of(scene)
    parts = ends.movedim(1, 0)[..., None].unbind(2)
    return dict(zip(("x", "y", "along_x", "along_y"), parts, strict=True)), real.T[..., None]


def walls_of(scene: Scene) -> tuple[Tensor, Tensor]:
    """``(B, W, 4)`` first ends of walls and vectors to their second ends, m; ``(B, W)`` True for
    real walls."""
    real = ~scene.segment.isnan().any(-1)
    ends = torch.where(real[..., None], scene.segment, 0.0)
    return torch.cat([ends[..., :2], ends[..., 2:] - ends[..., :2]], -1), real


_PLACES = {OTHERS: _others, POINTS: _points, WALLS: _walls, SMALLEST: _others}


def norm(vector: Tensor) -> Tensor:
    """``(..., 2)`` to ``(...)``: Euclidean length with a finite gradient everywhere."""
    return torch.sqrt(dot(vector, vector) + SMOOTHING**2)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """``(..., 2)`` twice to ``(...)``: scalar product; faster than a sum over an axis of two."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
