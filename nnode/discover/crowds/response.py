"""How a small additional acceleration moves a person who walks alone: linear response."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call

from nnode.calibrate.parameters import ParameterVector
from nnode.discover.crowds.walk import Walk
from nnode.model.effects.base import Effect
from nnode.model.term import State, Term
from nnode.simulate.numpy import runge_kutta

#: Differences of positions (m) and velocities (m/s) for derivatives.
DIFFERENCE = 1e-4


class Frames:
    """The moments of the simulation steps along some paths, all looked at at once.

    Args:
        walk: the model.
        row: ``(K,)`` its parameters.
        x, v: ``(F, P, 2)`` simulated positions (m) and velocities (m/s) at the F steps.
    """

    def __init__(self, walk: Walk, row: Tensor, x: Tensor, v: Tensor) -> None:
        self.walk, self.row = walk, row
        windows = walk.windows
        self._w, self._i = (torch.as_tensor(index) for index in windows.person.T)
        steps = windows.batch.x[::2]
        w, n = windows.batch.agent.shape
        self.shape = (w, len(x), n)
        self.scene = walk.scene.frames(2, windows.step * torch.arange(len(x), dtype=x.dtype))
        assert self.scene.speed is not None
        self.seen = (self.scene.measured[0], self.scene.speed[0])
        whole_x, whole_v = steps.clone(), windows.batch.v[::2].clone()
        whole_x[:, self._w, self._i] = x
        whole_v[:, self._w, self._i] = v
        self.x = whole_x.transpose(0, 1).reshape(-1, n, 2)
        self.v = whole_v.transpose(0, 1).reshape(-1, n, 2)
        self._rate: Tensor | None = None

    def state(self) -> State:
        """What an additional term sees."""
        if self._rate is None:
            with torch.no_grad():
                self._rate = self.acceleration(self.x, self.v)
        return self._bare(self.x, self.v, self._rate)

    def of_people(self, field: Tensor) -> Tensor:
        """``(P, F, ...)`` of ``(W * F, N, ...)``: the rows of real people."""
        shaped = field.reshape(*self.shape, *field.shape[2:])
        return shaped[self._w, :, self._i]

    def acceleration(self, x: Tensor, v: Tensor) -> Tensor:
        """``(W * F, N, 2)`` m/s² of the model at the frames' moments, where people are at x."""
        base = self._compiled(x, v, self.walk.of_law(self.row[None]) if self._fast else None)
        return base + self._beyond(self._own(), self._bare(x, v, base))

    def parameter_tangents(self) -> Tensor:
        """``(K, W * F, N, 2)``: derivatives of the accelerations with respect to the row."""
        own, steps = self._own(), self._steps()
        out: list[Tensor] = []
        with torch.no_grad():
            for name, value in own.items():
                for k in range(value.numel()):
                    half = torch.zeros_like(value).reshape(-1)
                    half[k] = steps[len(out)] / 2
                    half = half.reshape(value.shape)
                    more, less = (self._changed(own, name, value + s * half) for s in (1, -1))
                    out.append((more - less) / steps[len(out)])
        return torch.stack(out)

    def jacobian(self) -> Tensor:
        """``(P, F, 2, 4)``: derivatives of the acceleration with respect to own x and v."""
        columns = []
        with torch.no_grad():
            for k in range(4):
                step = torch.zeros(2, dtype=self.x.dtype)
                step[k % 2] = DIFFERENCE
                none = torch.zeros_like(step)
                dx, dv = (step, none) if k < 2 else (none, step)
                more = self.acceleration(self.x + dx, self.v + dv)
                less = self.acceleration(self.x - dx, self.v - dv)
                columns.append(self.of_people(more - less) / (2 * DIFFERENCE))
        return torch.stack(columns, -1)

    # -- parts -----------------------------------------------------------------------------

    @property
    def _fast(self) -> bool:
        return self.walk.compiled

    def _bare(self, x: Tensor, v: Tensor, rate: Tensor) -> State:
        zero = torch.zeros((), dtype=x.dtype)
        terms = cast(list[Term], list(self.walk.system.terms))
        return State(zero, x, v, self.scene, terms, rate=rate, seen=self.seen)

    def _own(self) -> dict[str, Tensor]:
        return {name: part[0] for name, part in self.walk.parameters(self.row[None]).items()}

    def _beyond(self, own: dict[str, Tensor], state: State) -> Tensor:
        if not self.walk.beyond.added:
            return torch.zeros_like(state.x)
        found: Tensor = functional_call(self.walk.beyond, own, (state,))
        return found

    def _steps(self) -> list[float]:
        """Differences of the parameters. An effect's force may be rough: what it does over a
        visible difference of its strength is what a fit has to know."""
        out = []
        for name, p in ParameterVector(self.walk.system).parameters.items():
            _, place, key = name.split(".", 2)
            term = self.walk.system.terms[int(place)]
            known = term.strengths.get(key) if isinstance(term, Effect) else None
            size = 1e-3 * max(1.0, float(p.detach().abs().max()))
            out += [size if known is None else abs(known.step)] * p.numel()
        return out

    def _changed(self, own: dict[str, Tensor], name: str, value: Tensor) -> Tensor:
        """``(W * F, N, 2)`` m/s²: what depends on a parameter, at another value of it."""
        key = name.removeprefix("system.")
        whole = {**own, name: value}
        _, place, _ = key.split(".", 2)
        term = self.walk.system.terms[int(place)]
        if isinstance(term, Effect) and self._last(term):
            start = f"system.terms.{place}."
            mine = {n.removeprefix(start): v for n, v in whole.items() if n.startswith(start)}
            found: Tensor = functional_call(term, mine, (self.state(),))
            return found
        q = None
        if self._fast:
            row = self.row.clone()
            row[self.walk.place(key)] = value.reshape(-1)
            q = self.walk.of_law(row[None])
        base = self._compiled(self.x, self.v, q)
        return base + self._beyond(whole, self._bare(self.x, self.v, base))

    def _last(self, effect: Effect) -> bool:
        """Whether no other term may look at the sum with this effect."""
        others = [t for t in self.walk.system.terms if isinstance(t, Effect) and t is not effect]
        return all(other.rank == effect.rank for other in others)

    def _compiled(self, x: Tensor, v: Tensor, q: np.ndarray | None) -> Tensor:
        out = torch.zeros_like(x)
        if q is None:
            return out
        state = torch.cat([self.of_people(x), self.of_people(v)], -1)
        p, f = state.shape[:2]
        found = self.walk.kernel.accelerations(
            state.reshape(p * f, 4).numpy(),
            np.repeat(np.arange(p), f),
            np.tile(2 * np.arange(f), p),
            np.zeros(p * f, dtype=np.int64),
            *self.walk.tables.arguments(),
            q,
        )
        shaped = out.view(*self.shape, 2)
        shaped[self._w, :, self._i] = torch.from_numpy(found).reshape(p, f, 2)
        return out


