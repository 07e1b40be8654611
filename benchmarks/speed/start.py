"""What the first gradient of a new process costs, its code compiled and kept beforehand."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from benchmarks.speed.problems import Problem

#: Where this package stands: it is not installed.
_ROOT = Path(__file__).parents[2]

#: The clock runs from the import of the solver (and so of Numba) to the gradient.
_SCRIPT = """
import json, sys, time, torch
root, shape, model, dtype = sys.argv[1:]
sys.path.insert(0, root)
from benchmarks.speed.problems import Shape, pose
problem = pose(Shape(**json.loads(shape)), model, getattr(torch, dtype))
torch.set_num_threads(1)
begin = time.perf_counter()
from nnode.simulation import FusedSolver
FusedSolver(problem.shape.step)(problem.system, problem.batch).x.sum().backward()
print(time.perf_counter() - begin)
"""


def warm_start(problem: Problem) -> float:
    """Seconds from importing the fused solver to the first gradient, in a process of its own.

    The code of the problem's model must have been compiled before.
    """
    shape = json.dumps(asdict(problem.shape))
    dtype = str(problem.batch.x.dtype).removeprefix("torch.")
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, str(_ROOT), shape, problem.model, dtype],
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout)
