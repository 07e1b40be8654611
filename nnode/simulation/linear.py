"""The linear response of a simulated path to small changes, without another simulation.

Along a path y(t) of dy/dt = f(t, y), small changes d of the states obey d' = A(t) d + s(t), where
A is the derivative of f by the states and s is a change of the rates. The trapezoidal rule solves
this at the sampling times, in time proportional to their number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from nnode.data.sequence import Batch
from nnode.model.arrays import Formulas
from nnode.model.differentiate import derivatives
from nnode.model.scene import Scene
from nnode.model.system import System, with_parameters
from nnode.model.term import State
from nnode.model.terms import LaneDynamics
from nnode.simulation.numpy import runge_kutta
from nnode.simulation.rhs import RightHandSide, arranged, rates_along, samples

#: (index of the rate's state, number of vehicles ahead, index of the varied state) to derivatives
#: of rates ``(N - 1, K, B)``. The index after the last state stands for ``dx_1``, the speed of the
#: vehicle ahead.
Blocks = dict[tuple[int, int, int], np.ndarray]


class DenseSolver:
    """Equations in which all states of a sequence may depend on each other.

    Args:
        matrix: A, ``(K, B, M N, M N)``; each state of all agents is contiguous.
        width: M. dt: sampling interval, s.
    """

    def __init__(self, matrix: np.ndarray, width: int, dt: float) -> None:
        self._width, self._half = width, dt / 2
        self._step, self._after = trapezoidal(matrix, dt)

    def response(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """``(K, N, C, B)`` changes of the first state by C changes of rates and starts.

        Args:
            source: ``(K, W, N, C, B)`` changes of the rates of the first W states; the other
                rates do not change.
            start: ``(M, N, C, B)`` changes of the states at the start; None for 0.
        """
        n = source.shape[2]
        positions: np.ndarray = self.states(source, start)[:, :, :n].permute(0, 2, 3, 1).numpy()
        return positions

    def states(self, source: np.ndarray, start: np.ndarray | None = None) -> Tensor:
        """``(K, B, M N, C)`` changes of all states, see :meth:`response`."""
        k, w, n, c, b = source.shape
        all_sources = np.zeros((k, self._width, n, c, b))
        all_sources[:, :w] = source
        flat = torch.from_numpy(all_sources).flatten(1, 2).permute(0, 3, 1, 2)
        forced = self._forced(flat)
        state = flat.new_zeros(flat.shape[1:])
        if start is not None:
            state = torch.from_numpy(start).flatten(0, 1).permute(2, 0, 1).contiguous()
        states = [state]
        for step, change in zip(self._step, forced, strict=True):
            states.append(step @ states[-1] + change)
        return torch.stack(states)

    @property
    def number(self) -> int:
        """B."""
        return self._step.shape[1]

    def _forced(self, source: Tensor) -> Tensor:
        """``(K - 1, B, M N, C)`` changes of the states in each step by ``source``
        ``(K, B, M N, C)``."""
        return self._after @ (self._half * (source[1:] + source[:-1]))


class RungeKuttaSolver(DenseSolver):
    """Positions and velocities by the classic Runge-Kutta method instead of the trapezoidal rule.

    Accelerations are parabolas through three samples. Linear interpolation is too inaccurate for a
    gait's sway of one second and for contacts of people.

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
        change = self._of_before @ source[:-1] + self._of_after @ source[1:]
        half = source.shape[2] // 2
        bend = source[2:, :, half:] - 2 * source[1:-1, :, half:] + source[:-2, :, half:]
        change[1:, :, :half] -= self._dt**2 / 24 * bend
        change[1:, :, half:] -= self._dt / 12 * bend
        return change


