"""From what another program simulated to the parameters that were typed into it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize

from nnode.calibrate.least_squares import Minimum
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import Crowd, Traffic
from nnode.model.laws import law_from
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver

#: The searches start this share away from every parameter: up and down in turns, all up, all down.
AWAY = 0.3
#: Half an interval of 95 %, in standard errors.
NORMAL = 1.96
#: A parameter whose interval is wider to one side than this share of it is not identified.
WIDE = 0.1
#: m: what rounding in the other program's files may do. Searches that end this close to the best
#: one are equally good, and a parameter on which they disagree is not identified.
ROUNDED = 1e-9
#: Estimates that are correlated by more than this are hard to tell apart.
TIED = 0.95


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """One law of another program, calibrated to its output.

    Attributes:
        names: K parameters.
        typed, found: ``(K,)`` what was typed in, and where the search ended.
        measured: ``(K,)`` where it ends if positions have independent normal errors of ``error``.
        half: ``(K,)`` half the 95 % interval around ``measured``, by its residuals; infinite where
            nothing depends on the parameter.
        error: m.
        tied: pairs of names whose estimates are correlated by more than 0.95, and by how much.
        forward, worst: root mean square and largest difference of a coordinate, m, with the typed
            parameters.
        path: root mean square with those found.
        simulations: how many with derivatives the search took.
    """

    names: tuple[str, ...]
    typed: np.ndarray
    found: np.ndarray
    measured: np.ndarray
    half: np.ndarray
    error: float
    tied: tuple[tuple[str, str, float], ...]
    forward: float
    worst: float
    path: float
    simulations: int

    @property
    def identified(self) -> np.ndarray:
        """``(K,)`` whether the interval is narrow."""
        return np.asarray(self.half < WIDE * np.abs(self.measured))

    @property
    def off(self) -> np.ndarray:
        """``(K,)`` relative errors without any error of measurement."""
        return np.asarray(np.abs(self.found - self.typed) / np.abs(self.typed))

    @property
    def score(self) -> np.ndarray:
        """``(K,)`` errors of ``measured`` in standard errors."""
        return np.asarray((self.measured - self.typed) / (self.half / NORMAL))


def recover(
    law: Mapping[str, Any],
    typed: Mapping[str, float],
    sequences: list[Sequence],
    *,
    dt: float,
    method: str | None = None,
    error: float = 0.1,
    seed: int = 0,
) -> Recovered:
    """Calibrate a law to another program's paths from starts that are off in every parameter.

    Args:
        law: its description; leaders of lanes drive as they did.
        typed: parameter of the law to what was typed into the other program, SI units. Others
            keep the values of the description.
        dt: step, s.
        method: of lanes; see :data:`nnode.model.steps.METHODS`.
        error: of measured positions, m. The first state and the leader keep theirs, so that the
            errors are independent and the intervals those of the textbook.
        seed: of these errors.
    """
    batch = collate(sequences)
    system = _system(law, typed, batch.x.shape[-1])
    solver = FusedSolver(dt=dt, method=method)
    problem = ResidualProblem(system, batch, solver)
    names = tuple(name.rpartition(".")[2] for name in problem.names)
    truth = problem.vector.row.numpy()
    moves = _moving(system, batch)
    exact = _metres(problem, truth)[0][moves]
    turns, one = (-1.0) ** np.arange(len(truth)), np.ones(len(truth))
    # a limit on speed or acceleration that is nowhere reached changes nothing: of these starts
    # some lie below each
    starts = [truth * (1 + AWAY * way) for way in (turns, -turns, one, -one)]
    ends = [_best(problem, start) for start in starts]
    paths = [np.sqrt((_metres(problem, end.row)[0] ** 2).sum() / moves.sum()) for end in ends]
    best = ends[int(np.argmin(paths))]
    alike = np.array(
        [end.row for end, path in zip(ends, paths, strict=True) if path < min(paths) + ROUNDED]
    )
    agreed = np.ptp(alike, axis=0) < WIDE * np.abs(truth)
    noise, later = np.zeros(batch.x.shape), batch.valid.numpy().copy()
    later[0] = False
    noise[later] = np.random.default_rng(seed).standard_normal((later.sum(), batch.x.shape[-1]))
    noise *= error * moves.reshape(noise.shape)
    measured = replace(batch, x=batch.x - torch.from_numpy(noise))
    noisy = ResidualProblem(system, measured, solver)
    again = min((_best(noisy, start) for start in starts), key=lambda end: float(end.cost))
    count = int(moves.sum())
    left, slopes = _metres(noisy, again.row)
    unit, tied = _spread(slopes[moves], names)
    return Recovered(
        names=names,
        typed=truth,
        found=best.row,
        measured=again.row,
        half=np.where(
            agreed, NORMAL * np.sqrt((left**2).sum() / (count - len(truth))) * unit, np.inf
        ),
        error=error,
        tied=tied,
        forward=float(np.sqrt((exact**2).sum() / count)),
        worst=float(np.abs(exact).max()),
        path=float(min(paths)),
        simulations=sum(end.steps for end in ends),
    )


def _system(law: Mapping[str, Any], typed: Mapping[str, float], dim: int) -> System:
    term = law_from("law", law)
    system: System = Traffic([term], leader="measured") if dim == 1 else Crowd([term])
    system.double()
    with torch.no_grad():
        for name, value in typed.items():
            getattr(term, name).fill_(value)
    for name, parameter in term.named_parameters():
        parameter.requires_grad_(name in typed)
    return system


def _metres(problem: ResidualProblem, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(M,)`` differences of coordinates, m, and their ``(M, K)`` derivatives."""
    _, away, slope = problem.linearised(row)
    return away.numpy().ravel(), slope.flatten(1).T.numpy()


