"""The right-hand side of a lane's formula in NumPy, many simulations side by side.

Arrays are ``(N, L, B)``: vehicles first, so that those ahead are the next rows, each of which is
whole; then L runs of a model, or L times of one run; then sequences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from nnode.model.arrays import NumpyFunction, numpy_function
from nnode.model.differentiate import derivatives
from nnode.model.expression import Expr
from nnode.model.formula import inputs_of, own_values, values_of
from nnode.model.lane_dynamics import LaneDynamics
from nnode.model.scene import Scene
from nnode.model.steps import stepped
from nnode.model.system import System, Traffic
from nnode.model.tensors import SAFE, LaneRates
from nnode.model.term import Term

#: A formula's values by the names of its symbols.
Values = dict[str, Any]


def formula_of(system: System) -> LaneDynamics | None:
    """A model's formula, speeds never below 0 in it; None where a term is code."""
    if type(system) is not Traffic:
        return None
    lane = system.lane
    return stepped(lane, "euler") if lane is not None and lane.is_formula else None


class Leaders:
    """Measured places (m) and speeds (m/s) of the leaders, linear between samples."""

    def __init__(self, scene: Scene) -> None:
        last = (scene.agent.sum(1) - 1)[None, :, None]
        self.dt = scene.dt
        self.samples = [
            values[..., 0].gather(2, last.expand(len(values), -1, 1))[..., 0].numpy()
            for values in (scene.measured, scene.measured_rate)
        ]

    def at(self, t: float) -> list[np.ndarray]:
        """``(B,)`` both at one time."""
        position = t / self.dt
        # as in the scene: a hair of tolerance keeps whole sample numbers whole
        k = max(0, min(math.floor(position + 1e-4), len(self.samples[0]) - 2))
        share = min(max(position - k, 0.0), 1.0)
        return [one[k] + share * (one[k + 1] - one[k]) for one in self.samples]


@dataclass(frozen=True)
class _Code:
    """A lane's formula as functions.

    Attributes:
        ready: parts that are computed for all vehicles at once; of those that depend on the speed
            ahead, what they need.
        rates: of the states, from these parts.
        lead: speed of a leader that drives by itself.
        chain: whether a rate depends on the speed of the vehicle ahead.
    """

    ready: NumpyFunction
    rates: NumpyFunction
    lead: NumpyFunction
    chain: bool


@cache
def _code(lane: LaneDynamics) -> _Code:
    parts = LaneRates(lane)
    ready = tuple(parts.ready)
    rates = numpy_function(tuple(parts.outputs), ready)
    return _Code(numpy_function(ready), rates, numpy_function((lane.leader,)), parts.chain)