class FrontToBackSolver:
    """Equations of a platoon whose vehicles depend on themselves and on the two vehicles ahead.

    At each time the vehicles are solved one by one, starting from the front.

    Args:
        blocks: A.
        width: M. dt: sampling interval, s.
    """

    def __init__(self, blocks: Blocks, width: int, dt: float) -> None:
        self._blocks, self._width, self._half = blocks, width, dt / 2
        self._chained = any(q == width for _, _, q in blocks)
        self._ahead = {key: dt / 2 * slope for key, slope in blocks.items() if key[1]}
        own_blocks = {(p, q): slope for (p, ahead, q), slope in blocks.items() if not ahead}
        self._inverse = dict[tuple[int, int], np.ndarray]()
        if own_blocks:
            matrix = np.zeros((*next(iter(own_blocks.values())).shape, width, width)) + np.eye(
                width
            )
            for (p, q), slope in own_blocks.items():
                matrix[..., p, q] -= dt / 2 * slope
            inverse = _inverse(torch.from_numpy(matrix)).numpy()
            for p, q in np.ndindex(width, width):
                if p == q or inverse[..., p, q].any():
                    self._inverse[p, q] = np.ascontiguousarray(inverse[..., p, q])

    def response(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """See :meth:`DenseSolver.response`."""
        times, width, n, c, b = source.shape
        # the row after the states is the change of the speed, (A d)_0
        d = np.zeros((self._width + 1, n, c, b))
        half = np.zeros((self._width, n, c, b))
        if start is not None:
            d[:-1] = start
            first = {key: slope[:, :1] for key, slope in self._blocks.items()}
            matrix = dense_jacobian(first, (self._width, n, 1, b))[..., 0, :]
            half = start + self._half * np.einsum("pnqmb,qmcb->pncb", matrix, start)
        right_side, share = np.empty_like(half), np.empty((c, b))
        positions = np.empty((times, n, c, b))
        positions[0] = d[0]
        for k in range(1, times):
            right_side[:] = half
            right_side[:width] += self._half * (source[k - 1] + source[k])
            d[:-1, -1] = right_side[:, -1]
            for i in range(n - 2, -1, -1):
                self._solve(d, right_side, i, k, share)
            # d + dt/2 A d for the next step follows from d - dt/2 A d = right_side
            np.multiply(d[:-1], 2.0, out=half)
            half -= right_side
            positions[k] = d[0]
        return positions

    def _solve(
        self, d: np.ndarray, right_side: np.ndarray, i: int, k: int, share: np.ndarray
    ) -> None:
        """Solve for the states of vehicle ``i`` at time ``k`` from those of the vehicles ahead."""
        remainder = right_side[:, i].copy() if self._ahead else right_side[:, i]
        for (p, ahead, q), slope in self._ahead.items():
            if i + ahead < d.shape[1]:
                np.multiply(slope[i, k], d[q, i + ahead], out=share)
                remainder[p] += share
        if not self._inverse:
            d[:-1, i] = remainder
        else:
            d[:-1, i] = 0.0
            for (p, q), inverse in self._inverse.items():
                np.multiply(inverse[i, k], remainder[q], out=share)
                d[p, i] += share
        if self._chained:
            np.subtract(d[0, i], right_side[0, i], out=d[-1, i])
            d[-1, i] /= self._half


def trapezoidal(matrix: np.ndarray, dt: float) -> tuple[Tensor, Tensor]:
    """The trapezoidal rule for d' = A d + s.

    Args:
        matrix: A, ``(K, ..., M, M)``. dt: sampling interval, s.

    Returns:
        Two tensors ``(K - 1, ..., M, M)``: derivatives of the states after an interval by the
        states before it, and by ``dt / 2`` times the sum of s at both ends.
    """
    half, identity = dt / 2 * torch.from_numpy(matrix), torch.eye(matrix.shape[-1]).double()
    after = _inverse(identity - half[1:])
    return after @ (identity + half[:-1]), after


def subdivided(matrix: np.ndarray, dt: float, doublings: int) -> tuple[Tensor, Tensor]:
    """The trapezoidal rule in ``2**doublings`` steps of each sampling interval, in which A is the
    mean of both ends; for states that are faster than samples. See :func:`trapezoidal`."""
    parts = 2**doublings
    mean = torch.from_numpy(matrix[1:] + matrix[:-1]) / 2
    half, identity = dt / parts / 2 * mean, torch.eye(matrix.shape[-1]).double()
    inverse = _inverse(identity - half)
    step, after = inverse @ (identity + half), inverse / parts
    for _ in range(doublings):
        step, after = step @ step, after + step @ after
    return step, after


def _inverse(matrix: Tensor) -> Tensor:
    """Inverse matrices; NaN for singular matrices, as of a model that blows up."""
    inverse, info = torch.linalg.inv_ex(matrix)
    return torch.where(info[..., None, None] == 0, inverse, torch.nan)


def dense_jacobian(blocks: Blocks, shape: tuple[int, ...]) -> np.ndarray:
    """``(M, N, M, N, K, B)`` derivatives of all rates by all states.

    Args:
        shape: shape of the states, ``(M, N, K, B)``.
    """
    m, n = shape[:2]
    matrix = np.zeros((m, n, m, n, *shape[2:]))
    for i in range(n - 2, -1, -1):
        for (p, ahead, q), slope in blocks.items():
            if q == m:
                matrix[p, i] += slope[i] * matrix[0, i + 1]
            elif i + ahead < n:
                matrix[p, i, q, i + ahead] += slope[i]
    return matrix


@cache
def _derivatives(
    lane: LaneDynamics,
) -> tuple[list[tuple[int, str]], Formulas, list[str], Formulas]:
    """Keys and function of the derivatives of rates, and the same for a leader's speed."""
    states = list(lane.rates)
    names = [f"{s}{ahead}" for ahead in ("", "_1", "_2") for s in states] + ["dx_1", *lane.owned]
    slopes = {
        (p, name): node
        for p, rate in enumerate(lane.rates.values())
        for name, node in derivatives(rate, names).items()
    }
    lead = derivatives(lane.leader, list(lane.owned))
    return list(slopes), Formulas(list(slopes.values())), list(lead), Formulas(list(lead.values()))


class LinearResponse:
    """The linear response of a run of a lane model.

    Args:
        system: the model, with the run's parameters.
        batch: the sequences.
        scene: their surroundings, with the step of the run.
        states: ``(K, B, N, M)`` states of the run at the sampling times.

    Attributes:
        rhs: the right-hand side.
    """

    def __init__(self, system: System, batch: Batch, scene: Scene, states: Tensor) -> None:
        self.system, self._batch, self.states = system, batch, states
        self.rhs, self._t = RightHandSide(system, scene), samples(scene, len(states))
        self._y, _ = self.rhs.placed(self._t, arranged(states))
        m, n, *axes = self._y.shape
        self._blocks, self._speed = Blocks(), np.zeros(self._y.shape[1:])
        self._of_parameters = dict[tuple[int, str], np.ndarray]()
        self._of_lead = dict[str, Any]()
        #: derivatives of the added term's rates by the speeds of the formula
        self._by_speed = np.zeros((n, n, *axes))
        self._solver: DenseSolver | FrontToBackSolver
        with np.errstate(all="ignore"):
            if self.rhs.lane is not None:
                self._differentiate(self.rhs.lane)
            if self.rhs.lane is not None and self.rhs.added is None:
                self._solver = FrontToBackSolver(self._blocks, m, batch.dt)
                return
            matrix = self._with_code(dense_jacobian(self._blocks, self._y.shape))
            matrix = matrix.reshape(m * n, m * n, *axes).transpose(2, 3, 0, 1)
            self._solver = DenseSolver(matrix.copy(), m, batch.dt)

    def _differentiate(self, lane: LaneDynamics) -> None:
        """Evaluate the derivatives of the formula along the path."""
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
            if ahead == 2:  # without a second vehicle ahead, its values are those of the first
                near = np.where(rhs.rates.second, 0.0, wide)
                blocks[p, 1, q] = blocks.get((p, 1, q), 0.0) + near
                wide = wide - near
            blocks[p, ahead, q] = blocks.get((p, ahead, q), 0.0) + wide
        if not rhs.measured:
            values = rhs.rates.of_leaders(of_lead, self._y, symbols)
            self._of_lead.update(zip(lead, values, strict=True))

    def _with_code(self, matrix: np.ndarray) -> np.ndarray:
        """Add the derivatives of code to those of the formula, ``(M, N, M, N, K, B)``."""
        rhs = self.rhs
        y, speed = variables = [
            torch.from_numpy(array).clone().requires_grad_() for array in (self._y, self._speed)
        ]
        with torch.enable_grad():
            rates = rhs.by_code(self._t, y, speed)
            sums = [[rate.sum() for rate in every] for every in rates]
        by_formula, coded = matrix[0].copy(), matrix[rhs.coded]
        for p, i in np.ndindex(*coded.shape[:2]):
            if sums[p][i].requires_grad:
                gradients = torch.autograd.grad(
                    sums[p][i], variables, retain_graph=True, allow_unused=True
                )
                for total, part in zip((coded[p, i], self._by_speed[i]), gradients, strict=True):
                    total += 0.0 if part is None else part.numpy()
        matrix[rhs.top] += np.einsum("ijkb,jqmkb->iqmkb", self._by_speed, by_formula)
        return matrix

    @np.errstate(all="ignore")
    def response(self, source: Tensor, start: Tensor | None = None) -> Tensor:
        """``(C, K, B, N)`` m: positions moved by changes of the rates and of the start.

        Args:
            source: ``(C, K, B, N, W)`` changes of the rates of the first W states, m/s for
                positions, such as the columns of effects; for leaders only those that change
                their paths.
            start: ``(C, B, N, M)`` changes of the states at the start; None for 0.
        """
        first = None if start is None else start.permute(3, 2, 0, 1).contiguous().numpy()
        moved = self._solver.response(source.permute(1, 4, 3, 0, 2).contiguous().numpy(), first)
        return torch.from_numpy(moved).permute(2, 0, 3, 1)

    def parameters(self, entries: Sequence[tuple[str, int]]) -> Tensor:
        """``(C, K, B, N)`` m per unit of parameters.

        Args:
            entries: (name in the model, index in the flattened parameter) of each number.
        """
        return self.response(self._sources(entries), self._starts(entries))

    def _sources(self, entries: Sequence[tuple[str, int]]) -> Tensor:
        """``(C, K, B, N, M)`` derivatives of the rates by parameters."""
        rhs, (m, n) = self.rhs, self._y.shape[:2]
        sources = np.zeros((len(entries), *self._y.shape))
        owned = {} if rhs.lane is None else rhs.lane.owned
        for symbol, (name, place, _) in owned.items():
            if (name, place) not in entries:
                continue
            source = sources[entries.index((name, place))]
            for p in range(m):
                source[p, :-1] += self._of_parameters.get((p, symbol), 0.0)
            source[0] += np.where(rhs.is_leader, self._of_lead.get(symbol, 0.0), 0.0)
        for i in range(n - 2, -1, -1):
            for (p, _, q), slope in self._blocks.items():
                if q == m:
                    sources[:, p, i] += slope[i] * sources[:, 0, i + 1]
        sources[:, rhs.top] += np.einsum("ijkb,cjkb->cikb", self._by_speed, sources[:, 0])
        code = rhs.lane is None or rhs.added is not None
        y, speed = torch.from_numpy(self._y), torch.from_numpy(self._speed)
        for source, (name, place) in zip(sources, entries, strict=True):
            if code and name.startswith(rhs.code_prefix):
                rates = self._along(name, place, partial(rhs.by_code, self._t, y, speed))
                source[rhs.coded] += rates.numpy()
        return torch.from_numpy(sources).permute(0, 3, 4, 2, 1)

    def _starts(self, entries: Sequence[tuple[str, int]]) -> Tensor | None:
        """``(C, B, N, M)`` derivatives of the states at the start; None if these are measured."""
        if self.states.shape[-1] == self.system.order:
            return None

        def start(parameters: dict[str, Tensor]) -> Tensor:
            return with_parameters(self.system, parameters).initial(self._batch)

        return torch.stack([self._along(name, place, start) for name, place in entries])

    def _along(
        self, name: str, place: int, function: Callable[[dict[str, Tensor]], Tensor]
    ) -> Tensor:
        """The derivative of a function by one entry of a parameter."""
        value = self.system.get_parameter(name).detach()
        change = torch.zeros(value.numel(), dtype=value.dtype)
        change[place] = 1.0
        with torch.no_grad(), forward_ad.dual_level():
            value_at = function({name: forward_ad.make_dual(value, change.reshape(value.shape))})
            tangent: Tensor | None = forward_ad.unpack_dual(value_at).tangent
        return torch.zeros_like(value_at) if tangent is None else tangent

    def rates(self, system: System) -> Tensor:
        """``(K, B, N, M)`` rates of another model along the path."""
        return rates_along(system, self.rhs.scene, self.states)

    def state(self) -> State:
        """Arguments of terms along the path, see :meth:`RightHandSide.state`."""
        return self.rhs.state(self._t, self._y)
