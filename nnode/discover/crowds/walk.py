"""Simulation of people who walk alone: the law compiled, its effects in PyTorch."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import takewhile
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap

from nnode.calibrate.parameters import ParameterVector
from nnode.discover.crowds.windows import Windows, WindowScene, alone
from nnode.model.crowd_formula import settings_of, walls_of
from nnode.model.formula import crowd_of, own_values, values_of
from nnode.model.laws import InteractionForce, Law
from nnode.model.system import Crowd, System
from nnode.model.term import State, Term
from nnode.simulate.kernels.alone import WalkSource, compiled
from nnode.simulate.numpy import runge_kutta

#: Numbers in the largest intermediate result.
CHUNK = 2_000_000


class Beyond(nn.Module):
    """The sum of a model's terms that have no compiled code."""

    def __init__(self, system: Crowd, terms: list[Term]) -> None:
        super().__init__()
        self.system = system
        self.added = terms  # a plain list: the terms' parameters belong to the system

    def forward(self, state: State) -> Tensor:
        assert state.rate is not None
        first = total = state.rate
        terms = cast(list[Term], list(self.system.terms))
        for term in self.added:
            total = total + term(replace(state, terms=terms, rate=total))
        return total - first


@dataclass
class Tables:
    """What the compiled code knows of the surroundings, see
    :mod:`nnode.simulate.kernels.alone`."""

    others: np.ndarray
    window: np.ndarray
    meets: np.ndarray
    wall: np.ndarray
    points: np.ndarray
    edge: np.ndarray
    edges: np.ndarray
    have: np.ndarray

    @classmethod
    def of(cls, windows: Windows, scene: WindowScene, source: WalkSource) -> Tables:
        """The tables of all people of all windows."""
        which, who = windows.person.T
        x, v = windows.batch.x.numpy(), windows.batch.v.numpy()
        others = np.ascontiguousarray(np.concatenate([x, v], -1).transpose(0, 1, 3, 2))
        agent = scene.agent.numpy()
        meets = agent[which].astype(float)
        meets[np.arange(len(who)), who] = 0.0
        place, normal, real = (part.numpy() for part in scene.walls_of_each())
        shape = (*agent.shape, place.shape[2])
        wall = np.broadcast_to(np.concatenate([place, normal], -1), (*shape, 4))[which, who]
        there = np.broadcast_to(real, shape)[which, who]
        # real points come first
        order = np.argsort(~there, axis=1, kind="stable")
        wall = np.take_along_axis(wall, order[..., None], 1).transpose(0, 2, 1)
        edge, solid = (part.numpy()[which] for part in walls_of(scene))
        first = np.argsort(~solid, axis=1, kind="stable")
        edge = np.take_along_axis(edge, first[..., None], 1).transpose(0, 2, 1)
        goal = scene.destination.numpy()[which, who]
        has = {
            "goal_x": goal[:, 0],
            "goal_y": goal[:, 1],
            "pace": scene.pace.numpy()[which, who],
            "people": scene.count.numpy()[which, 0, 0],
            "points": scene.wall_count.numpy()[which, 0, 0],
        }
        have = np.stack([has[name] for name in source.fields] or [np.zeros(len(who))], 1)
        around = (np.ascontiguousarray(wall), there.sum(1), np.ascontiguousarray(edge))
        return cls(others, which, meets, *around, solid.sum(1), have)

    def arguments(self) -> tuple[np.ndarray, ...]:
        """In the order of the compiled functions."""
        return tuple(getattr(self, field.name) for field in fields(self))


