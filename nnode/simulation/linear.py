"""The linear response of a simulated path: how small changes move it, without simulating again.

Along a path y(t) of dy/dt = f(t, y) small changes d of the states obey d' = A(t) d + s(t), where A
is the derivative of f by the states and s a change of the rates. The trapezoidal rule solves this
at the sampling times, in time proportional to their number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from nnode.data.sequence import Batch
from nnode.model.differentiate import derivatives
from nnode.model.lane_rates import Formulas
from nnode.model.scene import Scene
from nnode.model.system import System, initial_with
from nnode.model.term import State
from nnode.model.terms import LaneDynamics
from nnode.simulation.numpy import runge_kutta
from nnode.simulation.rhs import RightHandSide, arranged, rates_along, samples

#: Derivatives of rates ``(N - 1, K, B)`` by number of the rate's state, number of vehicles ahead,
#: and number of the state that is varied. The number after the last state is that of the speed
#: ``dx_1`` of the vehicle ahead.
Blocks = dict[tuple[int, int, int], np.ndarray]


class Solver(Protocol):
    """Linearised equations along a path."""

    def response(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """``(K, N, C, B)`` changes of the first state, by changes of rates and starts.

        Args:
            source: ``(K, W, N, C, B)`` changes of the first W states' rates; the others' do not
                change.
            start: ``(M, N, C, B)`` changes of the states at the start; None: there are none.
        """
        ...


class DenseSolver:
    """Equations where all states of a group depend on all.

    Args:
        matrix: A, ``(K, B, M N, M N)``, one state of all agents after the other.
        width: M. dt: sampling interval, s.
    """

    def __init__(self, matrix: np.ndarray, width: int, dt: float) -> None:
        self._width, self._half = width, dt / 2
        self._step, self._after = trapezoidal(matrix, dt)

    def response(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        k, w, n, c, b = source.shape
        every = np.zeros((k, self._width, n, c, b))
        every[:, :w] = source
        flat = torch.from_numpy(every).flatten(1, 2).permute(0, 3, 1, 2)
        forced = self._forced(flat)
        state = flat.new_zeros(flat.shape[1:])
        if start is not None:
            state = torch.from_numpy(start).flatten(0, 1).permute(2, 0, 1).contiguous()
        found = [state]
        for step, change in zip(self._step, forced, strict=True):
            found.append(step @ found[-1] + change)
        moved: np.ndarray = torch.stack(found)[:, :, :n].permute(0, 2, 3, 1).numpy()
        return moved

    def _forced(self, source: Tensor) -> Tensor:
        """``(K - 1, B, M N, C)`` changes of the states in each step by ``source``
        ``(K, B, M N, C)``."""
        return self._after @ (self._half * (source[1:] + source[:-1]))


class RungeKuttaSolver(DenseSolver):
    """Positions and velocities, by the classical method of fourth order in place of the trapezoidal
    rule; accelerations are parabolas through three samples. A gait's sway of one second, and the
    contact of two people, change too fast for lines.

    Args:
        matrix: A, ``(K, B, 2 N, 2 N)``, positions of all agents before velocities.
        dt: sampling interval, s.
    """

    def __init__(self, matrix: np.ndarray, dt: float) -> None:
        before, after = torch.from_numpy(matrix[:-1]), torch.from_numpy(matrix[1:])
        self._width, self._dt, size = 2, dt, matrix.shape[-1]
        unit = torch.eye(size, dtype=before.dtype)
        # columns: the states, the rates before, the rates after
        start = torch.cat([unit, 0 * unit, 0 * unit], 1).expand(*before.shape[:2], -1, -1)

        def rate(share: float, y: Tensor) -> Tensor:
            given = torch.cat([0 * unit, (1 - share) * unit, share * unit], 1)
            return dt * ((before + share * (after - before)) @ y + given)

        y = runge_kutta(rate, 0.0, start, 1.0, rate(0.0, start))
        self._step, self._of_before, self._of_after = y.split(size, -1)

    def _forced(self, source: Tensor) -> Tensor:
        found = self._of_before @ source[:-1] + self._of_after @ source[1:]
        half = source.shape[2] // 2
        bend = source[2:, :, half:] - 2 * source[1:-1, :, half:] + source[:-2, :, half:]
        found[1:, :, :half] -= self._dt**2 / 24 * bend
        found[1:, :, half:] -= self._dt / 12 * bend
        return found


class FrontToBackSolver:
    """Equations of a platoon whose vehicles depend on themselves and on the two ahead.

    At each time the vehicles are solved one by one, from the front on.

    Args:
        blocks: A.
        width: M. dt: sampling interval, s.
    """

    def __init__(self, blocks: Blocks, width: int, dt: float) -> None:
        self._blocks, self._width, self._half = blocks, width, dt / 2
        self._chained = any(q == width for _, _, q in blocks)
        self._ahead = {key: dt / 2 * slope for key, slope in blocks.items() if key[1]}
        own = {(p, q): slope for (p, ahead, q), slope in blocks.items() if not ahead}
        self._inverse = dict[tuple[int, int], np.ndarray]()
        if own:
            matrix = np.zeros((*next(iter(own.values())).shape, width, width)) + np.eye(width)
            for (p, q), slope in own.items():
                matrix[..., p, q] -= dt / 2 * slope
            inverse = _inverse(torch.from_numpy(matrix)).numpy()
            for p, q in np.ndindex(width, width):
                if p == q or inverse[..., p, q].any():
                    self._inverse[p, q] = np.ascontiguousarray(inverse[..., p, q])

    def response(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        times, known, n, c, b = source.shape
        # after the states stands the change of the speed, (A d)_0
        d = np.zeros((self._width + 1, n, c, b))
        half = np.zeros((self._width, n, c, b))
        if start is not None:
            d[:-1] = start
            first = {key: slope[:, :1] for key, slope in self._blocks.items()}
            matrix = whole(first, (self._width, n, 1, b))[..., 0, :]
            half = start + self._half * np.einsum("pnqmb,qmcb->pncb", matrix, start)
        right, share = np.empty_like(half), np.empty((c, b))
        found = np.empty((times, n, c, b))
        found[0] = d[0]
        for k in range(1, times):
            right[:] = half
            right[:known] += self._half * (source[k - 1] + source[k])
            d[:-1, -1] = right[:, -1]
            for i in range(n - 2, -1, -1):
                self._solve(d, right, i, k, share)
            # the other half of the rule follows from what was solved: d - dt/2 A d = right
            np.multiply(d[:-1], 2.0, out=half)
            half -= right
            found[k] = d[0]
        return found

    def _solve(self, d: np.ndarray, right: np.ndarray, i: int, k: int, share: np.ndarray) -> None:
        """The states of vehicle ``i`` at a time, those ahead of it being known."""
        rest = right[:, i].copy() if self._ahead else right[:, i]
        for (p, ahead, q), slope in self._ahead.items():
            if i + ahead < d.shape[1]:
                np.multiply(slope[i, k], d[q, i + ahead], out=share)
                rest[p] += share
        if not self._inverse:
            d[:-1, i] = rest
        else:
            d[:-1, i] = 0.0
            for (p, q), inverse in self._inverse.items():
                np.multiply(inverse[i, k], rest[q], out=share)
                d[p, i] += share
        if self._chained:
            np.subtract(d[0, i], right[0, i], out=d[-1, i])
            d[-1, i] /= self._half


def trapezoidal(matrix: np.ndarray, dt: float) -> tuple[Tensor, Tensor]:
    """The trapezoidal rule for d' = A d + s.

    Args:
        matrix: A, ``(K, ..., M, M)``. dt: sampling interval, s.

    Returns:
        Two tensors ``(K - 1, ..., M, M)``: the states after an interval by those before, and by
        ``dt / 2`` times the sum of s at both ends.
    """
    half, one = dt / 2 * torch.from_numpy(matrix), torch.eye(matrix.shape[-1]).double()
    after = _inverse(one - half[1:])
    return after @ (one + half[:-1]), after


def _inverse(matrix: Tensor) -> Tensor:
    """Inverse matrices; no numbers where there is none, as of a model that blows up."""
    found, info = torch.linalg.inv_ex(matrix)
    return torch.where(info[..., None, None] == 0, found, torch.nan)


def whole(blocks: Blocks, shape: tuple[int, ...]) -> np.ndarray:
    """``(M, N, M, N, K, B)`` derivatives of all rates by all states.

    Args:
        shape: of the states, ``(M, N, K, B)``.
    """
    m, n = shape[:2]
    found = np.zeros((m, n, m, n, *shape[2:]))
    for i in range(n - 2, -1, -1):
        for (p, ahead, q), slope in blocks.items():
            if q == m:
                found[p, i] += slope[i] * found[0, i + 1]
            elif i + ahead < n:
                found[p, i, q, i + ahead] += slope[i]
    return found


@cache
def _derivatives(
    lane: LaneDynamics,
) -> tuple[list[tuple[int, str]], Formulas, list[str], Formulas]:
    """Which derivatives of rates there are, a function of all, and those of a leader's speed."""
    states = list(lane.rates)
    names = [f"{s}{ahead}" for ahead in ("", "_1", "_2") for s in states] + ["dx_1", *lane.owned]
    found = {
        (p, name): node
        for p, rate in enumerate(lane.rates.values())
        for name, node in derivatives(rate, names).items()
    }
    lead = derivatives(lane.leader, list(lane.owned))
    return list(found), Formulas(list(found.values())), list(lead), Formulas(list(lead.values()))