class Motion:
    """A lane's formula with the values of its parameters.

    Args:
        system: the model.
        scene: the surroundings of its B sequences.
        parameters: by name, each with what stands before its own axes: nothing, or R runs. None
            takes the system's own.

    Attributes:
        values: of the parameters' symbols, numbers or ``(R, 1)``.
        top: number of the state whose rate the law says.
        follows: ``(N - 1, 1, B)`` True for those behind another vehicle.
        leads: ``(N, 1, B)`` True for those in front.
    """

    def __init__(
        self, system: System, scene: Scene, parameters: Mapping[str, Tensor] | None = None
    ) -> None:
        lane, terms = formula_of(system), cast(list[Term], list(system.terms))
        assert lane is not None
        assert isinstance(system, Traffic)
        self.system, self.lane, self.scene, self.code = system, lane, scene, _code(lane)
        own = {name: value.detach() for name, value in own_values(terms, lane).items()}
        known = values_of(lane, {**own, **(parameters or {})})
        self.values: Values = {
            name: value.numpy()[..., None] if value.ndim else np.float64(value.item())
            for name, value in zip(lane.owned, known, strict=True)
        }
        self.measured, self.top = system.leader == "measured", lane.order - 1
        follower = scene.follower
        second = follower & torch.cat([follower[:, 1:], torch.zeros_like(follower[:, :1])], 1)
        self.follows, self.second = (_rows(mask)[:-1] for mask in (follower, second))
        self.leads = _rows(scene.leader)
        self.all_follow = bool(self.follows.all())
        inputs = inputs_of(terms, lane, scene)
        self.fixed: Values = {name: _rows(value)[:-1] for name, value in inputs.items()}
        self.fixed["start"] = scene.start.numpy()
        self.fixed["second"] = self.second.astype(float)
        self.fixed["dt"] = np.float64(scene.step)

    def placed(self, y: np.ndarray, place: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """States ``(M, N, L, B)`` with measured leaders where they were, and as fast as they were,
        each ``(B,)`` or ``(L, B)``."""
        if self.measured:
            y = y.copy()
            for own, one in zip(y[: self.lane.order], (place, speed), strict=False):
                np.copyto(own, one, where=self.leads)
        return y

    def given(self, t: Any, y: np.ndarray, speed: np.ndarray) -> Values:
        """What the formulas of followers name, but for the speed ahead.

        Args:
            t: s, a number or ``(L, 1)``.
            y: ``(M, N, L, B)`` states, see :meth:`placed`.
            speed: measured one of leaders, m/s, ``(B,)`` or ``(L, B)``.
        """
        lane = self.lane
        states = dict(zip(lane.rates, y, strict=True))
        found = {**self.values, **self.fixed, "t": t, "measured": speed}
        for name, value in states.items():
            found[name] = value[:-1]
        for name, ahead in lane.ahead:
            if ahead == 1:
                found[f"{name}_1"] = states[name][1:]
                continue
            shifted = np.concatenate([states[name][2:], states[name][-1:]])
            near = found[f"{name}_1"] + (SAFE if name == "x" else 0.0)
            found[f"{name}_2"] = np.where(self.second, shifted, near)
        return found

    def rates(self, y: np.ndarray, given: Values) -> np.ndarray:
        """``(M, N, L, B)`` rates of the states; those of measured leaders are their speeds."""
        lead = given["measured"] if self.measured else self.code.lead(given, ())[0]
        found = np.zeros_like(y)
        np.copyto(found[0], lead, where=self.leads)
        known = tuple(self.code.ready(given, ()))
        if not self.code.chain:
            self._put(found[:, :-1], self.code.rates(given, known), self.follows)
            return found
        rows = found.shape[1] - 1
        wide = [isinstance(part, np.ndarray) and part.ndim == 3 for part in known]
        for i in range(rows - 1, -1, -1):
            here = tuple(p[i] if w else p for p, w in zip(known, wide, strict=True))
            out = self.code.rates({"dx_1": found[0, i + 1]}, here)
            self._put(found[:, i], out, self.follows[i])
        return found

    def _put(self, target: np.ndarray, rates: list[Any], follows: np.ndarray) -> None:
        for one, rate in zip(target, rates, strict=True):
            if self.all_follow:
                one[...] = rate
            else:
                np.copyto(one, rate, where=follows)


def _rows(values: Tensor) -> np.ndarray:
    """``(N, 1, B)`` of ``(B, N)``."""
    found: np.ndarray = np.ascontiguousarray(values.numpy().T)[:, None]
    return found


@dataclass(frozen=True)
class Slopes:
    """Derivatives of followers' rates, each ``(N - 1, K, B)``; those that are zero are left out.

    Attributes:
        own, first, second: of a state's rate by a vehicle's own states, by those of the vehicle
            ahead, and by those of the next one, by numbers of both states.
        chain: by the speed of the vehicle ahead.
        parameters: by parameters' symbols.
        lead: of the leaders' speed by parameters' symbols, ``(K, B)`` or a number.
    """

    own: dict[tuple[int, int], np.ndarray]
    first: dict[tuple[int, int], np.ndarray]
    second: dict[tuple[int, int], np.ndarray]
    chain: dict[int, np.ndarray]
    parameters: dict[tuple[int, str], np.ndarray]
    lead: dict[str, Any]


@cache
def _slopes_of(
    lane: LaneDynamics,
) -> tuple[list[tuple[int, str]], NumpyFunction, list[str], NumpyFunction]:
    """Which derivatives there are, and functions of all of them: of rates, and of leaders."""
    states = list(lane.rates)
    names = [f"{s}{ahead}" for ahead in ("", "_1", "_2") for s in states] + ["dx_1", *lane.owned]
    which: list[tuple[int, str]] = []
    nodes: list[Expr] = []
    for p, rate in enumerate(lane.rates.values()):
        for name, node in derivatives(rate, names).items():
            which.append((p, name))
            nodes.append(node)
    lead = derivatives(lane.leader, list(lane.owned))
    return which, numpy_function(tuple(nodes)), list(lead), numpy_function(tuple(lead.values()))


def slopes(motion: Motion, given: Values, rates: np.ndarray) -> Slopes:
    """All derivatives along one run.

    Args:
        given: see :meth:`Motion.given`, at K times.
        rates: ``(M, N, K, B)`` see :meth:`Motion.rates`.
    """
    lane = motion.lane
    which, function, lead, of_lead = _slopes_of(lane)
    every = function({**given, "dx_1": rates[0, 1:]}, ())
    found = Slopes({}, {}, {}, {}, {}, {})
    states = list(lane.rates)
    for (p, name), value in zip(which, every, strict=True):
        wide = np.where(motion.follows, value, np.zeros_like(rates[0, 1:]))
        if name == "dx_1":
            found.chain[p] = wide
        elif name in lane.owned:
            found.parameters[p, name] = wide
        else:
            ahead = name[-2:] if name[:-2] in states and name[-2:] in ("_1", "_2") else ""
            place = states.index(name.removesuffix(ahead))
            part = {"": found.own, "_1": found.first, "_2": found.second}[ahead]
            part[p, place] = wide
    for key, value in list(found.second.items()):
        # who has no second vehicle ahead sees one behind the first
        found.second[key] = np.where(motion.second, value, 0.0)
        nearer = value - found.second[key]
        found.first[key] = found.first[key] + nearer if key in found.first else nearer
    if not motion.measured:
        found.lead.update(zip(lead, of_lead(given, ()), strict=True))
    return found
