"""Compiled traffic models against torchdiffeq's discrete gradient in float64."""

from __future__ import annotations

import pytest
import torch

from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError, DataError
from nnode.model import Law, Traffic, make_law
from nnode.simulation import FusedSolver
from nnode.simulation.kernels import lanes
from tests.simulation.fused.compare import compare, single
from tests.simulation.scenes import LAWS, crowd, platoon

pytestmark = pytest.mark.usefixtures("without_fallback")

DT = 0.01


@pytest.mark.parametrize("leader", ["constant", "measured"])
@pytest.mark.parametrize("items", ["ragged", "equal"])
@pytest.mark.parametrize("law", LAWS)
def test_states_and_gradient(law, items, leader, request) -> None:
    model = Traffic([LAWS[law]()], leader=leader).to(torch.float32).to(torch.float64)
    solvers = [FusedSolver(DT, threads) for threads in (1, 2, 3)]
    compare(model, single(request.getfixturevalue(items)), DT, *solvers, atol=1e-9)


# each precision has its own compilation
@pytest.mark.parametrize("leader", ["constant", "measured"])
@pytest.mark.parametrize("items", ["ragged", "equal"])
@pytest.mark.parametrize(
    "law", ["n4", *(pytest.param(law, marks=pytest.mark.thorough) for law in ("lin", "log"))]
)
def test_single_precision(law, items, leader, request) -> None:
    batch = single(request.getfixturevalue(items))
    model = Traffic([LAWS[law]()], leader=leader).to(torch.float32).to(torch.float64)
    close = {"limit": 1e-4, "rtol": 3e-7, "atol": 1e-4}
    compare(model, batch, DT, FusedSolver(DT), single_precision=True, **close)


@pytest.mark.parametrize(
    ("law", "items"),
    [
        # the law is constant below its smallest gap
        (make_law("log", v0=3.0, L=4.0), [platoon([1e-4, 5.0, -2.0], samples=3)]),
        (LAWS["lin"](), [platoon([15.0] * 30, samples=3, name=f"{i}") for i in range(50)]),
    ],
    ids=["small gaps", "long rows and many blocks"],
)
def test_unusual_platoons(law: Law, items: list[Sequence]) -> None:
    compare(Traffic([law]), single(items), DT, FusedSolver(DT, 2), atol=1e-9)


def test_second_backward_pass_and_no_gradient(ragged: list[Sequence]) -> None:
    batch, model, solver = collate(ragged), Traffic([LAWS["n4"]()]), FusedSolver(DT)
    x = solver(model, batch).x
    weights, cost = list(model.parameters()), x.square().sum()
    first, second = (
        torch.autograd.grad(cost, weights, retain_graph=True, allow_unused=True) for _ in range(2)
    )
    torch.testing.assert_close(first, second, rtol=0, atol=0)
    with torch.no_grad():
        without_gradient = solver(model, batch).x
    assert not without_gradient.requires_grad
    assert torch.equal(without_gradient, x)


def test_invalid_options_and_data() -> None:
    model = Traffic([make_law("lin")])
    with pytest.raises(ConfigError, match="threads=0"):
        FusedSolver(threads=0)
    with pytest.raises(ConfigError, match="does not divide"):
        FusedSolver(0.03)(model, collate([platoon([10.0])]))
    with pytest.raises(DataError, match="2"):
        FusedSolver(DT)(model, collate([crowd(2)]))


def test_subclass_with_code_is_not_compiled() -> None:
    class Slower(Law):
        def speed(self, gap: torch.Tensor) -> torch.Tensor:
            return super().speed(gap) / 2

    batch = collate([platoon([10.0])])
    assert lanes.supports(Traffic([make_law("lin")]), batch)
    assert not lanes.supports(Traffic([Slower("lin")]), batch)
    assert not lanes.supports(Traffic([make_law("lin"), make_law("lin")]), batch)