class LinearResponse:
    """The linear response of a run of a model of a lane.

    Args:
        system: the model, with the run's parameters.
        batch: the sequences. scene: their surroundings, with the step of the run.
        states: ``(K, B, N, M)`` of the run at the sampling times.

    Attributes:
        rhs: the right-hand side.
    """

    def __init__(self, system: System, batch: Batch, scene: Scene, states: Tensor) -> None:
        self.system, self._batch, self.states = system, batch, states
        self.rhs, self._t = RightHandSide(system, scene), samples(scene, len(states))
        self._y, _ = self.rhs.placed(self._t, arranged(states))
        m, n, *rest = self._y.shape
        self._blocks, self._speed = Blocks(), np.zeros(self._y.shape[1:])
        self._of_parameters = dict[tuple[int, str], np.ndarray]()
        self._of_lead = dict[str, Any]()
        #: of the rates of the added term by the speeds that the formula says
        self._by_speed = np.zeros((n, n, *rest))
        self._solver: Solver
        with np.errstate(all="ignore"):
            if self.rhs.lane is not None:
                self._differentiate(self.rhs.lane)
            if self.rhs.lane is not None and self.rhs.added is None:
                self._solver = FrontToBackSolver(self._blocks, m, batch.dt)
                return
            matrix = self._with_code(whole(self._blocks, self._y.shape))
            matrix = matrix.reshape(m * n, m * n, *rest).transpose(2, 3, 0, 1)
            self._solver = DenseSolver(matrix.copy(), m, batch.dt)

    def _differentiate(self, lane: LaneDynamics) -> None:
        """Derivatives of the formula along the path."""
        rhs, blocks = self.rhs, self._blocks
        symbols = rhs.symbols(self._t, self._y)[1]
        rates = rhs.by_formula(self._y, symbols)
        self._speed = rates[0]
        which, function, lead, of_lead = _derivatives(lane)
        places = {
            f"{state}{ahead}": (len(ahead) and int(ahead[1]), q)
            for ahead in ("", "_1", "_2")
            for q, state in enumerate(lane.rates)
        }
        places["dx_1"] = 1, len(lane.rates)
        every = function({**symbols, "dx_1": rates[0, 1:]})
        for (p, name), value in zip(which, every, strict=True):
            wide = np.where(rhs.rates.follows, value, np.zeros_like(rates[0, 1:]))
            if name in lane.owned:
                self._of_parameters[p, name] = wide
                continue
            ahead, q = places[name]
            if ahead == 2:  # who has no second vehicle ahead sees one behind the first
                near = np.where(rhs.rates.second, 0.0, wide)
                blocks[p, 1, q] = blocks.get((p, 1, q), 0.0) + near
                wide = wide - near
            blocks[p, ahead, q] = blocks.get((p, ahead, q), 0.0) + wide
        if not rhs.measured:
            values = rhs.rates.of_leaders(of_lead, self._y, symbols)
            self._of_lead.update(zip(lead, values, strict=True))

    def _with_code(self, matrix: np.ndarray) -> np.ndarray:
        """Derivatives of all rates by all states ``(M, N, M, N, K, B)``, from those of the
        formula."""
        rhs = self.rhs
        y, speed = known = [
            torch.from_numpy(one).clone().requires_grad_() for one in (self._y, self._speed)
        ]
        with torch.enable_grad():
            rates = rhs.by_code(self._t, y, speed)
            sums = [[rate.sum() for rate in every] for every in rates]
        by_formula, coded = matrix[0].copy(), matrix[rhs.coded]
        for p, i in np.ndindex(*coded.shape[:2]):
            if sums[p][i].requires_grad:
                found = torch.autograd.grad(sums[p][i], known, retain_graph=True, allow_unused=True)
                for total, part in zip((coded[p, i], self._by_speed[i]), found, strict=True):
                    total += 0.0 if part is None else part.numpy()
        matrix[rhs.top] += np.einsum("ijkb,jqmkb->iqmkb", self._by_speed, by_formula)
        return matrix

    @np.errstate(all="ignore")
    def response(self, source: Tensor, start: Tensor | None = None) -> Tensor:
        """``(C, K, B, N)`` m: positions moved by changes of the rates and of the start.

        Args:
            source: ``(C, K, B, N, W)`` changes of the first W states' rates, m/s for positions,
                as a column of an effect; of leaders those that change their paths.
            start: ``(C, B, N, M)`` changes of the states at the start, by default none.
        """
        first = None if start is None else start.permute(3, 2, 0, 1).contiguous().numpy()
        found = self._solver.response(source.permute(1, 4, 3, 0, 2).contiguous().numpy(), first)
        return torch.from_numpy(found).permute(2, 0, 3, 1)

    def parameters(self, entries: Sequence[tuple[str, int]]) -> Tensor:
        """``(C, K, B, N)`` m per unit of parameters.

        Args:
            entries: of each the name in the model, and the place in that parameter.
        """
        return self.response(self._sources(entries), self._starts(entries))

    def _sources(self, entries: Sequence[tuple[str, int]]) -> Tensor:
        """``(C, K, B, N, M)`` derivatives of the rates by parameters."""
        rhs, (m, n) = self.rhs, self._y.shape[:2]
        found = np.zeros((len(entries), *self._y.shape))
        owned = {} if rhs.lane is None else rhs.lane.owned
        for symbol, (name, place, _) in owned.items():
            if (name, place) not in entries:
                continue
            own = found[entries.index((name, place))]
            for p in range(m):
                own[p, :-1] += self._of_parameters.get((p, symbol), 0.0)
            own[0] += np.where(rhs.leads, self._of_lead.get(symbol, 0.0), 0.0)
        for i in range(n - 2, -1, -1):
            for (p, _, q), slope in self._blocks.items():
                if q == m:
                    found[:, p, i] += slope[i] * found[:, 0, i + 1]
        found[:, rhs.top] += np.einsum("ijkb,cjkb->cikb", self._by_speed, found[:, 0])
        code = rhs.lane is None or rhs.added is not None
        y, speed = torch.from_numpy(self._y), torch.from_numpy(self._speed)
        for own, (name, place) in zip(found, entries, strict=True):
            if code and name.startswith(rhs.own):
                rates = self._along(name, place, partial(rhs.by_code, self._t, y, speed))
                own[rhs.coded] += rates.numpy()
        return torch.from_numpy(found).permute(0, 3, 4, 2, 1)

    def _starts(self, entries: Sequence[tuple[str, int]]) -> Tensor | None:
        """``(C, B, N, M)`` derivatives of the states at the start; None: they are measured."""
        if self.states.shape[-1] == self.system.order:
            return None
        start = partial(initial_with, self.system, batch=self._batch)
        return torch.stack([self._along(name, place, start) for name, place in entries])

    def _along(
        self, name: str, place: int, function: Callable[[dict[str, Tensor]], Tensor]
    ) -> Tensor:
        """The derivative of a function by one number of a parameter."""
        value = self.system.get_parameter(name).detach()
        change = torch.zeros(value.numel(), dtype=value.dtype)
        change[place] = 1.0
        with torch.no_grad(), forward_ad.dual_level():
            found = function({name: forward_ad.make_dual(value, change.reshape(value.shape))})
            moved: Tensor | None = forward_ad.unpack_dual(found).tangent
        return torch.zeros_like(found) if moved is None else moved

    def rates(self, system: System) -> Tensor:
        """``(K, B, N, M)`` rates of another model along the path."""
        return rates_along(system, self.rhs.scene, self.states)

    def state(self) -> State:
        """What terms see along the path, see :meth:`RightHandSide.state`."""
        return self.rhs.state(self._t, self._y)
