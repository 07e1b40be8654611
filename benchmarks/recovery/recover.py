"""From what another program simulated to the parameters that were typed into it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.ensemble import EnsembleCost
from nnode.calibrate.least_squares import (
    Minimum,
    Residuals,
    least_squares,
    trajectory_residuals,
)
from nnode.data.sequence import Sequence, collate
from nnode.model import Crowd, Traffic
from nnode.model.laws import law_from
from nnode.model.system import System
from nnode.simulate.fused import FusedSolver

#: The searches start this share away from every parameter: up and down in turns, all up, all down.
AWAY = 0.3
#: Half an interval of 95 %, in standard errors.
NORMAL = 1.96
#: A parameter whose interval is wider to one side than this share of it is not identified.
WIDE = 0.1
#: Estimates that are correlated by more than this are hard to tell apart.
TIED = 0.95
#: Differences of parameters for the curvature, relative.
DIFFERENCE = 1e-4


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
        simulations: how many the search took.
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
    cost = EnsembleCost(system, batch, FusedSolver(dt=dt, method=method))
    names = tuple(name.rpartition(".")[2] for name in cost.names)
    truth = cost.row(system).numpy()
    metres = _in_metres(cost)
    exact = metres(truth)
    assert exact is not None, "the typed parameters cannot be simulated"
    moves = torch.from_numpy(_moving(cost))
    turns, one = (-1.0) ** np.arange(len(truth)), np.ones(len(truth))
    # a limit on speed or acceleration that is nowhere reached changes nothing: of these starts
    # some lie below each
    starts = [truth * (1 + AWAY * way) for way in (turns, -turns, one, -one)]
    ends = [_best(cost, metres, start) for start in starts]
    first, best = min(enumerate(ends), key=lambda end: end[1].cost)
    noise = torch.from_numpy(error * np.random.default_rng(seed).standard_normal(len(exact)))

    def noisy(row: np.ndarray) -> Tensor | None:
        found = metres(row)
        return None if found is None else found + torch.where(moves, noise, 0.0)

    again = _best(cost, noisy, starts[first])
    count = int(moves.sum())
    unit, tied = _spread(_slopes(metres, again.row), names)
    return Recovered(
        names=names,
        typed=truth,
        found=best.row,
        measured=again.row,
        half=NORMAL * np.sqrt(again.cost / (count - len(truth))) * unit,
        error=error,
        tied=tied,
        forward=float((exact.square().sum() / count) ** 0.5),
        worst=float(exact.abs().max()),
        path=float(np.sqrt(best.cost / count)),
        simulations=sum(end.evaluations for end in ends),
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


def _in_metres(cost: EnsembleCost) -> Residuals:
    """Residuals that are differences of coordinates, m."""
    weighted, scale = trajectory_residuals(cost), (2 * len(cost.batch) / cost.batch.dt) ** 0.5

    def residuals(row: np.ndarray) -> Tensor | None:
        found = weighted(row)
        return None if found is None else found * scale

    return residuals


def _moving(cost: EnsembleCost) -> np.ndarray:
    """``(M,)`` which residuals are of agents that the model moves: not of measured leaders."""
    agent = cost.batch.agent.clone()
    if cost.system.domain == "traffic":
        agent[torch.arange(len(agent)), agent.sum(1) - 1] = False
    seen = cost.batch.valid[1:]
    moves = agent.expand(seen.shape)[seen]
    return moves.repeat_interleave(cost.batch.x.shape[-1]).numpy()


def _best(cost: EnsembleCost, residuals: Residuals, start: np.ndarray) -> Minimum:
    """Where the search ends; it begins once more at its end, as it ends at a share of its cost."""
    box = cost.low.numpy(), cost.high.numpy()
    first = least_squares(residuals, start, *box, steps=60, tolerance=1e-9)
    second = least_squares(residuals, first.row, *box, steps=10, tolerance=1e-9)
    return replace(second, evaluations=first.evaluations + second.evaluations)


def _slopes(metres: Residuals, row: np.ndarray) -> np.ndarray:
    """``(M, K)`` derivatives of the coordinates, by central differences."""
    columns = []
    for j, value in enumerate(row):
        sides = []
        step = DIFFERENCE * max(abs(value), 1e-3)
        for sign in (1, -1):
            other = row.copy()
            other[j] += sign * step
            found = metres(other)
            assert found is not None, "the neighbourhood of the minimum cannot be simulated"
            sides.append(found.numpy())
        columns.append((sides[0] - sides[1]) / (2 * step))
    return np.stack(columns, 1)


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
