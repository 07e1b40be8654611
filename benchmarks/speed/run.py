"""All engines on the same problems: ``scripts/benchmark.py``."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig

from benchmarks.speed import tangents
from benchmarks.speed.diagnosis import diagnosed
from benchmarks.speed.engines import ENGINES, by_method, method_errors, torch_call
from benchmarks.speed.figure import performance_figure
from benchmarks.speed.floor import evaluations, floor_call
from benchmarks.speed.memory import peak_memory
from benchmarks.speed.problems import SHAPES, Problem, pose
from benchmarks.speed.start import first_call
from nnode.errors import ConfigError, SimulationError
from nnode.files import write_json
from nnode.machine import machine
from nnode.plots.style import save
from nnode.simulation import FusedSolver, TorchdiffeqSolver

#: Packages whose versions are recorded.
PACKAGES = ("torch", "torchdiffeq", "numba", "numpy", "jax", "diffrax")

#: A measurement repeats its call for at least so long, s.
_LEAST = 0.05
#: The shape that times whole diagnoses, and no engine.
_DIAGNOSIS = "diagnosis"

Row = dict[str, Any]
Calls = dict[str, Callable[[], object]]
#: What is known of a call beside its time, by its name.
Facts = dict[str, Row]


def benchmark(config: DictConfig, folder: Path) -> None:
    """Time the engines, print tables, and write ``benchmark.json`` and ``benchmark.png``.

    The results, a row per engine and problem, are written again after every problem. The figure
    needs two problems that differ in the number of steps, of people, or of diagnosed sequences.
    With ``redraw`` nothing is timed.

    Raises:
        ConfigError: unknown shapes or engines, no repeat, or results that cannot be drawn.
        SimulationError: an engine disagrees with the exact solution of a problem; neither this
            problem nor any later one is timed.
    """
    options = config.benchmark
    if options.redraw is not None:
        _redraw(Path(options.redraw), folder)
        return
    _check_options(options)
    # one thread for all; fused_2 has a second one of its own
    torch.set_num_threads(1)
    dtype = getattr(torch, options.dtype.value)
    rows: list[Row] = []
    results = {"machine": machine(PACKAGES), "dtype": options.dtype.value, "rows": rows}

    def add(title: str, found: list[Row]) -> None:
        rows.extend(found)
        table = pd.DataFrame(found).drop(columns=["shape", "problem"], errors="ignore")
        text = table.to_string(index=False, float_format="{:.4g}".format, na_rep="")
        print(f"\n{title}\n{text}", flush=True)
        write_json(folder / "benchmark.json", results)

    for name in options.shapes:
        for number in options.sequences if name == _DIAGNOSIS else []:
            row = {"shape": name, "model": "lin", "engine": name, **diagnosed(number)}
            add(name, [row | dict.fromkeys(("median", "min", "max"), row["wall_s"])])
        for shape in SHAPES.get(name, []):
            for model in shape.models:
                problem = pose(shape, model, dtype)
                add(f"{name}, {problem.label}", _timed(name, problem, options))
    print(f"results: {folder / 'benchmark.json'}")
    _draw(results, folder)


def _check_options(options: DictConfig) -> None:
    for name, chosen, known in (
        ("shapes", options.shapes, [*SHAPES, _DIAGNOSIS]),
        ("engines", options.engines or [], ENGINES),
    ):
        wrong = [item for item in chosen if item not in known]
        if wrong:
            raise ConfigError(
                f"benchmark.{name} has {', '.join(wrong)}, expected some of {', '.join(known)}"
            )
    for name in ("repeats", "restarts", "sequences"):
        if min(np.atleast_1d(options[name]), default=1) < 1:
            raise ConfigError(f"benchmark.{name}={options[name]} must be at least 1")


def _timed(name: str, problem: Problem, options: DictConfig) -> list[Row]:
    """What is measured of one problem of the shapes ``name``: a row per engine."""
    shape = problem.shape
    if name == "methods":
        calls, facts = _warmed(dict(by_method(problem))), method_errors(problem)
    elif name == "tangents":
        calls = _warmed(dict(tangents.calls(problem)))
        facts = {"tangents": {"difference": tangents.check(problem)}}
        for what in calls:
            with tempfile.TemporaryDirectory() as cache:
                starts = {
                    f"{at} start": first_call(problem, what, cache) for at in ("cold", "warm")
                }
            facts[what] = facts.get(what, {}) | starts
    else:
        calls, facts = _engines(name, problem, options)
    row: Row = {"shape": name, "problem": problem.label, "model": problem.model}
    row |= {"sequences": shape.sequences, "agents": shape.agents, "steps": shape.steps}
    taken = _rounds(calls, options.repeats)
    reference = {
        f"times {engine}": taken[engine]["median"]
        for engine in dict.fromkeys([next(iter(taken)), "fused_1", "fused_2"])
        if engine in taken
    }
    return [
        {
            **row,
            "engine": engine,
            **times,
            **{head: times["median"] / seconds for head, seconds in reference.items()},
            # per step and vehicle or person, µs
            "µs": 1e6 * times["median"] / (shape.agents * shape.sequences * shape.steps),
            **facts.get(engine, {}),
        }
        for engine, times in taken.items()
    ]


def _engines(name: str, problem: Problem, options: DictConfig) -> tuple[Calls, Facts]:
    """The engines that agree with the exact solution, restarts side by side, and the arithmetic."""
    exact = _exact(problem)
    calls: Calls = {}
    facts: Facts = {}
    for key, engine in ENGINES.items():
        if key in (options.engines or ENGINES) and engine.covers(problem):
            calls[key] = call = engine.prepare(problem)
            start = time.perf_counter()
            states, gradient = call()
            first = time.perf_counter() - start
            away = float(np.abs(states - exact[0]).max() / np.abs(exact[0]).max())
            error = float(np.linalg.norm(gradient - exact[1]) / np.linalg.norm(exact[1]))
            if not (away <= engine.state_tolerance and error <= engine.tolerance):
                raise SimulationError(
                    f"engine {key} differs from the exact solution of {problem.label} by "
                    f"{away:.3g} in the states and by {error:.3g} in the gradient, at most "
                    f"{engine.state_tolerance:g} and {engine.tolerance:g} are expected; this "
                    "problem was not timed"
                )
            facts[key] = {"first_call": first, "state_error": away, "gradient_error": error}
    if name in ("paper", "crowd") and "fused_1" in calls:
        facts["fused_1"]["warm start"] = first_call(problem, "gradient")
    more: Calls = {}
    # the problems of ``steps`` are those of ``paper`` with another number of steps
    if problem.shape.domain == "traffic" and name != "steps":
        for threads in (1, 2):
            more[f"restarts_{threads}"] = _restarts(problem, options.restarts, threads)
    floor = floor_call(problem)
    if floor is not None:
        more["floor"] = floor
        facts["floor"] = {"evaluations": evaluations(problem)}
    return calls | _warmed(more), facts


def _warmed(calls: Calls) -> Calls:
    """The calls after a first one of each, which compiles."""
    for call in calls.values():
        call()
    return calls


def _exact(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """States and gradient in float64, by PyTorch where that is possible."""
    other = pose(problem.shape, problem.model, torch.float64)
    step = problem.shape.step
    small = ENGINES["odeint"].covers(problem)
    solver = (
        TorchdiffeqSolver("euler", "discrete", step) if small else FusedSolver(step, method="euler")
    )
    return torch_call(other, solver)()


def _restarts(problem: Problem, number: int, threads: int) -> Callable[[], object]:
    """One gradient of several simulations side by side that differ in their parameters."""
    draw = torch.Generator().manual_seed(7)
    stacked = {
        name: (p * (1 + 0.05 * torch.rand(number, *p.shape, generator=draw).to(p)))
        .detach()
        .requires_grad_()
        for name, p in problem.system.named_parameters()
    }
    batch, solver = problem.batch, FusedSolver(problem.shape.step, threads)

    def together() -> None:
        x = solver.ensemble(problem.system, stacked, batch).x
        cost = (x - batch.x[:, None]).square().sum()
        torch.autograd.grad(0.5 * batch.dt * cost, list(stacked.values()))

    return together


def _once(call: Callable[[], object], times: int) -> float:
    start = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - start) / times


def _rounds(calls: Calls, repeats: int) -> dict[str, Row]:
    """Seconds per call, all engines in turn, so that other load hits all of them; memory."""
    times, memory = {}, {}
    taken: dict[str, list[float]] = {}
    for name, call in calls.items():
        trial, memory[name] = peak_memory(partial(_once, call, 1))
        times[name] = max(1, round(_LEAST / trial))
        # a long call needs no second one to be a measurement
        taken[name] = [trial] if trial >= _LEAST else []
    for number in range(1, repeats + 1):
        for name, call in calls.items():
            if len(taken[name]) < number:
                taken[name].append(_once(call, times[name]))
    return {
        name: {"median": median(all_), "min": min(all_), "max": max(all_), **memory[name]}
        for name, all_ in taken.items()
    }


def _draw(results: dict[str, Any], folder: Path) -> bool:
    """Draw the results where there is something to draw; whether there is."""
    figure = performance_figure(results)
    if figure is not None:
        print(f"figure: {save(figure, folder / 'benchmark.png')}")
    return figure is not None


def _redraw(path: Path, folder: Path) -> None:
    """Draw results of an earlier run."""
    try:
        drawn = _draw(json.loads(path.read_text(encoding="utf-8")), folder)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"benchmark.redraw={path} cannot be read ({error!r}); expected the benchmark.json "
            "of an earlier run"
        ) from error
    if not drawn:
        raise ConfigError(
            f"benchmark.redraw={path} has nothing to draw; expected at least two problems of the "
            "shape steps, of people and scale, or of diagnosis"
        )
