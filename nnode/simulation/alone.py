"""The right-hand side of people who each walk alone among the measured paths of the others.

The law is compiled where it is a formula. Effects with a rule are computed by NumPy, and terms that
are code by PyTorch, so that nothing is compiled for each of the many models of a search.

Arrays are ``(L, W, N, ...)``: L runs of a model, or L times of one run; W windows; N people.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile
from typing import cast

import numpy as np
import torch
from torch import Tensor

from nnode.model.crowd_formula import CrowdRates, people_of, settings_of, walls_of
from nnode.model.formula import added_to, crowd_of
from nnode.model.laws import InteractionForce, Law
from nnode.model.scene import Scene
from nnode.model.system import System, with_parameters
from nnode.model.term import State, Term
from nnode.model.terms import CrowdDynamics, own_values, values_of
from nnode.simulation.kernels.alone import FIELDS, WalkSource
from nnode.simulation.kernels.runs import compiled
from nnode.simulation.linear import RungeKuttaSolver
from nnode.simulation.numpy import simulated
from nnode.simulation.rhs import side_by_side

#: Differences of positions (m) and velocities (m/s) for derivatives.
DIFFERENCE = 1e-4
#: Pairs of people in an array that fits the cache; people whose response is computed at once.
CACHED, PEOPLE = 8192, 512


@dataclass
class Surroundings:
    """What people of W windows walk among.

    Attributes:
        scene: of the windows.
        x, v: ``(H, W, N, 2)`` measured positions (m) and velocities (m/s) at half steps.
        window, person: ``(P,)`` of the P real people of all windows.
        step: of the simulation, s.
    """

    scene: Scene
    x: Tensor
    v: Tensor
    window: Tensor
    person: Tensor
    step: float
    _scenes: dict[int, Scene] = field(default_factory=dict)

    def repeated(self, number: int) -> Scene:
        """The scene so many times; simulation w of run or time l is l W + w."""
        if number not in self._scenes:
            self._scenes[number] = side_by_side(self.scene, number)
        return self._scenes[number]

    @cached_property
    def place(self) -> Tensor:
        """``(P,)`` of the real people among those of all windows."""
        return self.window * self.x.shape[2] + self.person

    @cached_property
    def others(self) -> np.ndarray:
        """``(H, 4, W, N)`` measured positions and velocities."""
        return torch.cat([self.x, self.v], -1).permute(0, 3, 1, 2).contiguous().numpy()

    @cached_property
    def tables(self) -> tuple[np.ndarray, ...]:
        """Arguments of the compiled law, see :mod:`nnode.simulation.kernels.alone`."""
        scene, which, who = self.scene, self.window.numpy(), self.person.numpy()
        others = self.others.transpose(0, 2, 1, 3)
        meets = scene.agent.numpy()[which].astype(float)
        meets[np.arange(len(who)), who] = 0.0
        place, normal, real = (part.numpy() for part in scene.walls_of_each())
        shape = (*scene.agent.shape, place.shape[2])
        points = np.broadcast_to(np.concatenate([place, normal], -1), (*shape, 4))[which, who]
        edges, solid = (part.numpy()[which] for part in walls_of(scene))
        felt = np.broadcast_to(real, shape)[which, who]
        known = people_of([], CrowdDynamics(), scene)
        known |= dict(zip(("goal_x", "goal_y"), scene.destination.unbind(-1), strict=True))
        have = [known[name].expand(scene.agent.shape).numpy()[which, who] for name in FIELDS]
        around = (*_real_first(points, felt), *_real_first(edges, solid))
        return np.ascontiguousarray(others), which, meets, *around, np.stack(have, 1)


def _real_first(places: np.ndarray, real: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(P, 4, M)`` the M places ``(P, M, 4)``, the real ones first, and the number of these."""
    order = np.argsort(~real, axis=1, kind="stable")
    sorted_places = np.take_along_axis(places, order[..., None], 1).transpose(0, 2, 1)
    return np.ascontiguousarray(sorted_places), real.sum(1)


