"""Calibration as a least-squares problem with derivatives."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
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

#: Relative size of central differences for laws, in float64: the cube root of the precision, where
#: rounding and truncation errors are equal (Press et al. 2007, section 5.7); and the smallest
#: parameter that the size is relative to, in the parameter's unit.
_CENTRAL = float(np.finfo(np.float64).eps) ** (1 / 3), 0.01
#: The same for forward differences of networks, by precision. Networks have tens of weights and
#: tolerate less accurate derivatives.
_FORWARD = {torch.float32: (1e-3, 0.1), torch.float64: (1e-6, 0.1)}
#: For first speeds: difference, m/s; largest number of steps of a fit; its tolerance.
_SPEED, _TURNS, _SETTLED = 1e-5, 10, 1e-12
#: Range of the random factors on start values of bounded parameters.
FACTORS = (0.5, 2.0)
#: Numbers of samples of the first horizons, and the largest number of steps at each horizon.
_HORIZONS, _SHORT = tuple(4 * 2**k for k in range(30)), 8


class ResidualProblem:
    """The weighted residuals of a model on the sequences of a batch.

    Costs, gradients and curvatures are those of each sequence. Pooled calibrations minimise their
    sum, separate calibrations each of them, and confidence intervals use their variation between
    clusters.

    Derivatives are exact tangents for lanes, and difference quotients for people, in float64 if
    the model is a formula without networks. The gradient of ``model=sf`` agrees to nine digits
    with PyTorch's forward mode and takes a fortieth of its time.

    Fitted first speeds are non-negative parameters of each sequence, for all simulated vehicles.
    Costs are minimised over them (profile likelihood).

    Args:
        system: the model, which is not changed. Parameters that need no gradient keep its values.
        batch: the sequences.
        solver: gives step, method and threads.
        convention: the cost.
        start_speeds: whether first speeds are fitted.

    Attributes:
        vector: the calibrated parameters.
        names: their P addresses, ``idm.T``.
        physical: ``(P,)`` False for the weights of networks.
        start, low, high: ``(P,)`` the system's values, and the bounds of the admissible set.
        simulations: number of simulations, without those of tangents.
        last_speeds: ``(B, N)`` start values (m/s) of the next fit of first speeds.

    Raises:
        ConfigError: a lane model is not a formula; or first speeds are fitted for people, or for a
            law of first order, which has none.

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
        self.lane = None if isinstance(system, Crowd) else lanes.supports(system, batch)
        formula = system.formula if isinstance(system, Crowd) else self.lane
        if formula is None and not isinstance(system, Crowd):
            raise ConfigError(
                "optimizer=gauss_newton needs a model of a lane whose law and effects are "
                "formulas; take another optimizer"
            )
        vector = ParameterVector(system)
        if formula is None:
            candidates = [
                (f"{name}.{i}", (name, k, 0)) for i, (name, k) in enumerate(vector.places)
            ]
        else:
            candidates = [(s.replace("__", ".", 1), place) for s, place in formula.owned.items()]
        calibrated = [(name, at) for name, at in candidates if at[0] in vector.parameters]
        self.names = [name for name, _ in calibrated]
        self.physical = np.array([axes is None for _, (_, _, axes) in calibrated], dtype=bool)
        if self.lane is None:
            system = copy.deepcopy(system)
            if self.physical.all():
                system, batch = system.double(), batch.to(None, torch.float64)
        self.system, self.batch = system, batch
        self.vector = ParameterVector(system, [at[:2] for _, at in calibrated])
        self.low, self.high = self.vector.bounds
        self.start = np.clip(self.vector.row.numpy(), self.low, self.high)
        self.fitted: np.ndarray | None = None
        if start_speeds is StartSpeeds.fitted:
            self._prepare_start_speeds()

    def _prepare_start_speeds(self) -> None:
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
        """``(B,)`` costs for parameters ``(P,)``, or, for lanes, for separate parameters of every
        sequence ``(B, P)``."""
        if self.fitted is not None:
            return np.asarray(self._fit_start_speeds(rows).cost)
        return self._cost(*self._paths(rows)[:2])

    def __call__(self, rows: np.ndarray) -> Quadratic:
        """Costs and their derivatives for parameters as in :meth:`costs`."""
        if self.fitted is None:
            return self._quadratic(*self.linearised(rows))
        self.last_speeds = start = self._fit_start_speeds(rows).row
        cost, deviation, slope = self.linearised(rows, start)
        slopes = torch.cat([slope, self._by_start(rows, start, deviation)])
        return self._quadratic(cost, deviation, slopes).profiled(len(slope))

    def start_speeds(self, rows: np.ndarray) -> dict[str, list[float]]:
        """Sequence's name to the vehicles' fitted first speeds (m/s); empty if they are given."""
        if self.fitted is None:
            return {}
        self.last_speeds = self._fit_start_speeds(rows).row
        speeds, agents = self.last_speeds.tolist(), self.batch.agent.sum(1).tolist()
        return {name: v[:n] for name, v, n in zip(self.batch.names, speeds, agents, strict=True)}

    def raise_blow_up(self, cost: np.ndarray) -> None:
        """Report the sequences that cannot be simulated.

        Raises:
            SimulationError: always.
        """
        bad = [name for name, c in zip(self.batch.names, cost, strict=True) if not np.isfinite(c)]
        raise SimulationError(
            f"the simulation of {', '.join(bad[:5])} blew up; check the sequences, start from "
            "other parameters, or take a smaller solver.dt"
        )

    def initial_fit(
        self, row: np.ndarray, horizons: Sequence[int] = _HORIZONS, **options: Any
    ) -> np.ndarray:
        """A better start for people, from fits to the first samples with a growing horizon.

        Within a second, strong forces move people by metres, and the cost has many minima. For few
        samples nearly every start leads to the same minimum.

        Args:
            horizons: numbers of samples.
            options: options of :func:`pooled`.
        """
        if self.lane is not None:
            return row
        best, sampled = row, ("x", "v", "valid")
        for samples in horizons:
            if samples >= self.batch.n_samples:
                break
            batch = replace(self.batch, **{k: getattr(self.batch, k)[:samples] for k in sampled})
            short = ResidualProblem(self.system, batch, self.solver, self.convention)
            if np.isfinite(short.costs(best)).all():
                best = pooled(short, best, **{"steps": _SHORT, **options}).row
            self.simulations += short.simulations
        before, after = (float(self.costs(candidate).mean()) for candidate in (row, best))
        return best if after < before else row

    # -- first speeds ----------------------------------------------------------------------------

    def _fit_start_speeds(self, rows: np.ndarray) -> Minimum:
        """The best first speeds ``(B, N)`` of every sequence for given parameters.

        The fit starts at the better of the last first speeds and the measured ones. The last ones
        belong to other parameters and may be too far from the minimum.
        """
        assert self.fitted is not None
        best = np.full(len(self.batch), math.inf)
        deviation = torch.zeros(0)

        def costs(trials: np.ndarray) -> np.ndarray:
            """Costs of a trial. Side effect: ``deviation`` has the errors of the best speeds."""
            nonlocal deviation, best
            (start,) = trials
            x, v, *_ = self._paths(rows, start)
            cost, trial_deviation = self._cost(x, v), errors(x, v, self.batch, self.convention)[0]
            better = torch.from_numpy(cost < best)[:, None]
            deviation = (
                torch.where(better, trial_deviation, deviation)
                if len(deviation)
                else trial_deviation
            )
            best = np.minimum(cost, best)
            return cost[None]

        def quadratic(start: np.ndarray) -> Quadratic:
            return self._quadratic(best, deviation, self._by_start(rows, start, deviation))

        given, last = costs(self._given[None])[0], costs(self.last_speeds[None])[0]
        start = np.where((last < given)[:, None], self.last_speeds, self._given)
        low = np.where(self.fitted, 0.0, self._given)
        high = np.where(self.fitted, math.inf, self._given)
        return least_squares(quadratic, costs, start, low, high, steps=_TURNS, tolerance=_SETTLED)

    def _by_start(self, rows: np.ndarray, start: np.ndarray, deviation: Tensor) -> Tensor:
        """``(N, K, B, ...)`` derivatives of errors by the first speed of every vehicle."""
        assert self.fitted is not None
        derivatives = torch.zeros(start.shape[1], *deviation.shape, dtype=torch.float64)
        for i in np.flatnonzero(self.fitted.any(0)):
            other = start.copy()
            other[:, i] += _SPEED * self.fitted[:, i]
            x, v, *_ = self._paths(rows, other)
            derivatives[i] = (errors(x, v, self.batch, self.convention)[0] - deviation) / _SPEED
        return torch.nan_to_num(derivatives)

    # -- simulations -----------------------------------------------------------------------------

    def _paths(
        self, rows: np.ndarray, start: np.ndarray | None = None, slopes: bool = False
    ) -> tuple[Tensor, Tensor | None, Tensor, Tensor | None]:
        """Coordinates ``(K, B, N D)``, speeds, and their derivatives ``(P, K, B, N D)``.

        Args:
            start: ``(B, N)`` first speeds, m/s; None takes the measured ones.
            slopes: whether derivatives are computed; otherwise P is 0.
        """
        if self.lane is None:
            x = self._positions(rows)
            derivatives = [self._difference(rows, x, i) for i in range(len(rows))] if slopes else []
            return x, None, torch.stack(derivatives) if derivatives else x.new_zeros(0), None
        batch, system, solver = self.batch, cast(Traffic, self.system), self.solver
        if start is not None:
            v = batch.v.clone()
            v[0, ..., 0] = torch.from_numpy(start)
            batch = replace(batch, v=v)
        n = substeps(batch.dt, solver.dt, system)
        local, origin = simulated_batch(system, batch)
        symbols = tuple(name.replace(".", "__", 1) for name in self.names)
        y, dy = lanes.tangents(
            system,
            self.lane,
            local,
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
        """``(K, B, N D)`` difference quotient by the i-th parameter inside the admissible set; 0
        if a simulation blows up."""
        central = self.physical.all()
        relative, min_size = _CENTRAL if central else _FORWARD[self.batch.dtype]
        step = relative * max(abs(row[i]), min_size)

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

        For costs of followers the shapes are ``(K, B, N - 1)`` and ``(P, K, B, N - 1)``.
        """
        x, v, slope, dv = self._paths(rows, start, slopes=True)
        deviation, counted = errors(x, v, self.batch, self.convention)
        if self.convention is Convention.speed:
            assert dv is not None
            slope = dv[..., :-1]
        elif self.convention in FOLLOWING:
            gap, measured = (net_gaps(p, self.batch) for p in (x, self.batch.x[..., 0]))
            with torch.enable_grad():
                gap_variable = gap.detach().requires_grad_()
                change = changed_gap(gap_variable, measured, self.convention)
                (factor,) = torch.autograd.grad(change.sum(), gap_variable)
            slope = torch.diff(slope) * factor
        return self._cost(x, v), deviation.double(), torch.where(counted, slope, 0.0).double()

    def _quadratic(self, cost: np.ndarray, deviation: Tensor, slope: Tensor) -> Quadratic:
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
        gradient = torch.einsum("kbn,pkbn->bp", deviation, slope).numpy()
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


def pooled(
    problem: ResidualProblem,
    start: np.ndarray | None = None,
    weights: np.ndarray | None = None,
    **options: Any,
) -> Minimum:
    """The parameters ``(P,)`` that minimise the weighted mean of the sequences' costs.

    Args:
        weights: ``(B,)`` of sum 1; None takes equal weights.
        options: options of :func:`~nnode.calibrate.least_squares.least_squares`.
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
    minimum = least_squares(quadratic, costs, begin, problem.low, problem.high, **options)
    return replace(minimum, row=minimum.row[0], cost=minimum.cost[0])


def random_starts(problem: ResidualProblem, rows: Iterable[np.ndarray], seed: int) -> np.ndarray:
    """``(R, P)`` starts: the first row, then rows with random factors on bounded parameters."""
    rng, (shrink, stretch) = np.random.default_rng(seed), np.log(FACTORS)
    limited = np.isfinite(problem.low) & np.isfinite(problem.high)
    starts = []
    for i, row in enumerate(rows):
        if i:
            factor = np.exp(rng.uniform(shrink, stretch, len(row)))
            row = np.where(limited, row * factor, row)
        starts.append(np.clip(row, problem.low, problem.high))
    return np.stack(starts)


def separate(
    problem: ResidualProblem, starts: Iterable[np.ndarray], **options: Any
) -> tuple[np.ndarray, np.ndarray]:
    """The parameters ``(B, P)`` that minimise the cost of every sequence separately, the best of
    several starts.

    Args:
        starts: ``(P,)`` or ``(B, P)`` each.
        options: options of :func:`~nnode.calibrate.least_squares.least_squares`.

    Returns:
        The parameters, and the costs ``(B,)`` with the penalty.
    """
    fits = [
        least_squares(
            problem,
            lambda trials: np.stack([problem.costs(rows) for rows in trials]),
            np.broadcast_to(start, (len(problem.batch), len(problem.names))),
            problem.low,
            problem.high,
            **{"tolerance": 1e-8, **options},
        )
        for start in starts
    ]
    costs, rows = np.array([fit.cost for fit in fits]), np.array([fit.row for fit in fits])
    return rows[costs.argmin(0), np.arange(costs.shape[1])], costs.min(0)
