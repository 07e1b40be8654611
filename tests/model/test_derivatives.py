"""Derivatives of forces by finite differences, in double precision, off the kinks.

Those of laws of the gap are tested in ``tests/simulation/test_gradients.py``.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import functional_call

from nnode.data.sequence import collate
from nnode.model import Scene, State, Term, make_law
from tests.builders import straight

#: Distances of two people: overlapping, barely touching, barely apart, out of reach (2 r = 0.5 m).
DISTANCES = [0.2, 0.499, 0.501, 2.0]


def check(term: Term, x: Tensor, v: Tensor, scene: Scene) -> None:
    """gradcheck of the term with respect to state and parameters."""
    names = [name for name, _ in term.named_parameters()]
    values = [p.detach().clone() for p in term.parameters()]

    def f(x: Tensor, v: Tensor, *values: Tensor) -> Tensor:
        state = State(torch.zeros(()), x, v, scene)
        return functional_call(term, dict(zip(names, values, strict=True)), (state,))

    inputs = tuple(value.clone().requires_grad_() for value in (x, v, *values))
    assert torch.autograd.gradcheck(f, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize(
    "term",
    [
        make_law("relaxation", tau=0.5),
        make_law("social_force", A=2.0, k=30.0, kappa=9.0, B=0.1),
        make_law("social_force", A=2.0, k=30.0, kappa=9.0, B=0.1, opposing_wall_friction=True),
        make_law("network_force", hidden=4, generator=torch.Generator().manual_seed(1)),
    ],
    ids=["relaxation", "social_force", "social_force_opposing", "network_force"],
)
@pytest.mark.parametrize("distance", DISTANCES)
def test_crowd(term: Term, distance: float) -> None:
    # the third person's distance to the wall's nearest point is distance / 2: the same cases
    x = np.array([[0.0, 1.2], [0.6 * distance, 1.2 + 0.8 * distance], [1.0, distance / 2]])
    v = np.array([[1.1, 0.2], [-0.7, 0.4], [0.9, -0.3]])
    walls = np.array([[0.0, 0.0, 2.0, 0.0]])
    batch = collate([straight(x, v, 2, 1.0, destination=x + np.array([3.0, 0.5]), walls=walls)])
    check(term, batch.x[0], batch.v[0], Scene.of(batch, 1.0))


@pytest.mark.parametrize(
    "term",
    [make_law("social_force", A=2.0, k=30.0, kappa=9.0), make_law("relaxation")],
    ids=lambda t: t.name,
)
def test_people_at_one_place_and_at_rest_have_a_finite_gradient(term: Term) -> None:
    x = np.zeros((2, 2))
    batch = collate([straight(x, x, 2, 1.0, destination=x)])
    place, speed = batch.x[0].clone().requires_grad_(), batch.v[0].clone().requires_grad_()
    force = term(State(torch.zeros(()), place, speed, Scene.of(batch)))
    gradients = torch.autograd.grad(force.sum(), [place, speed, *term.parameters()])
    assert force.isfinite().all()
    assert all(g.isfinite().all() for g in gradients)
