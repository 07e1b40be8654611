"""Smallest and largest values over others, against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnode.app.python.inputs import model_options
from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError
from nnode.model import System, build_model
from nnode.simulation import FusedSolver
from tests.simulation.test_engines import OWN_FORCES, room


def many() -> System:
    """Of second order, with two smallest values and a largest that names the former's inputs."""
    options = {"term": "formula", "name": "mine", "leader": "measured", "effects": []}
    return build_model({**options, "law": OWN_FORCES["smallest"]})


def test_a_smallest_value_by_loops() -> None:
    model, batch = many(), room().select([0])
    rates = (
        model(torch.zeros(()), model.initial(batch), model.scene(batch))[0, :, 2].detach().numpy()
    )
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
        np.testing.assert_allclose(rates[i], drive + push + 0.3 * max(right, -0.5), rtol=1e-4)


def test_the_first_of_several_has_the_slope() -> None:
    # two others at the same distance: the slope by x is that of the first of them alone
    law = {
        "parameters": {"A": "1 1/s"},
        "smallest": {"closest": "d"},
        "rate": {"x": "A*closest", "y": "0*A*closest"},
    }
    options = {"term": "formula", "name": "mine", "leader": "measured", "effects": []}
    model = build_model({**options, "law": law})
    place = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]], dtype=torch.float64)
    still = Sequence(
        name="a", recording="a", time=0.04 * np.arange(2.0), x=place.repeat(2, 1, 1).numpy()
    )
    batch = collate([still])
    y = place.clone().requires_grad_()
    model(torch.zeros(()), y, model.scene(batch))[0, 0, 0].backward()
    assert y.grad is not None
    np.testing.assert_allclose(y.grad[0], [[-1, 0], [1, 0], [0, 0]], atol=1e-5)


def test_derivatives_of_a_law_with_a_smallest_value() -> None:
    options = model_options("cfsm")
    model, batch = build_model({**options, "desired": "direction"}), room().select([1])
    scene, zero = model.scene(batch), torch.zeros((), dtype=torch.float64)
    y = model.initial(batch).requires_grad_()
    assert torch.autograd.gradcheck(lambda y: model(zero, y, scene), (y,), eps=1e-7, atol=1e-5)


def test_a_cutoff_is_refused() -> None:
    with pytest.raises(ConfigError, match="smallest values"):
        FusedSolver(cutoff=3.0)(many(), room())
