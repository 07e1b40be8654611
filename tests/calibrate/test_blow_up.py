"""Diverging simulations raise an error with sequence, agent and time; NaN is never silent."""

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

SOLVERS = {
    "torchdiffeq": lambda dt: TorchdiffeqSolver(gradient="discrete", dt=dt),
    "fused": FusedSolver,
}


@pytest.fixture(params=SOLVERS)
def solver(request: pytest.FixtureRequest) -> Any:
    """A function of the step, s."""
    return SOLVERS[request.param]


def platoon(*starts: float) -> Batch:
    return collate([lane(np.array(starts) + 2.0 * np.arange(6)[:, None], name="tunnel/7")])


def law(term: str, **options: Any) -> Any:
    return build_model(
        {"term": term, "name": term, "leader": "constant", "v0": 20.0, "L": 5.0, "L_min": 2.0}
        | options
    )


@pytest.mark.parametrize(
    ("dt", "v0", "starts", "message"),
    [
        # a gap of zero
        (0.1, 20.0, (0.0, 30.0, 30.0), "tunnel/7 blew up: agent 1 at 0.2 s after the start"),
        # a diverging step
        (0.2, 1e300, (0.0, 30.0, 60.0), r"tunnel/7 .* agent \d"),
    ],
)
def test_divergence_is_located(
    solver: Any, dt: float, v0: float, starts: tuple[float, ...], message: str
) -> None:
    with pytest.raises(SimulationError, match=f"sequence {message}"):
        solver(dt)(law("lin", v0=v0), platoon(*starts))


def test_logarithm_of_a_negative_gap_is_finite(solver: Any) -> None:
    model, solve = law("log"), solver(0.1)
    metrics = evaluate(lambda batch: solve(model, batch), [platoon(0.0, 30.0, 29.0)])
    assert math.isfinite(metrics.J)
    assert metrics.rmse > 5  # the vehicle ahead of its leader is thrown back


def test_people_in_the_same_place_have_finite_costs(solver: Any) -> None:
    x = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    batch = collate([replace(straight(x, x, 5, 0.1, name="hall/1"), v=None)])
    model = Crowd(social_forces(A=5.0, k=5.0, kappa=5.0, B=0.3, walls=False))
    solve: Solver = solver(0.05)
    assert math.isfinite(evaluate(lambda b: solve(model, b), [batch]).J)


@pytest.mark.parametrize("error", [1e13, 1e200, math.inf, math.nan])
def test_unbounded_position_error_is_located(error: float) -> None:
    batch = platoon(0.0, 30.0)
    x = batch.x.clone()
    x[3, 0, 1] += error
    with pytest.raises(SimulationError, match=r"tunnel/7 left the data: agent 1 .* at 0.6 s"):
        evaluate(lambda b: Trajectory(x, None), [batch])
    assert torch.isfinite(batch.x).all()
