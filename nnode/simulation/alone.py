"""The right-hand side of people who are each simulated among the measured paths of the others.

A law that is a formula is compiled. NumPy computes effects with a rule, and PyTorch computes terms
that are code, so that the many models of a search need no further compilation.

Arrays are ``(L, W, N, ...)``: L runs of a model, or L times of one run; W windows; N people.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile

import numpy as np
import torch
from torch import Tensor

from nnode.model.crowd_formula import CrowdRates, people_of, settings_of, walls_of
from nnode.model.formula import added_to, crowd_of
from nnode.model.laws import InteractionForce, Law
from nnode.model.scene import Scene
from nnode.model.system import System, with_parameters
from nnode.model.term import State, Term
from nnode.model.terms import CrowdDynamics, parameter_values
from nnode.simulation.kernels.alone import FIELDS, WalkSource
from nnode.simulation.kernels.runs import compiled
from nnode.simulation.linear import RungeKuttaSolver
from nnode.simulation.numpy import simulated
from nnode.simulation.rhs import side_by_side

#: Differences of positions (m) and velocities (m/s) for derivatives.
DIFFERENCE = 1e-4
#: Pairs of people in an array that fits the cache; people in one batch of linear responses.
CACHED, PEOPLE = 8192, 512


@dataclass
class Surroundings:
    """The surroundings of the people in W windows.

    Attributes:
        scene: scene of the windows.
        x, v: ``(H, W, N, 2)`` measured positions (m) and velocities (m/s) at half steps; the last
            ones hold for all times after.
        window, person: ``(P,)`` window and index of the P real people.
        step: time step of the simulation, s.
        factors: name of a parameter of the law to ``(P,)`` factors of the people on its value.
    """

    scene: Scene
    x: Tensor
    v: Tensor
    window: Tensor
    person: Tensor
    step: float
    factors: dict[str, np.ndarray] = field(default_factory=dict)
    _scenes: dict[int, Scene] = field(default_factory=dict)

    def repeated(self, number: int) -> Scene:
        """The scene repeated ``number`` times; window w of run or time l has the index l W + w."""
        if number not in self._scenes:
            self._scenes[number] = side_by_side(self.scene, number)
        return self._scenes[number]

    def index(self, moment: np.ndarray) -> np.ndarray:
        """The places of half steps in :attr:`x`."""
        return np.minimum(moment, len(self.x) - 1)

    def replace_others(self, states: Tensor) -> None:
        """Replace the measured states of one time, the only one, by ``(W, N, 4)``."""
        self.x, self.v = states[None].split(2, -1)
        self.others[0] = states.permute(2, 0, 1).numpy()
        self.tables[0][0] = states.permute(0, 2, 1).numpy()

    @cached_property
    def place(self) -> Tensor:
        """``(P,)`` index of the real people among the W N people of all windows."""
        return self.window * self.x.shape[2] + self.person

    @cached_property
    def others(self) -> np.ndarray:
        """``(H, 4, W, N)`` measured positions and velocities."""
        return torch.cat([self.x, self.v], -1).permute(0, 3, 1, 2).contiguous().numpy()

    @cached_property
    def tables(self) -> tuple[np.ndarray, ...]:
        """Arguments of the compiled law, see :mod:`nnode.simulation.kernels.alone`."""
        scene, which, persons = self.scene, self.window.numpy(), self.person.numpy()
        others = self.others.transpose(0, 2, 1, 3)
        meets = scene.agent.numpy()[which].astype(float)
        meets[np.arange(len(persons)), persons] = 0.0
        place, normal, real = (part.numpy() for part in scene.walls_of_each())
        shape = (*scene.agent.shape, place.shape[2])
        points = np.broadcast_to(np.concatenate([place, normal], -1), (*shape, 4))[which, persons]
        edges, solid = (part.numpy()[which] for part in walls_of(scene))
        is_near = np.broadcast_to(real, shape)[which, persons]
        people = people_of([], CrowdDynamics(), scene)
        properties = [
            people[name].expand(scene.agent.shape).numpy()[which, persons] for name in FIELDS
        ]
        obstacles = (*_real_first(points, is_near), *_real_first(edges, solid))
        return np.ascontiguousarray(others), which, meets, *obstacles, np.stack(properties, 1)


def _real_first(places: np.ndarray, real: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(P, 4, M)``: the M places ``(P, M, 4)``, real ones first; ``(P,)``: number of real ones."""
    order = np.argsort(~real, axis=1, kind="stable")
    sorted_places = np.take_along_axis(places, order[..., None], 1).transpose(0, 2, 1)
    return np.ascontiguousarray(sorted_places), real.sum(1)


