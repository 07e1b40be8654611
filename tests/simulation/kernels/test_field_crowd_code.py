"""Laws with smallest and largest values over others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from nnode.app.python.inputs import model_options
from nnode.data.sequence import collate
from nnode.errors import ConfigError
from nnode.model import System, build_model
from nnode.simulation import FusedSolver
from tests.builders import people
from tests.model.following import rates
from tests.simulation.test_engines import OWN_FORCES, room


def formula(law: dict[str, Any]) -> System:
    options = {"term": "formula", "name": "mine", "leader": "measured", "effects": []}
    return build_model({**options, "law": law})


def test_acceleration_by_loops() -> None:
    batch = room().select([0])
    acceleration = rates(formula(OWN_FORCES["smallest"]), batch)[0, :, 2]
    x, v = batch.x[0, 0].numpy(), batch.v[0, 0].numpy()
    goal = batch.destination[0].numpy()
    for i in range(6):
        d = np.array([np.hypot(*(x[i] - x[j])) for j in range(6) if j != i])
        dx = np.array([x[i, 0] - x[j, 0] for j in range(6) if j != i])
        closest = (d * (1 + np.exp(-d / 0.5).sum())).min()
        right = dx[d < 1.25].max(initial=-1e6)
        way = (goal[i] - x[i]) / np.hypot(*(goal[i] - x[i]))
        drive = (np.hypot(*v[i]) * way[0] - v[i, 0]) / 0.7
        push = 0.6 * max(1.0 - closest, 0) / 0.7
        expected = drive + push + 0.3 * max(right, -0.5)
        np.testing.assert_allclose(acceleration[i], expected, rtol=1e-4)


def test_slope_of_equal_smallest_values_is_of_the_first() -> None:
    law = {
        "parameters": {"A": "1 1/s"},
        "smallest": {"closest": "d"},
        "rate": {"x": "A*closest", "y": "0*A*closest"},
    }
    model, place = formula(law), [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    batch = collate([people(np.array([place, place]), 0.04)])
    y = batch.x[0].clone().requires_grad_()
    model(torch.zeros(()), y, model.scene(batch))[0, 0, 0].backward()
    np.testing.assert_allclose(y.grad[0], [[-1, 0], [1, 0], [0, 0]], atol=1e-5)


def test_derivatives_of_a_law_with_a_smallest_value() -> None:
    options = model_options("cfsm")
    model, batch = build_model({**options, "desired": "direction"}), room().select([1])
    scene, zero = model.scene(batch), torch.zeros((), dtype=torch.float64)
    y = model.initial(batch).requires_grad_()
    assert torch.autograd.gradcheck(lambda y: model(zero, y, scene), (y,), eps=1e-7, atol=1e-5)


def test_cutoff_and_smallest_values() -> None:
    with pytest.raises(ConfigError, match="smallest values"):
        FusedSolver(cutoff=3.0)(formula(OWN_FORCES["smallest"]), room())
