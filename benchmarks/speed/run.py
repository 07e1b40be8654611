"""All engines on the same problems: ``scripts/benchmark.py``."""

from __future__ import annotations

import json
import tempfile
import time
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig

from benchmarks.speed.diagnosis import diagnosed
from benchmarks.speed.engines import ENGINES, Call, Engine, by_method, method_errors, torch_call
from benchmarks.speed.figure import performance_figure
from benchmarks.speed.floor import evaluations, floor_call
from benchmarks.speed.memory import peak_memory
from benchmarks.speed.problems import SHAPES, Problem, pose
from benchmarks.speed.report import per_person, show, show_problem
from benchmarks.speed.start import first_call
from benchmarks.speed.tangents import calls, check
from nnode.calibrate.cost import squared_error
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
#: Name of the arithmetic alone among the calls that are timed.
_FLOOR = "floor"


def benchmark(config: DictConfig, folder: Path) -> None:
    """Time the engines, print tables, and write ``benchmark.json`` and ``benchmark.png``.

    The results are written again after every problem. The figure needs two problems that differ
    in the number of steps, of people, or of diagnosed sequences. With ``redraw`` nothing is timed.

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
    rows: list[dict[str, Any]] = []
    results = {"machine": machine(PACKAGES), "dtype": options.dtype.value, "problems": rows}

    def add(row: dict[str, Any]) -> None:
        rows.append(row)
        results["scale"] = per_person([row for row in rows if row["shape"] == "scale"])
        write_json(folder / "benchmark.json", results)

    for name in options.shapes:
        for number in options.sequences if name == _DIAGNOSIS else []:
            add(diagnosed(number))
        for shape in SHAPES.get(name, []):
            for model in shape.models:
                row = {"shape": name, **_timed(name, pose(shape, model, dtype), options)}
                show_problem(row)
                add(row)
    for engine, scale in results.get("scale", {}).items():
        seconds = dict(zip(map(str, scale["people"]), scale["seconds"], strict=True))
        show(f"{engine}: one step of one person takes (s)", [seconds | {"ratio": scale["ratio"]}])
    show("diagnosis", [row for row in rows if row["shape"] == _DIAGNOSIS])
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
        least = min(options[name], default=1) if name == "sequences" else options[name]
        if least < 1:
            raise ConfigError(f"benchmark.{name}={options[name]} must be at least 1")


def _timed(name: str, problem: Problem, options: DictConfig) -> dict[str, Any]:
    """What is measured of one problem of the shapes ``name``."""
    shape = problem.shape
    row = {"problem": problem.label, "model": problem.model, "sequences": shape.sequences}
    row |= {"agents": shape.agents, "steps": shape.steps}
    if name == "methods":
        return {
            **row,
            "errors": method_errors(problem),
            "engines": _rounds(by_method(problem), options.repeats, compile_first=True),
        }
    if name == "tangents":
        return {
            **row,
            "parameters": len(list(problem.system.parameters())),
            "difference": check(problem),
            "engines": _rounds(calls(problem), options.repeats, compile_first=True),
            "starts": _starts(problem),
        }
    chosen = {
        key: engine
        for key, engine in ENGINES.items()
        if key in (options.engines or ENGINES) and engine.covers(problem)
    }
    row |= _measure(problem, chosen, options.repeats)
    # the problems of ``steps`` are those of ``paper`` with another number of steps
    if shape.domain == "traffic" and name != "steps":
        row["ensemble"] = _ensemble(problem, options.restarts, options.repeats)
    if name in ("paper", "crowd") and "fused_1" in chosen:
        row["warm_start"] = first_call(problem, "gradient")
    return row


def _starts(problem: Problem) -> dict[str, dict[str, float]]:
    """Seconds of first calls of new processes, ``cold`` with nothing compiled, then ``warm``."""
    found = {}
    for what in ("forward", "tangents"):
        with tempfile.TemporaryDirectory() as cache:
            found[what] = {at: first_call(problem, what, cache) for at in ("cold", "warm")}
    return found


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


def _exact(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """States and gradient in float64, by PyTorch where that is possible."""
    other = pose(problem.shape, problem.model, torch.float64)
    step = problem.shape.step
    small = ENGINES["odeint"].covers(problem)
    solver = (
        TorchdiffeqSolver("euler", "discrete", step) if small else FusedSolver(step, method="euler")
    )
    return torch_call(other, solver)()


def _check(
    name: str, engine: Engine, call: Call, exact: tuple[np.ndarray, np.ndarray], label: str
) -> dict[str, Any]:
    """Call an engine for the first time, and refuse it where it disagrees."""
    start = time.perf_counter()
    states, gradient = call()
    first = time.perf_counter() - start
    away = float(np.abs(states - exact[0]).max() / np.abs(exact[0]).max())
    error = float(np.linalg.norm(gradient - exact[1]) / np.linalg.norm(exact[1]))
    if not (away <= engine.state_tolerance and error <= engine.tolerance):
        raise SimulationError(
            f"engine {name} differs from the exact solution of {label} by {away:.3g} in the "
            f"states and by {error:.3g} in the gradient, at most {engine.state_tolerance:g} and "
            f"{engine.tolerance:g} are expected; this problem was not timed"
        )
    return {"first_call": first, "state_error": away, "gradient_error": error}


def _once(call: Any, times: int) -> float:
    start = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - start) / times


def _rounds(
    timed: dict[str, Any], repeats: int, *, compile_first: bool = False
) -> dict[str, dict[str, Any]]:
    """Seconds per call, all engines in turn, so that other load hits all of them; memory."""
    times, memory = {}, {}
    taken: dict[str, list[float]] = {}
    for name, call in timed.items():
        if compile_first:
            call()
        trial, memory[name] = peak_memory(partial(_once, call, 1))
        times[name] = max(1, round(_LEAST / trial))
        # a long call needs no second one to be a measurement
        taken[name] = [trial] if trial >= _LEAST else []
    for number in range(1, repeats + 1):
        for name, call in timed.items():
            if len(taken[name]) < number:
                taken[name].append(_once(call, times[name]))
    return {name: {**_summary(taken[name]), **memory[name]} for name in timed}


def _summary(taken: list[float]) -> dict[str, Any]:
    return {"median": median(taken), "min": min(taken), "max": max(taken), "all": taken}


def _measure(problem: Problem, engines: dict[str, Engine], repeats: int) -> dict[str, Any]:
    exact = _exact(problem)
    calls = {name: engine.prepare(problem) for name, engine in engines.items()}
    checks = {
        name: _check(name, engines[name], call, exact, problem.label)
        for name, call in calls.items()
    }
    # in turn with the engines, so that both meet the same machine
    floor = floor_call(problem)
    timed: dict[str, Any] = dict(calls)
    if floor is not None:
        floor()  # compiles
        timed[_FLOOR] = floor
    taken = _rounds(timed, repeats)
    peaks = [taken[name]["peak_memory_MB"] for name in engines]
    row = {
        "engines": {
            name: {**taken[name], **checks[name], "exact": engines[name].exact} for name in engines
        },
        "peak_memory_MB": None if None in peaks else max(peaks, default=None),
    }
    if floor is not None:
        row["floor"] = {"evaluations": evaluations(problem), **taken[_FLOOR]}
    return row


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
            **taken,
            "single_runs": taken["together"]["median"] / taken["single"]["median"],
        }
    return found
