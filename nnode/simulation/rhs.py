"""The right-hand side of models of a lane in NumPy, many simulations side by side.

Arrays are ``(M, N, L, B)``: the M states of a vehicle; vehicles, so that those ahead are the next
rows, each of which is whole; then L runs of a model, or L times of one run; then sequences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.func import vmap

from nnode.data.sequence import Batch
from nnode.model.formula import lane_of, symbols_of
from nnode.model.lane_rates import LaneRates, Values
from nnode.model.scene import Scene
from nnode.model.steps import stepped
from nnode.model.system import System, Traffic, initial_with, with_parameters
from nnode.model.term import State, Term
from nnode.model.terms import LaneDynamics, own_values, values_of


def formula_of(system: System, terms: int | None = None) -> LaneDynamics | None:
    """The formula of a model's first terms, speeds never below 0 in it; None where one is code."""
    if type(system) is not Traffic:
        return None
    lane = lane_of(cast(list[Term], list(system.terms)[:terms]))
    return stepped(lane, "euler") if lane is not None and lane.is_formula else None


class RightHandSide:
    """A model of a lane with values of its parameters.

    Its formula is computed by NumPy. A last term that is code for many simulations at once
    (``Term.side_by_side``) is added to the formula by PyTorch; a model with other code is computed
    by PyTorch as a whole.

    Args:
        system: the model.
        scene: the surroundings of its B sequences.
        parameters: by name, each of R runs; None: of one run, at all its K sampling times.

    Attributes:
        lane: the formula; None: there is none.
        rates: the formula's rates.
        added: the term that is added to them, with one parameter a simulation.
        coded: states whose rates depend on code.
        measured: whether leaders drive as they were measured.
        own: what stands before the names of the parameters that :meth:`by_code` depends on.
    """

    def __init__(
        self, system: System, scene: Scene, parameters: Mapping[str, Tensor] | None = None
    ) -> None:
        self.system, self.scene, self.parameters = system, scene, parameters
        self.lane, self.own, self.coded = formula_of(system), "", slice(None)
        self.added: Term | None = None
        terms = cast(list[Term], list(system.terms))
        if self.lane is None and terms and terms[-1].side_by_side:
            self.lane = formula_of(system, -1)
            if self.lane is not None:
                self.own, self.coded = f"terms.{len(terms) - 1}.", slice(self.top, self.top + 1)
                several = {  # one for each simulation
                    name.removeprefix(self.own): value.repeat_interleave(len(scene.agent))
                    for name, value in (parameters or {}).items()
                    if name.startswith(self.own)
                }
                wide = {name: value[:, None, None] for name, value in several.items()}
                self.added = with_parameters(terms[-1], wide)
        self._every: dict[int, Scene] = {}
        self.measured = system.leader_measured
        self.leads = _rows(scene.leader.T)
        last = (scene.agent.sum(1) - 1)[None, :, None]
        self._path = [
            samples[..., 0].gather(2, last.expand(len(samples), -1, 1))[..., 0].numpy()
            for samples in (scene.measured, scene.measured_rate)
        ]
        if self.lane is None:
            return
        every = {name: value.detach() for name, value in own_values(terms, self.lane).items()}
        known = values_of(self.lane, {**every, **(parameters or {})})
        given = dict(zip(self.lane.owned, known, strict=True))
        values, inputs = symbols_of(terms, self.lane, scene, given)
        # runs stand before sequences
        arrays = {
            name: _array(value[..., None] if name in given and value.ndim else value)
            for name, value in values.items()
        }
        rows = {name: _rows(value) for name, value in inputs.items()}
        self.rates = LaneRates(self.lane, arrays, rows, _rows(scene.follower.T), self.leads)

    @property
    def top(self) -> int:
        """Number of the state whose rate the law says."""
        return self.system.order - 1

    def start(self, batch: Batch) -> np.ndarray:
        """States of R runs at the start; what terms remember depends on the parameters."""
        assert self.parameters is not None
        runs = len(next(iter(self.parameters.values()))) if self.parameters else 1
        every = [self.system.initial(batch)] * runs
        if self.system.memory:
            rows = [{name: p[r] for name, p in self.parameters.items()} for r in range(runs)]
            every = [initial_with(self.system, own, batch) for own in rows]
        return arranged(torch.stack(every).detach())

    def __call__(self, t: Any, y: np.ndarray) -> np.ndarray:
        """Rates of the states; those of measured leaders are 0.

        Args:
            t: s, a number or ``(L, 1)``.
        """
        if self.lane is None:
            with torch.no_grad():
                return self.by_code(t, torch.from_numpy(y)).numpy()
        y, symbols = self.symbols(t, y)
        found = self.by_formula(y, symbols)
        if self.added is not None:
            with torch.no_grad():
                added = self.by_code(t, torch.from_numpy(y), torch.from_numpy(found[0]))
            found[self.coded] += added.numpy()
        if self.measured:
            # a leader's state is never read: its place is known at every time
            np.copyto(found, 0.0, where=self.leads)
        return found

    def placed(self, t: Any, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States with measured leaders where they were, and the speeds of leaders, m/s."""
        place, speed = self.leader_at(t)
        if self.measured:
            y = y.copy()
            for own, one in zip(y[: self.system.order], (place, speed), strict=False):
                np.copyto(own, one, where=self.leads)
        return y, speed

    def symbols(self, t: Any, y: np.ndarray) -> tuple[np.ndarray, Values]:
        """States as in :meth:`placed`, and what the formula names then."""
        y, speed = self.placed(t, y)
        return y, self.rates.symbols(t, y, speed)

    def by_formula(self, y: np.ndarray, symbols: Values) -> np.ndarray:
        """Rates by the formula; those of measured leaders are their speeds."""
        found: np.ndarray = self.rates(y, symbols, symbols["measured"] if self.measured else None)
        return found

    def leader_at(self, t: Any) -> list[np.ndarray]:
        """``(B,)`` or ``(L, B)`` measured places (m) and speeds (m/s) of leaders, linear between
        samples."""
        if np.ndim(t):  # at the samples
            return [one[: len(t)] for one in self._path]
        position = t / self.scene.dt
        # as in the scene: a hair of tolerance keeps whole sample numbers whole
        k = max(0, min(math.floor(position + 1e-4), len(self._path[0]) - 2))
        share = min(max(position - k, 0.0), 1.0)
        return [one[k] + share * (one[k + 1] - one[k]) for one in self._path]

    def by_code(
        self,
        t: Any,
        y: Tensor,
        speed: Tensor | None = None,
        parameters: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """``(..., N, L, B)`` rates of the states ``coded``: by the whole model, or what the added
        term changes of those by the formula.

        Args:
            speed: ``(N, L, B)`` rates of places by the formula, m/s.
            parameters: of one run, by name; None: those that were given.
        """
        if self.added is not None:
            assert speed is not None
            state = self._state(t, y, speed)
            if parameters is None:
                change = self.added(state)
            else:
                own = {name.removeprefix(self.own): p for name, p in parameters.items()}
                change = with_parameters(self.added, own)(state)
            return change[..., 0].T.reshape(1, *y.shape[1:])
        runs = parameters is None and self.parameters is not None
        given = dict((self.parameters or {}) if parameters is None else parameters)

        def one(own: dict[str, Tensor], t: Tensor, y: Tensor) -> Tensor:
            found: Tensor = with_parameters(self.system, own)(t, y, self.scene)
            return found

        time = torch.as_tensor(t, dtype=torch.float64).flatten()
        dims = 0 if runs else None, 0 if len(time) > 1 else None, 0
        found = vmap(one, dims)(given, time if len(time) > 1 else time[0], y.permute(2, 3, 1, 0))
        return found.permute(3, 2, 0, 1)

    def state(self, t: Any, y: np.ndarray) -> State:
        """What terms see of all simulations at once, ``(L B, N, 1)``; simulation b of run or time
        l is l B + b."""
        y, lead = self.placed(t, y)
        speed = self(t, y)[0]
        if self.measured:
            np.copyto(speed, lead, where=self.leads)
        return self._state(t, torch.from_numpy(y), torch.from_numpy(speed))

    def _state(self, t: Any, y: Tensor, speed: Tensor) -> State:
        time, key = torch.as_tensor(t, dtype=torch.float64), y.shape[2]
        if key not in self._every:
            self._every[key] = side_by_side(self.scene, key, at_samples=time.ndim > 0)
        if time.ndim:
            time = time.expand(-1, y.shape[-1]).flatten()
        x, rate = (one.flatten(1).T[..., None] for one in (y[0], speed))
        return State(time, x, rate if self.top else None, self._every[key], rate=rate)


def rates_along(system: System, scene: Scene, states: Tensor) -> Tensor:
    """``(K, B, N, W)`` rates of a model of the states ``(K, B, N, W)`` of a run at its samples."""
    with np.errstate(all="ignore"):
        found = RightHandSide(system, scene)(samples(scene, len(states)), arranged(states))
    return torch.from_numpy(found).permute(2, 3, 1, 0)


def samples(scene: Scene, number: int) -> np.ndarray:
    """``(K, 1)`` sampling times, s."""
    return scene.dt * np.arange(number)[:, None]


def arranged(states: Tensor) -> np.ndarray:
    """``(M, N, L, B)`` of ``(L, B, N, M)``."""
    return np.ascontiguousarray(states.permute(3, 2, 0, 1).numpy())


def _array(value: Tensor) -> Any:
    return value.numpy() if value.ndim else np.float64(value.item())


def _rows(values: Tensor) -> np.ndarray:
    """``(N, 1, B)`` of ``(N, B)``."""
    return np.ascontiguousarray(values.numpy())[:, None]


class _AtSamples(Scene):
    """The surroundings at all sampling times, each a simulation whose state has its time."""

    def _between(self, samples: Tensor, t: Tensor) -> Tensor:
        return samples[0]


def side_by_side(scene: Scene, number: int, at_samples: bool = False) -> Scene:
    """The surroundings of B sequences so many times, at one time or at the first samples."""
    found = {}
    for one in fields(Scene):
        value = getattr(scene, one.name)
        if one.name in ("measured", "measured_rate"):
            several = torch.cat([value] * number, 1)
            value = value[:number].flatten(0, 1)[None] if at_samples else several
        elif isinstance(value, Tensor):
            value = torch.cat([value] * number)
        elif one.name == "near":
            value = value and tuple(torch.cat([part] * number) for part in value)
        elif isinstance(value, tuple):
            value = value * number
        found[one.name] = value
    return (_AtSamples if at_samples else Scene)(**found)
