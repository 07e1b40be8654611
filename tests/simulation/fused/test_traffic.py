"""Compiled traffic models against torchdiffeq's discrete gradient in float64."""

from __future__ import annotations

import pytest
import torch

from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError, DataError
from nnode.model import Law, Traffic, make_law
from nnode.simulation import FusedSolver, fused
from nnode.simulation.kernels import lanes
from tests.simulation.fused.compare import compare, single
from tests.simulation.scenes import crowd, platoon

DT = 0.01
LAWS = {
    "lin": lambda: make_law("lin", v0=18.0, L=4.0),
    "log": lambda: make_law("log", v0=18.0, L=6.0),
    "n4": lambda: make_law(
        "network_speed", hidden=4, v0=18.0, generator=torch.Generator().manual_seed(3)
    ),
}


@pytest.fixture(autouse=True)
def compiled_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test here may pass because the fallback is right."""
    monkeypatch.delattr(fused, "TorchdiffeqSolver")


@pytest.mark.parametrize("leader", ["constant", "measured"])
@pytest.mark.parametrize("items", ["ragged", "equal"])
@pytest.mark.parametrize("law", LAWS)
def test_states_and_gradient(law, items, leader, request) -> None:  # type: ignore[no-untyped-def]
    model = Traffic([LAWS[law]()], leader=leader).to(torch.float32).to(torch.float64)
    solvers = [FusedSolver(DT, threads) for threads in (1, 2, 3)]
    compare(model, single(request.getfixturevalue(items)), DT, *solvers, atol=1e-9)


# each precision is compiled for
@pytest.mark.parametrize("leader", ["constant", "measured"])
@pytest.mark.parametrize("items", ["ragged", "equal"])
@pytest.mark.parametrize(
    "law", ["n4", *(pytest.param(law, marks=pytest.mark.thorough) for law in ("lin", "log"))]
)
def test_single_precision(law, items, leader, request) -> None:  # type: ignore[no-untyped-def]
    batch = single(request.getfixturevalue(items))
    model = Traffic([LAWS[law]()], leader=leader).to(torch.float32).to(torch.float64)
    close = {"limit": 1e-4, "rtol": 3e-7, "atol": 1e-4}
    compare(model, batch, DT, FusedSolver(DT), single_precision=True, **close)


@pytest.mark.parametrize(
    ("law", "items"),
    [
        # the law is held constant below its smallest gap
        (make_law("log", v0=3.0, L=4.0), [platoon([1e-4, 5.0, -2.0], samples=3)]),
        (LAWS["lin"](), [platoon([15.0] * 30, samples=3, name=f"{i}") for i in range(50)]),
    ],
    ids=["small gaps", "long rows and many blocks"],
)
def test_unusual_platoons(law: Law, items: list[Sequence]) -> None:
    compare(Traffic([law]), single(items), DT, FusedSolver(DT, 2), atol=1e-9)


def test_backward_twice_and_without_gradient(ragged: list[Sequence]) -> None:
    batch, model, solver = collate(ragged), Traffic([LAWS["n4"]()]), FusedSolver(DT)
    x = solver(model, batch).x
    weights, cost = list(model.parameters()), x.square().sum()
    once = torch.autograd.grad(cost, weights, retain_graph=True, allow_unused=True)
    second = torch.autograd.grad(cost, weights, allow_unused=True)
    for a, b in zip(once, second, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    with torch.no_grad():
        same = solver(model, batch).x
    assert not same.requires_grad
    assert torch.equal(same, x)


def test_refusals() -> None:
    model = Traffic([make_law("lin")])
    with pytest.raises(ConfigError, match="threads=0"):
        FusedSolver(threads=0)
    with pytest.raises(ConfigError, match="does not divide"):
        FusedSolver(0.03)(model, collate([platoon([10.0])]))
    with pytest.raises(DataError, match="2"):
        FusedSolver(DT)(model, collate([crowd(2)]))


def test_code_of_one_s_own_is_not_taken_for_the_formula() -> None:
    class Slower(Law):
        def speed(self, gap: torch.Tensor) -> torch.Tensor:
            return super().speed(gap) / 2

    batch = collate([platoon([10.0])])
    assert lanes.supports(Traffic([make_law("lin")]), batch)
    assert not lanes.supports(Traffic([Slower("lin")]), batch)
    assert not lanes.supports(Traffic([make_law("lin"), make_law("lin")]), batch)