class Walk:
    """One model among the measured others.

    Its law, the terms before its effects, is compiled where it is a formula; what effects add is
    computed by PyTorch, so that nothing has to be compiled for each of many of them.

    Args:
        windows: the windows.
        scene: their surroundings.
        system: the model.
        tables: from :class:`Tables`, where they are known already.
    """

    def __init__(
        self, windows: Windows, scene: WindowScene, system: System, tables: Tables | None = None
    ) -> None:
        self.windows, self.scene, self.system = windows, scene, alone(system)
        terms = cast(list[Term], list(system.terms))
        self.law = list(takewhile(lambda term: isinstance(term, Law), terms))
        law = crowd_of(self.law)
        force = system.find(InteractionForce)
        oneself = force is not None and force.self_interaction
        self.formula = None if oneself else law
        self.beyond = Beyond(self.system, terms[len(self.law) :] if self.compiled else terms)
        self.names = list(ParameterVector(system).parameters)
        self._people = tuple(torch.as_tensor(index) for index in windows.person.T)
        self.sizes = [p.numel() for p in ParameterVector(system).parameters.values()]
        if self.formula is not None:
            source = WalkSource(self.formula)
            self.kernel = compiled(source)
            self.tables = tables or Tables.of(windows, scene, source)

    @property
    def compiled(self) -> bool:
        """Whether its law is."""
        return self.formula is not None

    def place(self, name: str) -> slice:
        """Of a parameter in rows."""
        i = self.names.index(name)
        first = sum(self.sizes[:i])
        return slice(first, first + self.sizes[i])

    def of_law(self, rows: Tensor) -> np.ndarray:
        """``(R, U)``: parameters of the compiled law of rows ``(R, K)``."""
        assert self.formula is not None
        fixed = list(settings_of(self.law, self.formula).values())
        values = {}
        for name, own in own_values(self.law, self.formula).items():
            value = own.detach().double().expand(len(rows), *own.shape)
            if name in self.names:
                value = rows[:, self.place(name)].reshape(value.shape)
            values[name] = value
        found = values_of(self.formula, values)
        every = [part.numpy() for part in found] + [np.full(len(rows), v) for v in fixed]
        return np.stack(every, 1) if every else np.zeros((len(rows), 1))

    def parameters(self, rows: Tensor) -> dict[str, Tensor]:
        """Rows ``(R, K)`` as parameters of :class:`Beyond`."""
        own = ParameterVector(self.system).parameters.values()
        parts = rows.split(self.sizes, 1)
        return {
            f"system.{name}": part.reshape(-1, *p.shape)
            for name, p, part in zip(self.names, own, parts, strict=True)
        }

    @torch.no_grad()
    def paths(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (m) and velocities (m/s) ``(F, R, P, 2)`` at the steps of the simulation."""
        w, n = self.windows.batch.agent.shape
        most = max(1, CHUNK // (2 * w * n * n))
        parts = [self._run(part.double()) for part in rows.split(most)]
        path = torch.cat(parts, 1)
        return path[..., :2], path[..., 2:]

    def _run(self, rows: Tensor) -> Tensor:
        windows, (which, who) = self.windows, self._people
        first = torch.cat([windows.batch.x[0], windows.batch.v[0]], -1)
        parameters = self.parameters(rows)
        if self.compiled:
            return self._compiled(parameters, rows, first[which, who])
        y = first.expand(len(rows), *first.shape)
        out = [y[:, which, who]]
        for n in range(windows.steps):
            rate = partial(self._change, parameters, 2 * n)
            y = runge_kutta(rate, 0.0, y, 1.0, rate(0.0, y))
            out.append(y[:, which, who])
        return torch.stack(out)

    def _compiled(self, parameters: dict[str, Tensor], rows: Tensor, start: Tensor) -> Tensor:
        """``(F, R, P, 4)``; the terms that are not compiled are evaluated once in each step.

        In a step their accelerations are extrapolated first, and the state after it is corrected
        when they are known there: a parabola through the last three steps, for a sway of one
        second changes too fast for lines.
        """
        windows, h, q = self.windows, self.windows.step, self.of_law(rows)
        out = np.empty((windows.steps + 1, len(rows), *start.shape))
        out[0] = start.numpy()
        before = self._extra(parameters, q, 0, out[0])
        after = before
        for n in range(windows.steps):
            rate = partial(self._change_by_law, q, 2 * n, before, after)
            out[n + 1] = runge_kutta(rate, 0.0, out[n], 1.0, rate(0.0, out[n]))
            if self.beyond.added:
                found = self._extra(parameters, q, 2 * n + 2, out[n + 1])
                bend = found - after if n else 0.0
                out[n + 1, ..., :2] += h**2 / 6 * (found - after) - h**2 / 24 * bend
                out[n + 1, ..., 2:] += h / 2 * (found - after) - h / 12 * bend
                before, after = found, 2 * found - before
        return torch.from_numpy(out)

    def _change_by_law(
        self, q: np.ndarray, moment: int, before: np.ndarray, after: np.ndarray, share: float,
        states: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """``(R, P, 4)``: change of states in a step from a moment on, at a share of it."""
        own = self._of_law(q, moment + round(2 * share), states)
        own += (1 - share) * before + share * after
        return self.windows.step * np.concatenate([states[..., 2:], own], -1)

    def _of_law(self, q: np.ndarray, moment: int, states: np.ndarray) -> np.ndarray:
        """``(R, P, 2)`` m/s² of the compiled law, of states ``(R, P, 4)`` at one half step."""
        r, p = states.shape[:2]
        found: np.ndarray = self.kernel.accelerations(
            states.reshape(r * p, 4), np.tile(np.arange(p), r), np.full(r * p, moment),
            np.repeat(np.arange(r), p), *self.tables.arguments(), q,
        )  # fmt: skip
        return found.reshape(r, p, 2)

    def _extra(
        self, parameters: dict[str, Tensor], q: np.ndarray, moment: int, states: np.ndarray
    ) -> np.ndarray:
        """``(R, P, 2)`` m/s² of the terms that are not compiled."""
        if not self.beyond.added:
            return np.zeros((*states.shape[:2], 2))
        (which, who), r = self._people, len(states)
        x = self.windows.batch.x[moment].expand(r, -1, -1, -1).clone()
        v = self.windows.batch.v[moment].expand_as(x).clone()
        state = torch.from_numpy(states)
        x[:, which, who], v[:, which, who] = state[..., :2], state[..., 2:]
        rate = torch.zeros_like(x)
        rate[:, which, who] = torch.from_numpy(self._of_law(q, moment, states))
        return self._beyond(parameters, moment, x, v, rate)[:, which, who].numpy()

    def _change(
        self, parameters: dict[str, Tensor], moment: int, share: float, y: Tensor
    ) -> Tensor:
        """``(R, W, N, 4)``: change of states in a step from a moment on, at a share of it."""
        x, v = y[..., :2], y[..., 2:]
        now = moment + round(2 * share)
        rate = self._beyond(parameters, now, x, v, torch.zeros_like(x))
        return self.windows.step * torch.cat([v, rate], -1)

    def _beyond(
        self, own: dict[str, Tensor], moment: int, x: Tensor, v: Tensor, rate: Tensor
    ) -> Tensor:
        t = torch.tensor(moment * self.windows.step / 2, dtype=x.dtype)
        seen = (self.windows.batch.x[moment], self.windows.batch.v[moment])

        def one(own: dict[str, Tensor], x: Tensor, v: Tensor, rate: Tensor) -> Tensor:
            state = State(t, x, v, self.scene, rate=rate, seen=seen)
            found: Tensor = functional_call(self.beyond, own, (state,))
            return found

        if len(x) == 1:
            # nothing to batch, and no price of batching
            single = {name: value[0] for name, value in own.items()}
            return one(single, x[0], v[0], rate[0])[None]
        found: Tensor = vmap(one)(own, x, v, rate)
        return found
