"""The engines that the benchmark compares: each gives states, cost and gradient of a problem."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import torch
from torch import Tensor

from benchmarks.speed.problems import Problem, pose
from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import Batch
from nnode.model.system import System
from nnode.simulation import FusedSolver, Solver, TorchdiffeqSolver, Trajectory, substeps
from nnode.simulation.base import check_finite, observed, simulated_batch

#: One simulation with cost and gradient: ``(K, B, N, D)`` positions and the flat gradient, in
#: the order of ``System.named_parameters``.
Call = Callable[[], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Engine:
    """Something that can solve a problem.

    Attributes:
        prepare: from a problem to the call that is timed.
        covers: whether it can solve a problem in reasonable time.
        exact: whether its gradient is that of the discrete scheme.
        tolerance: largest relative difference of its gradient to the exact one in float64 at
            which it is timed at all.
        state_tolerance: the same for the states, relative to the largest one.
    """

    prepare: Callable[[Problem], Call]
    covers: Callable[[Problem], bool]
    exact: bool = True
    tolerance: float = 1e-3
    state_tolerance: float = 1e-3


class LoopSolver:
    """Euler's method as one writes it by hand: a loop of PyTorch operations."""

    def __init__(self, dt: float) -> None:
        self.dt = dt

    def __call__(self, system: System, batch: Batch) -> Trajectory:
        n = substeps(batch.dt, self.dt, system)
        near, origin = simulated_batch(system, batch)
        scene, y = system.scene(near), system.initial(near)
        step = batch.dt / n
        found = [y]
        for s in range(n * (batch.n_samples - 1)):
            y = y + step * system(y.new_tensor(s * step), y, scene)
            if (s + 1) % n == 0:
                found.append(y)
        return check_finite(observed(system, torch.stack(found), batch, origin), batch)


def torch_call(problem: Problem, solver: Solver) -> Call:
    """One gradient by a solver of this package, as the trainer takes it."""
    system, batch = problem.system, problem.batch

    def call() -> tuple[np.ndarray, np.ndarray]:
        system.zero_grad()
        found = solver(system, batch)
        sequence_costs(found, batch).sum().backward()
        parts: list[Tensor] = [
            torch.zeros_like(p) if p.grad is None else p.grad for p in system.parameters()
        ]
        return found.x.detach().numpy(), torch.cat([p.flatten() for p in parts]).numpy()

    return call


def _solver(make: Callable[[float], Solver]) -> Callable[[Problem], Call]:
    return lambda problem: torch_call(problem, make(problem.shape.step))


def _jax(arrangement: str) -> Callable[[Problem], Call]:
    def prepare(problem: Problem) -> Call:
        from benchmarks.speed.jax_engines import jax_call

        return jax_call(problem, arrangement)

    return prepare


def _pairs(problem: Problem) -> bool:
    # PyTorch keeps every pair of every step of a crowd for the way back: some GB at this bound
    return problem.shape.agents**2 * problem.shape.sequences <= 260_000


def _traffic_in_jax(problem: Problem) -> bool:
    # laws alone are written for JAX
    law = problem.shape.domain == "traffic" and problem.model in ("lin", "log", "n4")
    return law and find_spec("jax") is not None


def _traffic_in_diffrax(problem: Problem) -> bool:
    return _traffic_in_jax(problem) and find_spec("diffrax") is not None


def _every(problem: Problem) -> bool:
    return True


ENGINES: dict[str, Engine] = {
    # the continuous adjoint differs from the exact gradient in proportion to the step, which is
    # long in crowds: reported, not judged
    "odeint_adjoint": Engine(
        _solver(lambda dt: TorchdiffeqSolver("euler", "adjoint", dt)), _pairs, False, math.inf
    ),
    "odeint": Engine(_solver(lambda dt: TorchdiffeqSolver("euler", "discrete", dt)), _pairs),
    "loop": Engine(_solver(LoopSolver), _pairs),
    "scan": Engine(_jax("scan"), _traffic_in_jax),
    "scan_batch_last": Engine(_jax("scan_batch_last"), _traffic_in_jax),
    "diffrax": Engine(_jax("diffrax"), _traffic_in_diffrax),
    "diffrax_batch_last": Engine(_jax("diffrax_batch_last"), _traffic_in_diffrax),
    # Steps of crowds are added without compensation: in float32 each may be off by 6e-8 of the
    # coordinate, 25 of them by 1.5e-6 (1.5e-4 m at 100 m), before forces amplify it. Found were
    # 2e-7 to 1.2e-6 for 50 to 10,000 people; an error of 1 m/s^2 in one step is 1.6e-5 at 100 m.
    "fused_1": Engine(
        _solver(lambda dt: FusedSolver(dt, 1, method="euler")), _every, True, 1e-4, 1e-5
    ),
    "fused_2": Engine(
        _solver(lambda dt: FusedSolver(dt, 2, method="euler")), _every, True, 1e-4, 1e-5
    ),
}

#: Methods and steps, s. The first is what engines are compared with.
STEPPED = (("euler", 0.002), ("euler", 0.1), ("ballistic", 0.1), ("rk4", 0.1))
#: So many steps of Runge and Kutta's method in the longest one stand for the solution: its errors
#: fall with the fourth power, by 7e4.
FINER = 16


def _stepped(method: str, dt: float) -> str:
    return f"{method} {dt:g} s"


def by_method(problem: Problem) -> dict[str, Call]:
    """One gradient by every method, on one thread; ballistic steps are of accelerations."""
    return {
        _stepped(method, dt): torch_call(problem, FusedSolver(dt, 1, method=method))
        for method, dt in STEPPED
        if method != "ballistic" or problem.system.order > 1
    }


def method_errors(problem: Problem) -> dict[str, dict[str, float]]:
    """By method, in float64: ``rms`` and ``largest`` distance of places from the solution, m, and
    ``gradient``, the largest relative error of a component of the gradient."""
    exact = pose(problem.shape, problem.model, torch.float64)
    system, batch = exact.system, exact.batch

    def solved(method: str, dt: float) -> tuple[Tensor, Tensor]:
        path = FusedSolver(dt, 1, method=method)(system, batch)
        own = list(system.parameters())
        slopes = torch.autograd.grad(sequence_costs(path, batch).sum(), own)
        return path.x.detach(), torch.cat([slope.flatten() for slope in slopes])

    longest = max(dt for _, dt in STEPPED)
    x, slope = solved("rk4", longest / FINER)
    found = {}
    for method, dt in STEPPED:
        if _stepped(method, dt) not in by_method(exact):
            continue
        other, own = solved(method, dt)
        away = other - x
        found[_stepped(method, dt)] = {
            "rms": float(away.square().mean().sqrt()),
            "largest": float(away.abs().max()),
            "gradient": float(((own - slope) / slope).abs().max()),
        }
    return found
