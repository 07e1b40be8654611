"""The first call of a new process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from benchmarks.speed.problems import Problem

#: Where the benchmarks stand: they are not installed.
_ROOT = Path(__file__).parents[2]
#: The clock runs from the import of the solver (and so of Numba) to the result.
_SCRIPT = """
import json, sys, time, torch
root, shape, model, dtype, what = sys.argv[1:]
sys.path.insert(0, root)
from benchmarks.speed.problems import Shape, pose
problem = pose(Shape(**json.loads(shape)), model, getattr(torch, dtype))
torch.set_num_threads(1)
begin = time.perf_counter()
if what == "gradient":
    from nnode.simulation import FusedSolver
    FusedSolver(problem.shape.step)(problem.system, problem.batch).x.sum().backward()
else:
    from benchmarks.speed.tangents import calls
    calls(problem)[what]()
print(time.perf_counter() - begin)
"""


def first_call(problem: Problem, what: str, cache: str | None = None) -> float:
    """Seconds from importing the solver to the first result, in a process of its own.

    Args:
        what: ``gradient``, or ``forward`` or ``tangents`` of :mod:`benchmarks.speed.tangents`.
        cache: folder of compiled code; by default that of this process.
    """
    shape = json.dumps(asdict(problem.shape))
    dtype = str(problem.batch.x.dtype).removeprefix("torch.")
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, str(_ROOT), shape, problem.model, dtype, what],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **({"NNODE_CACHE": cache} if cache else {})},
    )
    return float(done.stdout)