def _moving(system: System, batch: Batch) -> np.ndarray:
    """``(M,)`` which of them are of agents that the model moves, after the first sample."""
    given = system.given(batch)
    moves = batch.valid.clone() if given is None else batch.valid & ~given
    moves[0] = False
    return moves[..., None].expand(batch.x.shape).flatten().numpy()


def _best(problem: ResidualProblem, start: np.ndarray) -> Minimum:
    """Where the search ends.

    Paths of people have jumps in the parameters, where someone else comes nearest: derivatives lead
    close to a minimum, and a search without them ends in it.
    """
    first = pooled(problem, problem.initial_fit(start), steps=60, tolerance=1e-9)
    by_simplex = minimize(
        lambda share: float(problem.costs(first.row * share).mean()),
        np.ones(len(start)),
        method="Nelder-Mead",
        bounds=list(zip(problem.low / first.row, problem.high / first.row, strict=True)),
        options={
            "initial_simplex": 1 + WIDE / 5 * np.eye(len(start) + 1, len(start)),
            "xatol": 1e-12,
            "fatol": 0.0,
            "maxfev": 1000,
        },
    )
    second = pooled(problem, first.row * by_simplex.x, steps=10, tolerance=1e-9)
    return replace(second, steps=first.steps + second.steps)


def _spread(
    slopes: np.ndarray, names: tuple[str, ...]
) -> tuple[np.ndarray, tuple[tuple[str, str, float], ...]]:
    """``(K,)`` standard errors by residuals of 1 m, infinite where a parameter changes nothing,
    and pairs that are hard to tell apart."""
    size = np.linalg.norm(slopes, axis=0)
    live = np.flatnonzero(size > 1e-9)
    unit = np.full(len(names), np.inf)
    scaled = slopes[:, live] / size[live]
    covariance = np.linalg.pinv(scaled.T @ scaled)
    deviation = np.sqrt(np.diag(covariance))
    unit[live] = deviation / size[live]
    alike = covariance / np.outer(deviation, deviation)
    tied = tuple(
        (names[live[i]], names[live[j]], float(alike[i, j]))
        for i in range(len(live))
        for j in range(i)
        if abs(alike[i, j]) > TIED
    )
    return unit, tied
