"""All engines on the same problems: ``scripts/benchmark.py``."""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from nnode.app.benchmark_engines import ENGINES, Call, Engine, torch_call
from nnode.app.benchmark_problems import SHAPES, Problem, pose
from nnode.calibrate.cost import squared_error
from nnode.errors import ConfigError, SimulationError
from nnode.files import write_json
from nnode.machine import machine
from nnode.solvers import FusedSolver, TorchdiffeqSolver

#: A measurement repeats its call for at least so long, s.
_LEAST = 0.05

#: Packages whose versions the results name.
PACKAGES = ("torch", "torchdiffeq", "numba", "numpy", "jax", "diffrax")


def benchmark(config: DictConfig, folder: Path) -> None:
    """Time the engines, print a table and write ``benchmark.json``.

    Raises:
        ConfigError: unknown shapes or engines, or no repeat.
        SimulationError: an engine disagrees with the exact solution; nothing was timed.
    """
    options = config.benchmark
    for name, chosen, known in (
        ("shapes", options.shapes, SHAPES),
        ("engines", options.engines or [], ENGINES),
    ):
        wrong = [item for item in chosen if item not in known]
        if wrong:
            raise ConfigError(
                f"benchmark.{name} has {', '.join(wrong)}, expected some of {', '.join(known)}"
            )
    for name in ("repeats", "restarts"):
        if options[name] < 1:
            raise ConfigError(f"benchmark.{name}={options[name]} must be at least 1")
    # one thread for all; fused_2 brings its own second one
    torch.set_num_threads(1)
    dtype = getattr(torch, options.dtype.value)
    found: list[dict[str, Any]] = []
    for name in options.shapes:
        for shape in SHAPES[name]:
            for model in shape.models:
                problem = pose(shape, model, dtype)
                chosen = {
                    key: engine
                    for key, engine in ENGINES.items()
                    if key in (options.engines or ENGINES) and engine.covers(problem)
                }
                row = _measure(problem, chosen, options.repeats)
                if shape.domain == "traffic":
                    row["ensemble"] = _ensemble(problem, options.restarts, options.repeats)
                found.append({"shape": name, **row})
                _print(found[-1])
    write_json(
        folder / "benchmark.json",
        {"machine": machine(PACKAGES), "dtype": options.dtype.value, "problems": found},
    )
    print(f"results: {folder / 'benchmark.json'}")


def _exact(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """States and gradient in float64, by PyTorch where that is possible."""
    other = pose(problem.shape, problem.model, torch.float64)
    step = problem.shape.step
    small = ENGINES["odeint"].covers(problem)
    solver = TorchdiffeqSolver("euler", "discrete", step) if small else FusedSolver(step)
    return torch_call(other, solver)()


def _check(
    name: str, engine: Engine, call: Call, exact: tuple[np.ndarray, np.ndarray]
) -> dict[str, Any]:
    """Call an engine for the first time, and refuse it where it disagrees."""
    start = time.perf_counter()
    states, gradient = call()
    first = time.perf_counter() - start
    away = float(np.abs(states - exact[0]).max() / np.abs(exact[0]).max())
    error = float(np.linalg.norm(gradient - exact[1]) / np.linalg.norm(exact[1]))
    if not (away <= engine.state_tolerance and error <= engine.tolerance):
        raise SimulationError(
            f"engine {name} differs from the exact solution by {away:.3g} in the states and by "
            f"{error:.3g} in the gradient, at most {engine.state_tolerance:g} and "
            f"{engine.tolerance:g} are expected; nothing was timed"
        )
    return {"first_call": first, "state_error": away, "gradient_error": error}


def _once(call: Any, times: int) -> float:
    start = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - start) / times


def _rounds(calls: dict[str, Any], repeats: int) -> dict[str, list[float]]:
    """Seconds per call, all engines in turn, so that a busy moment hits all of them."""
    times = {name: max(1, round(_LEAST / _once(call, 1))) for name, call in calls.items()}
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            taken[name].append(_once(call, times[name]))
    return taken


def _summary(taken: list[float]) -> dict[str, Any]:
    return {"median": median(taken), "min": min(taken), "max": max(taken), "all": taken}


def _measure(problem: Problem, engines: dict[str, Engine], repeats: int) -> dict[str, Any]:
    exact = _exact(problem)
    calls = {name: engine.prepare(problem) for name, engine in engines.items()}
    checks = {name: _check(name, engines[name], call, exact) for name, call in calls.items()}
    taken = _rounds(calls, repeats)
    rows = {
        name: {**_summary(taken[name]), **checks[name], "exact": engines[name].exact}
        for name in engines
    }
    return {
        "problem": problem.label,
        "agents": problem.shape.agents,
        "steps": problem.shape.steps,
        "engines": rows,
        "peak_memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        / (1024 if sys.platform != "darwin" else 1024**2),
    }


def _ensemble(problem: Problem, restarts: int, repeats: int) -> dict[str, Any]:
    """Restarts side by side, beside a single run, by number of threads."""
    draw = torch.Generator().manual_seed(7)
    stacked = {
        name: (p * (1 + 0.05 * torch.rand(restarts, *p.shape, generator=draw).to(p)))
        .detach()
        .requires_grad_()
        for name, p in problem.system.named_parameters()
    }
    batch = problem.batch
    found: dict[str, Any] = {"restarts": restarts}
    for threads in (1, 2):
        solver = FusedSolver(problem.shape.step, threads)

        def together(solver: FusedSolver = solver) -> None:
            x = solver.ensemble(problem.system, stacked, batch).x
            cost = (x - batch.x[:, None]).square().sum()
            torch.autograd.grad(0.5 * batch.dt * cost, list(stacked.values()))

        def single(solver: FusedSolver = solver) -> None:
            cost = squared_error(solver(problem.system, batch), batch).sum()
            torch.autograd.grad(0.5 * batch.dt * cost, list(problem.system.parameters()))

        together()
        taken = _rounds({"single": single, "together": together}, repeats)
        found[f"threads_{threads}"] = {
            **{key: _summary(value) for key, value in taken.items()},
            "single_runs": median(taken["together"]) / median(taken["single"]),
        }
    return found


def _print(row: dict[str, Any]) -> None:
    table = Table(title=f"{row['shape']}, {row['problem']}")
    engines = row["engines"]
    heads = ("engine", "median (ms)", "min … max (ms)", "first call (s)", "gradient error")
    fused = engines.get("fused_1")
    for head in (*heads, *(("times fused_1",) if fused else ())):
        table.add_column(head, justify="left" if head == "engine" else "right")
    for name, engine in engines.items():
        cells = [
            name,
            f"{1e3 * engine['median']:.4g}",
            f"{1e3 * engine['min']:.4g} … {1e3 * engine['max']:.4g}",
            f"{engine['first_call']:.3g}",
            f"{engine['gradient_error']:.1e}",
        ]
        if fused:
            cells.append(f"{engine['median'] / fused['median']:.3g}")
        table.add_row(*cells)
    console = Console(width=120)
    console.print(table)
    ensemble = row.get("ensemble")
    if ensemble:
        parts = [
            f"{ensemble[f'threads_{n}']['single_runs']:.3g} single runs with {n} thread(s)"
            for n in (1, 2)
        ]
        console.print(f"{ensemble['restarts']} restarts cost {', '.join(parts)}")
