"""What exact derivatives by eight parameters cost beside the simulation alone, and to compile."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from os import environ
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.speed.problems import Problem, Shape, pose
from nnode.errors import SimulationError
from nnode.model import Traffic
from nnode.simulation.kernels import lanes

#: Where this package stands: it is not installed.
_ROOT = Path(__file__).parents[2]
#: Tangents are timed where they agree so well with the gradient.
_AGREE = 1e-9
_SCRIPT = """
import json, sys
root, shape, model, what = sys.argv[1:]
sys.path.insert(0, root)
import torch
torch.set_num_threads(1)
from benchmarks.speed.tangents import first_call
print(first_call(json.loads(shape), model, what))
"""


def calls(problem: Problem) -> dict[str, Callable[[], Tensor]]:
    """``forward``: states alone; ``tangents``: with their derivatives by all parameters."""
    system, batch, per = problem.system, problem.batch, problem.shape.per
    assert isinstance(system, Traffic)
    lane = lanes.supports(system, batch)
    assert lane is not None
    names = list(lane.owned)

    def forward() -> Tensor:
        with torch.no_grad():
            return lanes.simulate(system, lane, batch, per)[:, 0, ..., 0]

    def tangents() -> Tensor:
        return lanes.tangents(system, lane, batch, per, names)[1][..., 0]

    return {"forward": forward, "tangents": tangents}


def first_call(shape: dict[str, Any], model: str, what: str) -> float:
    """Seconds of the first call in this process."""
    problem = pose(Shape(**shape), model, torch.float32)
    begin = time.perf_counter()
    calls(problem)[what]()
    return time.perf_counter() - begin


def starts(problem: Problem) -> dict[str, dict[str, float]]:
    """Seconds of the first call of a new process, ``cold`` with nothing compiled, then ``warm``."""
    shape = json.dumps(asdict(problem.shape))
    found: dict[str, dict[str, float]] = {}
    for what in ("forward", "tangents"):
        with tempfile.TemporaryDirectory() as empty:
            found[what] = {
                start: float(
                    subprocess.run(
                        [sys.executable, "-c", _SCRIPT, str(_ROOT), shape, problem.model, what],
                        capture_output=True,
                        text=True,
                        check=True,
                        env={**environ, "NNODE_CACHE": empty},
                    ).stdout
                )
                for start in ("cold", "warm")
            }
    return found


def check(problem: Problem) -> float:
    """How far the tangents are from the gradient in float64, relatively, at most.

    What is compared is the derivative of a random sum of places: the way back and the way forward
    share no code but the formula.

    Raises:
        SimulationError: they disagree.
    """
    exact = pose(problem.shape, problem.model, torch.float64)
    system, batch = exact.system, exact.batch
    lane = lanes.supports(system, batch)
    assert lane is not None
    x = lanes.simulate(system, lane, batch, problem.shape.per)[:, 0, ..., 0]
    weight = torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    gradient = torch.stack(torch.autograd.grad((weight * x).sum(), list(system.parameters())))
    found = (calls(exact)["tangents"]() * weight).sum((1, 2, 3))
    away = float(((found - gradient).abs() / gradient.abs().clamp(min=1e-9)).max())
    if not away <= _AGREE:
        raise SimulationError(
            f"tangents of {problem.label} differ from the gradient by {away:.3g}, at most "
            f"{_AGREE:g} is expected; this problem was not timed"
        )
    return away