class PersonAlone:
    """A model of people who walk alone, with values of its parameters.

    Args:
        around: the surroundings.
        system: the model.
        parameters: name to ``(R, ...)`` values of R runs; R is 1 where many times of one run are
            computed.

    Attributes:
        compiled: whether the law is.
        of_law: names of the parameters that the compiled law has.
    """

    def __init__(self, around: Surroundings, system: System, parameters: dict[str, Tensor]) -> None:
        self.around = around
        self.number = len(next(iter(parameters.values()))) if parameters else 1
        terms = cast(list[Term], list(system.terms))
        laws = list(takewhile(lambda term: isinstance(term, Law), terms))
        force, law = system.find(InteractionForce), crowd_of(laws)
        self.compiled = law is not None and not (force is not None and force.self_interaction)
        self.of_law: frozenset[str] = frozenset()
        effects: list[Term] = []
        if law is not None and self.compiled:
            self._kernel = compiled(WalkSource(law))
            own = {name: value.detach() for name, value in own_values(laws, law).items()}
            self.of_law = frozenset(own)
            rows = [*values_of(law, own | parameters), *settings_of(laws, law).values()]
            every = [torch.as_tensor(row, dtype=torch.float64).expand(self.number) for row in rows]
            self._law = torch.stack(every, 1).numpy() if every else np.zeros((self.number, 1))
            effects = list(takewhile(_is_formula, terms[len(laws) :]))
        self._runs = [
            {name: value[r] for name, value in parameters.items()} for r in range(self.number)
        ]
        self._effects = [
            CrowdRates([*laws, *effects], added_to(laws, effects), around.scene, own, numpy=True)
            for own in (self._runs if effects else ())
        ]
        first = len(laws) + len(effects) if self.compiled else 0
        self._code = range(first, len(terms))
        self._system, self._parameters = system, parameters

    @cached_property
    def _systems(self) -> list[System]:
        """The model with the parameters of all runs, or those of each."""
        own = self._parameters
        code = cast(list[Term], [self._system.terms[i] for i in self._code])
        scalar = all(value.ndim == 1 for value in own.values())
        if self.number > 1 and scalar and all(term.side_by_side for term in code):
            windows = len(self.around.scene.agent)
            wide = {
                name: value.repeat_interleave(windows)[:, None, None] for name, value in own.items()
            }
            return [with_parameters(self._system, wide)]
        return [with_parameters(self._system, run) for run in self._runs]

    @torch.no_grad()
    def __call__(self, moment: np.ndarray, states: Tensor, by_law: Tensor | None = None) -> Tensor:
        """``(L, W, N, 2)`` accelerations, m/s².

        Args:
            moment: ``(L,)`` half steps since the start.
            states: ``(L, W, N, 4)`` positions (m) and velocities (m/s).
            by_law: of :meth:`by_law`, where it is known.
        """
        rate = self.by_law(moment, states) if by_law is None else by_law.clone()
        if self._effects:
            self._add_effects(moment, states, rate)
        if not self._code:
            return rate
        size = len(states) // len(self._systems)
        found = []
        for k, system in enumerate(self._systems):
            part = slice(k * size, (k + 1) * size)
            state = self._state(system, moment[part], states[part], rate[part])
            for place in self._code:
                assert state.rate is not None
                state = replace(state, rate=state.rate + system.terms[place](state))
            assert state.rate is not None
            found.append(state.rate.view(rate[part].shape))
        return torch.cat(found)

    def _add_effects(self, moment: np.ndarray, states: Tensor, rate: Tensor) -> None:
        """Add the accelerations by effects, in parts that fit the cache."""
        around, out = self.around, rate.numpy()
        components = states.permute(0, 3, 1, 2).contiguous().numpy()
        windows, people = components.shape[2:]
        size = max(1, CACHED // people**2)
        for k, at in enumerate(moment):
            effects = self._effects[k if self.number > 1 else 0]
            for first in range(0, windows, size):
                part = slice(first, first + size)
                now, others = components[k][:, part], around.others[at][:, part]
                for axis, found in enumerate(effects(at * around.step / 2, now, others, part)):
                    out[k, part, :, axis] += found

    def simulated(self, start: Tensor, steps: int) -> Tensor:
        """``(F, R, W, N, 4)`` positions (m) and velocities (m/s) at the steps, from ``start``
        ``(W, N, 4)``."""
        h = self.around.step

        def rate(t: float, y: np.ndarray) -> np.ndarray:
            found = self(np.full(len(y), round(2 * t / h)), torch.from_numpy(y))
            return np.concatenate([y[..., 2:], found.numpy()], -1)

        y = start.repeat(self.number, 1, 1, 1).numpy()
        return torch.from_numpy(simulated(rate, y, h, steps + 1, h))

    def by_law(self, moment: np.ndarray, states: Tensor) -> Tensor:
        """As above, without what is not compiled."""
        rate = torch.zeros_like(states[..., :2], memory_format=torch.contiguous_format)
        if self.compiled:
            place, number = self.around.place, len(states)
            row = np.arange(number) if self.number > 1 else np.zeros(number, dtype=int)
            own = states.flatten(1, 2).index_select(1, place)
            found = self._kernel.accelerations(
                own.view(-1, 4).numpy(),
                np.tile(np.arange(len(place)), number),
                np.repeat(moment, len(place)),
                np.repeat(row, len(place)),
                *self.around.tables,
                self._law,
            )
            rate.flatten(1, 2).index_copy_(1, place, torch.from_numpy(found).view(number, -1, 2))
        return rate

    def state(self, moment: np.ndarray, states: Tensor) -> State:
        """What a further term sees at many times of one run, ``(L W, N, 2)``."""
        return self._state(self._systems[0], moment, states, self(moment, states))

    def _state(self, system: System, moment: np.ndarray, states: Tensor, rate: Tensor) -> State:
        around, at = self.around, torch.from_numpy(moment)
        t = (at.to(rate.dtype) * around.step / 2).repeat_interleave(rate.shape[1])
        others = around.x[at].flatten(0, 1), around.v[at].flatten(0, 1)
        (x, v), scene = states.flatten(0, 1).split(2, -1), around.repeated(len(states))
        terms = cast(list[Term], list(system.terms))
        return State(t, x, v, scene, terms, rate=rate.flatten(0, 1), seen=others)


def _is_formula(term: Term) -> bool:
    """Whether a term is an effect with a rule."""
    return term.rule_for(2) is not None and not isinstance(term, Law)


class RunAlone:
    """One run of a model of people who walk alone, and its linear response.

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
        """What a further term sees along the run, ``(F W, N, 2)``."""
        return self._rhs.state(self._moment, self._states)

    def of_people(self, field: Tensor) -> Tensor:
        """``(P, 2 F)`` of accelerations ``(F W, N, 2)`` or ``(F, W, N, 2)``, by time."""
        own = field.reshape(len(self._states), -1, 2).index_select(1, self.around.place)
        return own.movedim(1, 0).flatten(1)

    def parameters(self, steps: Sequence[float]) -> list[Tensor]:
        """K accelerations ``(F, W, N, 2)`` per unit of each parameter.

        Args:
            steps: ``(K,)`` differences of the parameters. An effect may be rough: what it does
                over a visible difference of its strength is what a fit has to know.
        """
        found: list[Tensor] = []
        by_law = self._rhs.by_law(self._moment, self._states)
        for name, value in self._own.items():
            known = None if name in self._rhs.of_law else by_law
            for place in range(value.numel()):
                half = torch.zeros(value.numel(), dtype=value.dtype)
                half[place] = steps[len(found)] / 2
                half = half.reshape(value.shape)
                higher, lower = (
                    PersonAlone(self.around, self.system, {**self._own, name: value + change})(
                        self._moment, self._states, known
                    )
                    for change in (half, -half)
                )
                found.append((higher - lower) / steps[len(found)])
        return found

    def unit_responses(self) -> tuple[Tensor, Tensor]:
        """``(P, F, 2, 4)`` responses of positions to the start (x, v); ``(P, F, 2, 2 F)`` to
        accelerations at the steps, by time."""
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
        times = len(matrix)
        start = np.zeros((2, 2, 4 + 2 * times, 1))
        source = np.zeros((times, 2, 2, 4 + 2 * times, 1))
        start[0, 0, 0] = start[0, 1, 1] = start[1, 0, 2] = start[1, 1, 3] = 1.0
        for axis in range(2):
            source[:, 1, axis, 4 + axis :: 2, 0] = np.eye(times)
        found = []
        for part in np.split(matrix, range(PEOPLE, matrix.shape[1], PEOPLE), 1):
            every = [np.repeat(unit, part.shape[1], -1) for unit in (source, start)]
            found.append(RungeKuttaSolver(part, self.around.step).response(*every))
        responses = torch.from_numpy(np.concatenate(found, -1)).permute(3, 0, 1, 2)
        return responses[..., :4], responses[..., 4:]
