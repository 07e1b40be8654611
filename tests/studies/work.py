"""Tasks for tests of the runner, and a small study that can be stopped from outside."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import torch

from nnode.calibrate.interrupt import Interrupted
from nnode.errors import DataError
from studies.runner import Task, run_tasks


def square(x: float, log: str) -> dict[str, Any]:
    """The square; each call is logged in a file."""
    with open(log, "a") as file:
        file.write(f"{x:g}\n")
    return {"y": x * x}


def cube(x: float, log: str) -> dict[str, Any]:
    return {"y": square(x, log)["y"] * x}


def conditions() -> dict[str, Any]:
    """Values without a JSON representation, and the process and threads of the call."""
    return {
        "values": [float("nan"), float("inf"), -0.1, 1e-300],
        "text": "κ",
        "process": os.getpid(),
        "threads": torch.get_num_threads(),
        "blas": os.environ.get("OPENBLAS_NUM_THREADS"),
    }


def fail(kind: str) -> dict[str, Any]:
    if kind == "data":
        raise DataError("recording 7: no rows")
    if kind == "python":
        raise ZeroDivisionError("by nought")
    if kind == "exit":
        os._exit(3)
    if kind == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"model": object()} if kind == "object" else [1]


def simulate(law: str) -> dict[str, Any]:
    """The end of a small simulation by compiled code."""
    # imported here, because all workers import this module
    from benchmarks.speed.problems import Shape, pose
    from nnode.simulation import FusedSolver

    problem = pose(Shape("traffic", (law,), 3, 3, 2, 10, 0.02), law, torch.float64)
    with torch.no_grad():
        return {"x": FusedSolver(0.02)(problem.system, problem.batch).x[-1].tolist()}


def sleep(folder: str, name: str) -> dict[str, Any]:
    """Write the process id to a file; sleep, unless the folder contains the file ``awake``."""
    (Path(folder) / f"sign-{name}").write_text(str(os.getpid()))
    time.sleep(0.0 if (Path(folder) / "awake").exists() else 600.0)
    return {"name": name}


def tasks(folder: Path) -> list[Task]:
    """Two quick tasks, which start first, and two sleeping tasks."""
    log = str(folder / "calls")
    quick = [Task(f"quick-{x:g}", square, {"x": x, "log": log}, cost=2.0) for x in (1.0, 2.0)]
    sleeping = [Task(f"sleep-{n}", sleep, {"folder": str(folder), "name": n}) for n in "ab"]
    return sleeping + quick


def study(folder: Path, workers: int) -> None:
    """Run the tasks, and exit like the scripts when interrupted."""
    try:
        run_tasks(tasks(folder), folder, workers=workers, fingerprint="f", title="test")
    except Interrupted as error:
        print(error, file=sys.stderr)
        sys.exit(128 + error.signal)
