"""The right-hand side of lane models in NumPy, for many simulations at once.

Arrays are ``(M, N, L, B)``: M states, N vehicles, L runs of a model or L times of one run, and B
sequences. The vehicle ahead is the next row, and rows are contiguous.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import vmap

from nnode.data.sequence import Batch
from nnode.model.formula import lane_of, symbols_of
from nnode.model.lane_rates import LaneRates, Values
from nnode.model.scene import Scene
from nnode.model.steps import stepped
from nnode.model.system import System, Traffic, with_parameters
from nnode.model.term import State, Term
from nnode.model.terms import LaneDynamics, parameter_values


def formula_of(system: System, terms: int | None = None) -> LaneDynamics | None:
    """The formula of a model's first terms, with speeds of at least 0; None if one is code."""
    if type(system) is not Traffic:
        return None
    lane = lane_of(system.term_list[:terms])
    return stepped(lane, "euler") if lane is not None and lane.is_formula else None


class RightHandSide:
    """A lane model with values of its parameters.

    NumPy computes the formula. PyTorch adds a last term that is code for many simulations at once
    (``Term.side_by_side``), and computes a model with other code as a whole.

    Args:
        system: the model.
        scene: the surroundings of its B sequences.
        parameters: name to values of R runs; None for one run at all its K sampling times.

    Attributes:
        lane: the formula, or None.
        rates: the formula's rates.
        added: the term that is added to them, with one value of parameters per simulation.
        coded: states whose rates depend on code.
        measured: whether leaders follow their measured paths.
        code_prefix: prefix of the names of the parameters that :meth:`by_code` depends on.
    """

    def __init__(
        self, system: System, scene: Scene, parameters: Mapping[str, Tensor] | None = None
    ) -> None:
        self.system, self.scene, self.parameters = system, scene, parameters
        self.lane, self.code_prefix, self.coded = formula_of(system), "", slice(None)
        self.added: Term | None = None
        terms = system.term_list
        if self.lane is None and terms and terms[-1].side_by_side:
            self.lane = formula_of(system, -1)
            if self.lane is not None:
                self.code_prefix, self.coded = (
                    f"terms.{len(terms) - 1}.",
                    slice(self.top, self.top + 1),
                )
                several = {  # one for each simulation
                    name.removeprefix(self.code_prefix): value.repeat_interleave(len(scene.agent))
                    for name, value in (parameters or {}).items()
                    if name.startswith(self.code_prefix)
                }
                wide = {name: value[:, None, None] for name, value in several.items()}
                self.added = with_parameters(terms[-1], wide)
        self._every: dict[int, Scene] = {}
        self.measured = system.leader_measured
        self.is_leader = _rows(scene.leader.T)
        last = (scene.agent.sum(1) - 1)[None, :, None]
        self._path = [
            samples[..., 0].gather(2, last.expand(len(samples), -1, 1))[..., 0].numpy()
            for samples in (scene.measured, scene.measured_rate)
        ]
        if self.lane is None:
            return
        symbol_values = parameter_values(terms, self.lane, parameters)
        given = {name: value.detach() for name, value in symbol_values.items()}
        values, inputs = symbols_of(terms, self.lane, scene, given)
        # the axis of runs is before that of sequences
        arrays = {
            name: _array(value[..., None] if name in given and value.ndim else value)
            for name, value in values.items()
        }
        rows = {name: _rows(value) for name, value in inputs.items()}
        self.rates = LaneRates(self.lane, arrays, rows, _rows(scene.follower.T), self.is_leader)

    @property
    def top(self) -> int:
        """Index of the state whose rate the law defines."""
        return self.system.order - 1

    def start(self, batch: Batch) -> np.ndarray:
        """States of R runs at the start. States of terms may depend on the parameters."""
        assert self.parameters is not None
        runs = len(next(iter(self.parameters.values()))) if self.parameters else 1
        starts = [self.system.initial(batch)] * runs
        if self.system.memory:
            rows = [{name: p[r] for name, p in self.parameters.items()} for r in range(runs)]
            starts = [with_parameters(self.system, row).initial(batch) for row in rows]
        return arranged(torch.stack(starts).detach())

    def __call__(self, t: Any, y: np.ndarray) -> np.ndarray:
        """Rates of the states. Those of measured leaders are 0.

        Args:
            t: s, a number or ``(L, 1)``.
        """
        if self.lane is None:
            with torch.no_grad():
                return self.by_code(t, torch.from_numpy(y)).numpy()
        y, symbols = self.symbols(t, y)
        rates = self.by_formula(y, symbols)
        if self.added is not None:
            with torch.no_grad():
                added = self.by_code(t, torch.from_numpy(y), torch.from_numpy(rates[0]))
            rates[self.coded] += added.numpy()
        if self.measured:
            # a measured leader's state is unused, because its position is interpolated
            np.copyto(rates, 0.0, where=self.is_leader)
        return rates

    def placed(self, t: Any, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States with leaders at their measured positions, and the speeds of leaders, m/s."""
        place, speed = self.leader_at(t)
        if self.measured:
            y = y.copy()
            for state, measured in zip(y[: self.system.order], (place, speed), strict=False):
                np.copyto(state, measured, where=self.is_leader)
        return y, speed

    def symbols(self, t: Any, y: np.ndarray) -> tuple[np.ndarray, Values]:
        """States as in :meth:`placed`, and the values of the formula's symbols."""
        y, speed = self.placed(t, y)
        return y, self.rates.symbols(t, y, speed)

    def by_formula(self, y: np.ndarray, symbols: Values) -> np.ndarray:
        """Rates by the formula. Those of measured leaders are their speeds."""
        rates: np.ndarray = self.rates(y, symbols, symbols["measured"] if self.measured else None)
        return rates

    def leader_at(self, t: Any) -> list[np.ndarray]:
        """``(B,)`` or ``(L, B)`` measured positions (m) and speeds (m/s) of leaders, interpolated
        linearly."""
        if np.ndim(t):  # at the samples
            return [samples[: len(t)] for samples in self._path]
        position = t / self.scene.dt
        # the tolerance keeps whole sample numbers whole, as in Scene
        k = max(0, min(math.floor(position + 1e-4), len(self._path[0]) - 2))
        share = min(max(position - k, 0.0), 1.0)
        return [samples[k] + share * (samples[k + 1] - samples[k]) for samples in self._path]

    def by_code(
        self,
        t: Any,
        y: Tensor,
        speed: Tensor | None = None,
        parameters: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """``(..., N, L, B)`` rates of the states ``coded`` by the whole model, or their change by
        the added term.

        Args:
            speed: ``(N, L, B)`` rates of positions by the formula, m/s.
            parameters: name to value of one run; None takes the constructor's.
        """
        if self.added is not None:
            assert speed is not None
            state = self._state(t, y, speed)
            if parameters is None:
                change = self.added(state)
            else:
                term_parameters = {
                    name.removeprefix(self.code_prefix): p for name, p in parameters.items()
                }
                change = with_parameters(self.added, term_parameters)(state)
            return change[..., 0].T.reshape(1, *y.shape[1:])
        runs = parameters is None and self.parameters is not None
        given = dict((self.parameters or {}) if parameters is None else parameters)

        def simulation_rates(run_parameters: dict[str, Tensor], t: Tensor, y: Tensor) -> Tensor:
            rates: Tensor = with_parameters(self.system, run_parameters)(t, y, self.scene)
            return rates

        time = torch.as_tensor(t, dtype=torch.float64).flatten()
        dims = 0 if runs else None, 0 if len(time) > 1 else None, 0
        stacked = vmap(simulation_rates, dims)(
            given, time if len(time) > 1 else time[0], y.permute(2, 3, 1, 0)
        )
        return stacked.permute(3, 2, 0, 1)

    def state(self, t: Any, y: np.ndarray) -> State:
        """Arguments of terms for all simulations at once, ``(L B, N, 1)``; sequence b of run or
        time l has the index l B + b."""
        y, lead = self.placed(t, y)
        speed = self(t, y)[0]
        if self.measured:
            np.copyto(speed, lead, where=self.is_leader)
        return self._state(t, torch.from_numpy(y), torch.from_numpy(speed))

    def _state(self, t: Any, y: Tensor, speed: Tensor) -> State:
        time, key = torch.as_tensor(t, dtype=torch.float64), y.shape[2]
        if key not in self._every:
            self._every[key] = side_by_side(self.scene, key, at_samples=time.ndim > 0)
        if time.ndim:
            time = time.expand(-1, y.shape[-1]).flatten()
        x, rate = (values.flatten(1).T[..., None] for values in (y[0], speed))
        return State(time, x, rate if self.top else None, self._every[key], rate=rate)


def rates_along(system: System, scene: Scene, states: Tensor) -> Tensor:
    """``(K, B, N, W)`` rates of a model for the states ``(K, B, N, W)`` of a run at its samples."""
    with np.errstate(all="ignore"):
        rates = RightHandSide(system, scene)(samples(scene, len(states)), arranged(states))
    return torch.from_numpy(rates).permute(2, 3, 1, 0)


def samples(scene: Scene, number: int) -> np.ndarray:
    """``(K, 1)`` sampling times, s."""
    return scene.dt * np.arange(number)[:, None]


def arranged(states: Tensor) -> np.ndarray:
    """Arrange ``(L, B, N, M)`` as ``(M, N, L, B)``."""
    return np.ascontiguousarray(states.permute(3, 2, 0, 1).numpy())


def _array(value: Tensor) -> Any:
    return value.numpy() if value.ndim else np.float64(value.item())


def _rows(values: Tensor) -> np.ndarray:
    """Arrange ``(N, B)`` as ``(N, 1, B)``."""
    return np.ascontiguousarray(values.numpy())[:, None]


class _AtSamples(Scene):
    """The surroundings at all sampling times, each of which is one simulation."""

    def _between(self, samples: Tensor, t: Tensor) -> Tensor:
        return samples[0]


def side_by_side(scene: Scene, number: int, at_samples: bool = False) -> Scene:
    """The surroundings of B sequences repeated ``number`` times, for R runs or for the first
    samples."""
    values = {}
    for entry in fields(Scene):
        value = getattr(scene, entry.name)
        if entry.name in ("measured", "measured_rate"):
            several = torch.cat([value] * number, 1)
            value = value[:number].flatten(0, 1)[None] if at_samples else several
        elif isinstance(value, Tensor):
            value = torch.cat([value] * number)
        elif entry.name == "near":
            value = value and tuple(torch.cat([part] * number) for part in value)
        elif isinstance(value, tuple):
            value = value * number
        values[entry.name] = value
    return (_AtSamples if at_samples else Scene)(**values)