class PersonAlone:
    """A model of people among measured paths, with values of its parameters.

    Args:
        around: the surroundings.
        system: the model.
        parameters: name to ``(R, ...)`` values of R runs; R is 1 for many times of one run.

    Attributes:
        compiled: whether the law is compiled.
        of_law: names of the compiled law's parameters.
    """

    def __init__(self, around: Surroundings, system: System, parameters: dict[str, Tensor]) -> None:
        self.around = around
        self.number = len(next(iter(parameters.values()))) if parameters else 1
        terms = system.term_list
        laws = list(takewhile(lambda term: isinstance(term, Law), terms))
        force, law = system.find(InteractionForce), crowd_of(laws)
        self.compiled = law is not None and not (force is not None and force.self_interaction)
        self.of_law: frozenset[str] = frozenset()
        effects: list[Term] = []
        if law is not None and self.compiled:
            self._kernel = compiled(WalkSource(law))
            self.of_law = frozenset(name for name, _, _ in law.owned.values())
            values = parameter_values(laws, law, parameters) | settings_of(laws, law)
            names = {symbol: name for symbol, (name, _, _) in law.owned.items()}
            alike = np.ones(len(around.window))
            # a row for every person of every run, one run after the other
            columns = [
                np.outer(
                    torch.as_tensor(value, dtype=torch.float64).detach().expand(self.number),
                    around.factors.get(names.get(symbol, ""), alike),
                ).ravel()
                for symbol, value in values.items()
            ]
            self._law = np.stack(columns or [np.zeros(self.number * len(alike))], 1)
            effects = list(takewhile(_is_formula, terms[len(laws) :]))
        self._runs = [
            {name: value[r] for name, value in parameters.items()} for r in range(self.number)
        ]
        self._effects = [
            CrowdRates([*laws, *effects], added_to(laws, effects), around.scene, run, numpy=True)
            for run in (self._runs if effects else ())
        ]
        first = len(laws) + len(effects) if self.compiled else 0
        self._code = range(first, len(terms))
        self._system, self._parameters = system, parameters

    @cached_property
    def _systems(self) -> list[System]:
        """One model with the parameters of all runs, or one model per run."""
        parameters = self._parameters
        code = [self._system.term_list[i] for i in self._code]
        scalar = all(value.ndim == 1 for value in parameters.values())
        if self.number > 1 and scalar and all(term.side_by_side for term in code):
            windows = len(self.around.scene.agent)
            wide = {
                name: value.repeat_interleave(windows)[:, None, None]
                for name, value in parameters.items()
            }
            return [with_parameters(self._system, wide)]
        return [with_parameters(self._system, run) for run in self._runs]

    @torch.no_grad()
    def __call__(self, moment: np.ndarray, states: Tensor, by_law: Tensor | None = None) -> Tensor:
        """``(L, W, N, 2)`` accelerations, m/s².

        Args:
            moment: ``(L,)`` half steps since the start.
            states: ``(L, W, N, 4)`` positions (m) and velocities (m/s).
            by_law: result of :meth:`by_law`; None computes it.
        """
        rate = self.by_law(moment, states) if by_law is None else by_law.clone()
        if self._effects:
            self._add_effects(moment, states, rate)
        if not self._code:
            return rate
        size = len(states) // len(self._systems)
        rates = []
        for k, system in enumerate(self._systems):
            part = slice(k * size, (k + 1) * size)
            state = self._state(system, moment[part], states[part], rate[part])
            for place in self._code:
                assert state.rate is not None
                state = replace(state, rate=state.rate + system.terms[place](state))
            assert state.rate is not None
            rates.append(state.rate.view(rate[part].shape))
        return torch.cat(rates)

    def _add_effects(self, moment: np.ndarray, states: Tensor, rate: Tensor) -> None:
        """Add the accelerations by effects, in parts that fit the cache."""
        around, out, index = self.around, rate.numpy(), self.around.index(moment)
        components = states.permute(0, 3, 1, 2).contiguous().numpy()
        windows, people = components.shape[2:]
        size = max(1, CACHED // people**2)
        for k, at in enumerate(moment):
            effects = self._effects[k if self.number > 1 else 0]
            for first in range(0, windows, size):
                part = slice(first, first + size)
                current, others = components[k][:, part], around.others[index[k]][:, part]
                for axis, component in enumerate(
                    effects(at * around.step / 2, current, others, part)
                ):
                    out[k, part, :, axis] += component

    def simulated(self, start: Tensor, steps: int) -> Tensor:
        """``(F, R, W, N, 4)`` positions (m) and velocities (m/s) at the steps, from ``start``
        ``(W, N, 4)``."""
        h = self.around.step

        def rate(t: float, y: np.ndarray) -> np.ndarray:
            acceleration = self(np.full(len(y), round(2 * t / h)), torch.from_numpy(y))
            return np.concatenate([y[..., 2:], acceleration.numpy()], -1)

        y = start.repeat(self.number, 1, 1, 1).numpy()
        return torch.from_numpy(simulated(rate, y, h, steps + 1, h))

    def by_law(self, moment: np.ndarray, states: Tensor) -> Tensor:
        """``(L, W, N, 2)`` accelerations, m/s², by the compiled law; 0 if it is not compiled."""
        rate = torch.zeros_like(states[..., :2], memory_format=torch.contiguous_format)
        if self.compiled:
            place, number = self.around.place, len(states)
            person = np.tile(np.arange(len(place)), number)
            run = np.arange(number) if self.number > 1 else np.zeros(number, dtype=int)
            person_states = states.flatten(1, 2).index_select(1, place)
            accelerations = self._kernel.accelerations(
                person_states.view(-1, 4).numpy(),
                person,
                np.repeat(self.around.index(moment), len(place)),
                np.repeat(run * len(place), len(place)) + person,
                *self.around.tables,
                self._law,
            )
            rate.flatten(1, 2).index_copy_(
                1, place, torch.from_numpy(accelerations).view(number, -1, 2)
            )
        return rate

    def state(self, moment: np.ndarray, states: Tensor) -> State:
        """Arguments of an additional term at many times of one run, ``(L W, N, 2)``."""
        return self._state(self._systems[0], moment, states, self(moment, states))

    def _state(self, system: System, moment: np.ndarray, states: Tensor, rate: Tensor) -> State:
        around, at = self.around, torch.from_numpy(self.around.index(moment))
        clock = torch.from_numpy(moment).to(rate.dtype) * around.step / 2
        t = clock.repeat_interleave(rate.shape[1])
        others = around.x[at].flatten(0, 1), around.v[at].flatten(0, 1)
        (x, v), scene = states.flatten(0, 1).split(2, -1), around.repeated(len(states))
        terms = system.term_list
        return State(t, x, v, scene, terms, rate=rate.flatten(0, 1), measured_others=others)


def _is_formula(term: Term) -> bool:
    """Whether a term is an effect with a rule."""
    return term.rule_for(2) is not None and not isinstance(term, Law)


class RunAlone:
    """One run of a model of people among measured paths, and its linear response.

    Args:
        around: the surroundings.
        system: the model, with the parameters of the run.
        states: ``(F, W, N, 4)`` positions (m) and velocities (m/s) at the F steps.
    """

    def __init__(self, around: Surroundings, system: System, states: Tensor) -> None:
        self.around, self.system, self._states = around, system, states.contiguous()
        self._moment = 2 * np.arange(len(states))
        self._own = {
            name: p.detach()[None] for name, p in system.named_parameters() if p.requires_grad
        }
        self._rhs = PersonAlone(around, system, self._own)

    @cached_property
    def state(self) -> State:
        """Arguments of an additional term along the run, ``(F W, N, 2)``."""
        return self._rhs.state(self._moment, self._states)

    def accelerations(self, around: Surroundings) -> Tensor:
        """``(F, W, N, 2)`` accelerations along the run in other surroundings, m/s²."""
        return PersonAlone(around, self.system, self._own)(self._moment, self._states)

    def parameters(self, steps: Sequence[float]) -> list[Tensor]:
        """K accelerations ``(F, W, N, 2)`` per unit of each parameter.

        Args:
            steps: ``(K,)`` differences of the parameters. Effects may not be smooth, so a fit
                needs difference quotients over visible differences of the strength.
        """
        elements = [(name, i) for name, value in self._own.items() for i in range(value.numel())]
        return [
            self.parameter(name, step, place)
            for (name, place), step in zip(elements, steps, strict=True)
        ]

    def parameter(self, name: str, step: float, place: int = 0) -> Tensor:
        """``(F, W, N, 2)`` accelerations per unit of one element of a parameter, by a difference
        quotient over ``step``."""
        law_rates, value = None if name in self._rhs.of_law else self._by_law, self._own[name]
        half = torch.zeros(value.numel(), dtype=value.dtype)
        half[place] = step / 2
        half = half.reshape(value.shape)
        higher, lower = (
            PersonAlone(self.around, self.system, {**self._own, name: value + change})(
                self._moment, self._states, law_rates
            )
            for change in (half, -half)
        )
        return (higher - lower) / step

    @cached_property
    def _by_law(self) -> Tensor:
        """``(F, W, N, 2)`` accelerations by the compiled law, m/s²."""
        return self._rhs.by_law(self._moment, self._states)

    @cached_property
    def slopes(self) -> np.ndarray:
        """``(F, P, 4, 4)`` derivatives of people's rates (x, v) by their states."""
        matrix = np.zeros((len(self._states), len(self.around.window), 4, 4))
        matrix[..., 0, 2] = matrix[..., 1, 3] = 1.0
        for k in range(4):
            change = torch.zeros(4, dtype=self._states.dtype)
            change[k] = DIFFERENCE
            higher, lower = (
                self._rhs(self._moment, self._states + sign * change) for sign in (1, -1)
            )
            slope = (higher - lower)[:, self.around.window, self.around.person]
            matrix[..., 2:, k] = slope.numpy() / (2 * DIFFERENCE)
        return matrix

    @cached_property
    def _solvers(self) -> list[RungeKuttaSolver]:
        """Of parts of the people, for the cache."""
        parts = np.split(self.slopes, range(PEOPLE, self.slopes.shape[1], PEOPLE), 1)
        return [RungeKuttaSolver(part, self.around.step) for part in parts]

    def by_start(self) -> np.ndarray:
        """``(P, F, 4, 4)`` derivatives of the states by those at the start."""
        start = np.zeros((2, 2, 4, 1))
        start[0, 0, 0] = start[0, 1, 1] = start[1, 0, 2] = start[1, 1, 3] = 1.0
        return self._changes(np.zeros((len(self._states), 2, 2, 4, 1)), start)

    def displacements(self, fields: Sequence[Tensor]) -> np.ndarray:
        """``(P, F, 4, C)`` changes of positions, m, and velocities, m/s, by C additional
        accelerations.

        Args:
            fields: each ``(F W, N, 2)`` or ``(F, W, N, 2)``.
        """
        times, place = len(self._states), self.around.place
        source = np.zeros((times, 2, 2, len(fields), len(place)))
        for c, rate in enumerate(fields):
            people = rate.reshape(times, -1, 2).index_select(1, place)
            source[:, 1, :, c] = people.movedim(1, 2).numpy()
        return self._changes(source)

    def _changes(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """``(P, F, 4, C)`` changes of the states by sources ``(F, 2, 2, C, P or 1)`` and starts
        ``(2, 2, C, 1)``."""
        parts, first = [], 0
        for solver in self._solvers:
            last = first + solver.number
            part = source if source.shape[-1] == 1 else source[..., first:last]
            shape = (*part.shape[:-1], solver.number)
            initial = None if start is None else np.repeat(start, solver.number, -1)
            parts.append(solver.states(np.broadcast_to(part, shape), initial).numpy())
            first = last
        return np.concatenate(parts, 1).swapaxes(0, 1)
