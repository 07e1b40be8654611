"""Numbers that blow up are told with sequence, agent and time, and are never a silent NaN."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from nnode.calibrate.evaluate import evaluate
from nnode.data.sequence import Batch, collate
from nnode.errors import SimulationError
from nnode.model import Crowd, build_model
from nnode.simulation import Solver, TorchdiffeqSolver
from nnode.simulation.base import Trajectory
from nnode.simulation.fused import FusedSolver
from tests.builders import lane, social_forces, straight

SOLVERS = [
    pytest.param(lambda dt: TorchdiffeqSolver(gradient="discrete", dt=dt), id="torchdiffeq"),
    pytest.param(lambda dt: FusedSolver(dt), id="fused"),
]


def platoon(*starts: float) -> Batch:
    return collate([lane(np.array(starts) + 2.0 * np.arange(6)[:, None], name="tunnel/7")])


def law(term: str, **options: Any) -> Any:
    return build_model(
        {"term": term, "name": term, "leader": "constant", "v0": 20.0, "L": 5.0, "L_min": 2.0}
        | options
    )


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_gap_of_zero_is_told(solver: Any) -> None:
    words = r"sequence tunnel/7 blew up: agent 1 at 0.2 s after the start"
    with pytest.raises(SimulationError, match=words):
        solver(0.1)(law("lin"), platoon(0.0, 30.0, 30.0))


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_logarithm_of_a_negative_gap_is_a_number(solver: Any) -> None:
    model, solve = law("log"), solver(0.1)
    found = evaluate(lambda batch: solve(model, batch), [platoon(0.0, 30.0, 29.0)])
    assert math.isfinite(found.J)
    assert found.rmse > 5  # the one who stands before its leader is thrown back


@pytest.mark.parametrize("solver", SOLVERS)
def test_people_who_stand_in_one_place_give_numbers(solver: Any) -> None:
    x = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    batch = collate([replace(straight(x, x, 5, 0.1, name="hall/1"), v=None)])
    model = Crowd(social_forces(A=5.0, k=5.0, kappa=5.0, B=0.3, walls=False))
    solve: Solver = solver(0.05)
    found = evaluate(lambda b: solve(model, b), [batch])
    assert math.isfinite(found.J)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_diverging_step_is_told(solver: Any) -> None:
    model = law("lin", v0=1e300)
    solve = solver(0.2)
    with pytest.raises(SimulationError, match=r"sequence tunnel/7 .* agent \d"):
        evaluate(lambda batch: solve(model, batch), [platoon(0.0, 30.0, 60.0)])


@pytest.mark.parametrize("away", [1e13, 1e200, math.inf, math.nan])
def test_an_error_without_bounds_is_told_with_its_place(away: float) -> None:
    batch = platoon(0.0, 30.0)
    x = batch.x.clone()
    x[3, 0, 1] += away
    with pytest.raises(SimulationError, match=r"tunnel/7 left the data: agent 1 .* at 0.6 s"):
        evaluate(lambda b: Trajectory(x, None), [batch])
    assert torch.isfinite(batch.x).all()
