"""What a calibration minimises, as a problem of least squares with derivatives."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.cost import (
    FOLLOWING,
    Convention,
    changed_gap,
    errors,
    net_gaps,
    sequence_costs,
)
from nnode.calibrate.least_squares import Minimum, Quadratic, least_squares
from nnode.calibrate.options import StartSpeeds
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch
from nnode.errors import ConfigError, SimulationError
from nnode.model.system import Crowd, System, Traffic
from nnode.simulation.base import Trajectory, simulated_batch, substeps
from nnode.simulation.fused import FusedSolver
from nnode.simulation.kernels import lanes

#: Relative size of central differences of laws, in float64: the cube root of its precision, where
#: the errors by rounding and by curvature are equal (Press et al. 2007, section 5.7). Parameters
#: smaller than the second number are varied as if they had this size, in their own units.
_CENTRAL = float(np.finfo(np.float64).eps) ** (1 / 3), 0.01
#: The same of forward differences of networks, by precision: they have tens of weights, and bear
#: the errors.
_FORWARD = {torch.float32: (1e-3, 0.1), torch.float64: (1e-6, 0.1)}
#: Difference of first speeds, m/s; steps of their fits at most, and the share of the cost below
#: which a fall ends them.
_SPEED, _TURNS, _SETTLED = 1e-5, 10, 1e-12
#: Samples of the first horizons: each doubles the one before. Steps at each of them at most.
_HORIZONS, _SHORT = tuple(4 * 2**k for k in range(30)), 8


class ResidualProblem:
    """The weighted residuals of a model on the sequences of a batch.

    Costs, gradients and curvatures are those of each sequence by itself: pooled calibrations add
    them up, calibrations of every sequence alone do not, and their spread between clusters tells
    how sure the pooled ones are.

    Derivatives of lanes are exact tangents. Those of people are differences, in float64 where the
    model is a formula without networks: compared with forward-mode derivatives by PyTorch, the
    gradient of ``model=sf`` agrees to nine digits in a fortieth of the time.

    First speeds that are fitted are parameters of each sequence, at least 0, of all vehicles that
    the model drives. Costs are the least over them, for any other parameters.

    Args:
        system: the model; it is not changed. Parameters that need no gradient stay its own.
        batch: the sequences.
        solver: its step, method and threads.
        convention: what is minimised.
        start_speeds: whether first speeds are fitted.

    Attributes:
        vector: the parameters that are calibrated.
        names: their P addresses, ``idm.T``.
        physical: ``(P,)`` False for the weights of networks.
        start, low, high: ``(P,)`` the system's own values, and the admissible set.
        simulations: how many there were, without those of tangents.
        last_speeds: ``(B, N)`` the first speeds (m/s) from which the next search for the best ones
            goes on.

    Raises:
        ConfigError: vehicles whose model is no formula; first speeds of people, or of a law of
            first order, which has none.

    Source:
        Murphy & van der Vaart 2000, profile likelihood.
    """

    def __init__(
        self,
        system: System,
        batch: Batch,
        solver: FusedSolver,
        convention: Convention = Convention.integral,
        start_speeds: StartSpeeds = StartSpeeds.given,
    ) -> None:
        self.solver, self.convention, self.simulations = solver, convention, 0
        self.lane = None if system.domain == "crowd" else _lane(system, batch)
        formula = system.formula if isinstance(system, Crowd) else self.lane
        vector = ParameterVector(system)
        if formula is None:
            every = [(f"{name}.{i}", (name, k, 0)) for i, (name, k) in enumerate(vector.places)]
        else:
            every = [(s.replace("__", ".", 1), place) for s, place in formula.owned.items()]
        own = [(name, at) for name, at in every if at[0] in vector.parameters]
        self.names = [name for name, _ in own]
        self.physical = np.array([axes is None for _, (_, _, axes) in own], dtype=bool)
        if self.lane is None:
            system = copy.deepcopy(system)
            if self.physical.all():
                system, batch = system.double(), batch.to(None, torch.float64)
        self.system, self.batch = system, batch
        self.vector = ParameterVector(system, [at[:2] for _, at in own])
        self.low, self.high = self.vector.bounds
        self.start = np.clip(self.vector.row.numpy(), self.low, self.high)
        self.fitted: np.ndarray | None = None
        if start_speeds is StartSpeeds.fitted:
            self._fit_speeds()

    def _fit_speeds(self) -> None:
        if self.lane is None:
            raise ConfigError(
                "trainer.start_speeds=fitted is for vehicles in lanes; take "
                "trainer.start_speeds=given for people"
            )
        if self.lane.order < 2:
            raise ConfigError(
                "trainer.start_speeds=fitted needs a law of second order: one of first order has "
                "no speed to start with; take trainer.start_speeds=given"
            )
        given = self.system.given(self.batch)
        driven = self.batch.agent if given is None else self.batch.agent & ~given
        self.fitted, self._given = driven.numpy(), self.batch.v[0, ..., 0].double().numpy()
        self.last_speeds = self._given

    # -- costs and derivatives of every sequence -------------------------------------------------

    def costs(self, rows: np.ndarray) -> np.ndarray:
        """``(B,)`` costs for parameters ``(P,)``, or, of lanes, for those of every sequence
        ``(B, P)``."""
        if self.fitted is not None:
            return np.asarray(self._settled(rows).cost)
        return self._cost(*self._paths(rows)[:2])

    def __call__(self, rows: np.ndarray) -> Quadratic:
        """Costs and their derivatives, of parameters as in :meth:`costs`."""
        if self.fitted is None:
            return self._quadratic(*self.linearised(rows))
        self.last_speeds = start = self._settled(rows).row
        cost, away, slope = self.linearised(rows, start)
        both = torch.cat([slope, self._by_start(rows, start, away)])
        return self._quadratic(cost, away, both).profiled(len(slope))

    def start_speeds(self, rows: np.ndarray) -> dict[str, list[float]]:
        """First speeds (m/s) that are best for parameters, by sequence and vehicle; none where
        they are given."""
        if self.fitted is None:
            return {}
        self.last_speeds = self._settled(rows).row
        found, agents = self.last_speeds.tolist(), self.batch.agent.sum(1).tolist()
        return {name: v[:n] for name, v, n in zip(self.batch.names, found, agents, strict=True)}

    def complain(self, cost: np.ndarray) -> None:
        """Say which sequences cannot be simulated.

        Raises:
            SimulationError: always.
        """
        bad = [name for name, c in zip(self.batch.names, cost, strict=True) if not np.isfinite(c)]
        raise SimulationError(
            f"the simulation of {', '.join(bad[:5])} blew up; check the sequences, start from "
            "other parameters, or take a smaller solver.dt"
        )

    def begin(
        self, row: np.ndarray, horizons: Sequence[int] = _HORIZONS, **options: Any
    ) -> np.ndarray:
        """A better start for people: the minimum of the first samples of every sequence, followed
        as the horizon grows.

        Over a second, strong forces throw people metres away, and the cost has many minima. Over
        few samples nearly every start leads to the same one.

        Args:
            horizons: numbers of samples.
            options: of :func:`pooled`.
        """
        if self.lane is not None:
            return row
        found, timed = row, ("x", "v", "valid")
        for samples in horizons:
            if samples >= self.batch.n_samples:
                break
            batch = replace(self.batch, **{k: getattr(self.batch, k)[:samples] for k in timed})
            short = ResidualProblem(self.system, batch, self.solver, self.convention)
            if np.isfinite(short.costs(found)).all():
                found = pooled(short, found, **{"steps": _SHORT, **options}).row
            self.simulations += short.simulations
        before, after = (float(self.costs(one).mean()) for one in (row, found))
        return found if after < before else row

    # -- first speeds ----------------------------------------------------------------------------

    def _settled(self, rows: np.ndarray) -> Minimum:
        """The best first speeds ``(B, N)`` of every sequence for parameters.

        The search begins at the better of the last ones and of those that were given: speeds that
        other parameters asked for may be far from the best, where no step helps.
        """
        assert self.fitted is not None
        best = np.full(len(self.batch), math.inf)
        away = torch.zeros(0)

        def costs(trials: np.ndarray) -> np.ndarray:
            """They leave the errors of the best speeds, which the search goes on from."""
            nonlocal away, best
            (start,) = trials
            x, v, *_ = self._paths(rows, start)
            cost, new = self._cost(x, v), errors(x, v, self.batch, self.convention)[0]
            better = torch.from_numpy(cost < best)[:, None]
            away = torch.where(better, new, away) if len(away) else new
            best = np.minimum(cost, best)
            return cost[None]

        def quadratic(start: np.ndarray) -> Quadratic:
            return self._quadratic(best, away, self._by_start(rows, start, away))

        given, last = costs(self._given[None])[0], costs(self.last_speeds[None])[0]
        start = np.where((last < given)[:, None], self.last_speeds, self._given)
        low = np.where(self.fitted, 0.0, self._given)
        high = np.where(self.fitted, math.inf, self._given)
        return least_squares(quadratic, costs, start, low, high, steps=_TURNS, tolerance=_SETTLED)

    def _by_start(self, rows: np.ndarray, start: np.ndarray, away: Tensor) -> Tensor:
        """``(N, K, B, ...)`` derivatives of errors by the first speed of every vehicle."""
        assert self.fitted is not None
        found = torch.zeros(start.shape[1], *away.shape, dtype=torch.float64)
        for i in np.flatnonzero(self.fitted.any(0)):
            other = start.copy()
            other[:, i] += _SPEED * self.fitted[:, i]
            x, v, *_ = self._paths(rows, other)
            found[i] = (errors(x, v, self.batch, self.convention)[0] - away) / _SPEED
        return torch.nan_to_num(found)

    # -- simulations -----------------------------------------------------------------------------

    def _paths(
        self, rows: np.ndarray, start: np.ndarray | None = None, slopes: bool = False
    ) -> tuple[Tensor, Tensor | None, Tensor, Tensor | None]:
        """Coordinates ``(K, B, N D)`` and speeds, and their derivatives ``(P, K, B, N D)`` where
        these are asked for.

        Args:
            start: ``(B, N)`` first speeds, m/s; None: those that are given.
        """
        if self.lane is None:
            x = self._positions(rows)
            found = [self._difference(rows, x, i) for i in range(len(rows))] if slopes else []
            return x, None, torch.stack(found) if found else x.new_zeros(0), None
        batch, system, solver = self.batch, cast(Traffic, self.system), self.solver
        if start is not None:
            v = batch.v.clone()
            v[0, ..., 0] = torch.from_numpy(start)
            batch = replace(batch, v=v)
        n = substeps(batch.dt, solver.dt, system)
        near, origin = simulated_batch(system, batch)
        symbols = tuple(name.replace(".", "__", 1) for name in self.names)
        y, dy = lanes.tangents(
            system,
            self.lane,
            near,
            n,
            symbols if slopes else (),
            solver.threads,
            torch.from_numpy(np.atleast_2d(rows)),
            solver.method,
            given=symbols,
        )
        x = y[..., 0] if origin is None else y[..., 0].double() + origin
        given = system.given(batch)
        if given is not None:
            x = torch.where(given, batch.x[..., 0], x)
        second = self.lane.order > 1
        return x, y[..., 1] if second else None, dy[..., 0], dy[..., 1] if second else None

    @torch.no_grad()
    def _positions(self, row: np.ndarray) -> Tensor:
        self.simulations += 1
        return self.solver.unchecked(self.vector.fill_(row), self.batch).x.flatten(-2)

    def _difference(self, row: np.ndarray, x: Tensor, i: int) -> Tensor:
        """``(K, B, N D)`` derivative by the i-th parameter, inside the admissible set; 0 where a
        simulation blows up."""
        central = self.physical.all()
        relative, least = _CENTRAL if central else _FORWARD[self.batch.dtype]
        step = relative * max(abs(row[i]), least)

        def at(number: int) -> Tensor:
            other = row.copy()
            other[i] += number * step
            return self._positions(other)

        above = row[i] + step > self.high[i]
        if not central:
            change = 2 * (x - at(-1)) if above else 2 * (at(1) - x)
        elif above:
            change = 3 * x - 4 * at(-1) + at(-2)
        elif row[i] - step < self.low[i]:
            change = 4 * at(1) - at(2) - 3 * x
        else:
            change = at(1) - at(-1)
        return torch.nan_to_num(change / (2 * step), posinf=0.0, neginf=0.0)

    # -- from paths to costs ---------------------------------------------------------------------

    def linearised(
        self, rows: np.ndarray, start: np.ndarray | None = None
    ) -> tuple[np.ndarray, Tensor, Tensor]:
        """Costs ``(B,)``, errors ``(K, B, N D)`` and their derivatives ``(P, K, B, N D)``.

        Of followers, ``(K, B, N - 1)`` and ``(P, K, B, N - 1)``.
        """
        x, v, slope, dv = self._paths(rows, start, slopes=True)
        away, seen = errors(x, v, self.batch, self.convention)
        if self.convention is Convention.speed:
            assert dv is not None
            slope = dv[..., :-1]
        elif self.convention in FOLLOWING:
            gap, measured = (net_gaps(p, self.batch) for p in (x, self.batch.x[..., 0]))
            with torch.enable_grad():
                own = gap.detach().requires_grad_()
                change = changed_gap(own, measured, self.convention)
                (factor,) = torch.autograd.grad(change.sum(), own)
            slope = torch.diff(slope) * factor
        return self._cost(x, v), away.double(), torch.where(seen, slope, 0.0).double()

    def _quadratic(self, cost: np.ndarray, away: Tensor, slope: Tensor) -> Quadratic:
        number = self.batch.valid[1:, :, 1:].sum((0, -1)).clamp(min=1).numpy()
        match self.convention:
            case Convention.integral:
                scale = np.full(len(cost), self.batch.dt)
            case Convention.sum:
                scale = np.ones(len(cost))
            case Convention.spacing:
                scale = 1 / (number * np.maximum(cost, 1e-12))
            case _:
                scale = 2 / number
        scale = np.where(np.isfinite(cost), scale, 0.0)
        gradient = torch.einsum("kbn,pkbn->bp", away, slope).numpy()
        hessian = torch.einsum("pkbn,qkbn->bpq", slope, slope).numpy()
        return Quadratic(
            cost,
            np.nan_to_num(gradient * scale[:, None]),
            np.nan_to_num(hessian * scale[:, None, None]),
        )

    def _cost(self, x: Tensor, v: Tensor | None) -> np.ndarray:
        batch = self.batch
        run = Trajectory(x.reshape(batch.x.shape), None if v is None else v[..., None])
        cost = sequence_costs(run, batch, self.convention)
        return torch.where(torch.isfinite(cost), cost, math.inf).numpy()


def _lane(system: System, batch: Batch) -> Any:
    lane = lanes.supports(system, batch)
    if lane is None:
        raise ConfigError(
            "optimizer=gauss_newton needs a model of a lane whose law and effects are formulas; "
            "take another optimizer"
        )
    return lane


def pooled(
    problem: ResidualProblem,
    start: np.ndarray | None = None,
    weights: np.ndarray | None = None,
    **options: Any,
) -> Minimum:
    """The parameters ``(P,)`` that are best for all sequences together.

    Args:
        weights: ``(B,)`` of sum 1; None takes the mean.
        options: of :func:`~nnode.calibrate.least_squares.least_squares`.
    """
    number = len(problem.batch)
    share = np.full(number, 1 / number) if weights is None else weights
    used = share > 0  # a sequence without weight may blow up

    def quadratic(rows: np.ndarray) -> Quadratic:
        each = problem(rows[0])
        parts = each.cost, each.gradient, each.hessian
        return Quadratic(*(np.tensordot(share[used], part[used], 1)[None] for part in parts))

    def costs(trials: np.ndarray) -> np.ndarray:
        return np.array([share[used] @ problem.costs(row)[used] for (row,) in trials])[:, None]

    begin = (problem.start if start is None else start)[None]
    found = least_squares(quadratic, costs, begin, problem.low, problem.high, **options)
    return replace(found, row=found.row[0], cost=found.cost[0])


def alone(problem: ResidualProblem, start: np.ndarray | None = None, **options: Any) -> Minimum:
    """The parameters ``(B, P)`` that are best for every sequence by itself, side by side.

    Args:
        start: ``(P,)`` or ``(B, P)``.
        options: of :func:`~nnode.calibrate.least_squares.least_squares`.
    """
    begin = problem.start if start is None else start
    return least_squares(
        problem,
        lambda trials: np.stack([problem.costs(rows) for rows in trials]),
        np.broadcast_to(begin, (len(problem.batch), len(problem.names))),
        problem.low,
        problem.high,
        **{"tolerance": 1e-8, **options},
    )