def propagate(jacobian: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Responses of a person's positions.

    Args:
        jacobian: ``(P, F, 2, 4)``, see :meth:`Frames.jacobian`.
        step: s.

    Returns:
        ``(P, F, 2, 4)``: of the positions to the start (x, v); ``(P, F, 2, F, 2)``: to
        accelerations given at the steps, parabolas through three of them in between. By the
        classical Runge-Kutta method.
    """
    p, f = jacobian.shape[:2]
    full = torch.zeros(p, f, 4, 4, dtype=jacobian.dtype)
    full[..., 0, 2] = full[..., 1, 3] = 1.0
    full[..., 2:, :] = jacobian
    before, after = full[:, :-1], full[:, 1:]
    # columns: the four components of the state, acceleration before, acceleration after
    y = torch.zeros(p, f - 1, 4, 8, dtype=jacobian.dtype)
    y[..., :4] = torch.eye(4, dtype=jacobian.dtype)

    def rate(share: float, y: Tensor) -> Tensor:
        out = (before + share * (after - before)) @ y
        for k in range(2):
            out[..., 2 + k, 4 + k] += 1 - share
            out[..., 2 + k, 6 + k] += share
        return step * out

    y = runge_kutta(rate, 0.0, y, 1.0, rate(0.0, y))
    start = torch.zeros(p, f, 2, 4, dtype=jacobian.dtype)
    forced = torch.zeros(p, f, 2, f, 2, dtype=jacobian.dtype)
    state = torch.zeros(p, 4, 4 + 2 * f, dtype=jacobian.dtype)
    state[:, :, :4] = torch.eye(4, dtype=jacobian.dtype)
    for k in range(f):
        if k:
            state = y[:, k - 1, :, :4] @ state
            state[:, :, 2 + 2 * k : 6 + 2 * k] += y[:, k - 1, :, 4:]
        if k > 1:
            for past, share in enumerate((1.0, -2.0, 1.0)):
                for d in range(2):
                    column = 4 + 2 * (k - past) + d
                    state[:, d, column] -= share * step**2 / 24
                    state[:, 2 + d, column] -= share * step / 12
        start[:, k] = state[:, :2, :4]
        forced[:, k] = state[:, :2, 4:].reshape(p, 2, f, 2)
    return start, forced
