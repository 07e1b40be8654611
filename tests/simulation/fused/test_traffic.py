"""Compiled traffic models against torchdiffeq's discrete gradient in float64."""

from __future__ import annotations

from functools import partial

import pytest
import torch

from nnode.data.sequence import collate
from nnode.errors import ConfigError, DataError
from nnode.model import Law, Traffic, make_law
from nnode.simulation import FusedSolver, TorchdiffeqSolver, fused
from nnode.simulation.kernels import lanes
from tests.simulation.fused.compare import difference, gradient, single
from tests.simulation.scenes import crowd, platoon

DT = 0.01


def network(hidden: int) -> Law:
    return make_law(
        "network_speed", hidden=hidden, v0=18.0, generator=torch.Generator().manual_seed(3)
    )


LAWS = {
    "lin": lambda: make_law("lin", v0=18.0, L=4.0),
    "log": lambda: make_law("log", v0=18.0, L=6.0),
    "n4": partial(network, 4),
}


@pytest.fixture(autouse=True)
def compiled_only(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """No test here may pass because the fallback is right."""

    def refuse(*args: object) -> None:
        raise AssertionError("the fallback was called")

    monkeypatch.setattr(fused, "TorchdiffeqSolver", refuse)


@pytest.mark.parametrize("leader", ["constant", "measured"])
@pytest.mark.parametrize("items", ["ragged", "equal"])
@pytest.mark.parametrize("law", LAWS)
def test_states_and_gradient(law, items, leader, request) -> None:  # type: ignore[no-untyped-def]
    batch = single(request.getfixturevalue(items))
    model = Traffic([LAWS[law]()], leader=leader).to(torch.float32).to(torch.float64)
    exact, wanted = gradient(model, TorchdiffeqSolver("euler", "discrete", DT), batch)
    assert wanted.abs().max() > 0
    for threads in (1, 2, 3):
        found, own = gradient(model, FusedSolver(DT, threads), batch)
        torch.testing.assert_close(found.x, exact.x, rtol=1e-13, atol=1e-9)
        assert difference(own, wanted) < 1e-10


# each precision is compiled for
@pytest.mark.parametrize("leader", ["constant", "measured"])
@pytest.mark.parametrize("items", ["ragged", "equal"])
@pytest.mark.parametrize(
    "law", ["n4", *(pytest.param(law, marks=pytest.mark.thorough) for law in ("lin", "log"))]
)
def test_single_precision(law, items, leader, request) -> None:  # type: ignore[no-untyped-def]
    batch = single(request.getfixturevalue(items))
    model = Traffic([LAWS[law]()], leader=leader).to(torch.float32).to(torch.float64)
    exact, wanted = gradient(model, TorchdiffeqSolver("euler", "discrete", DT), batch)
    found, own = gradient(model.to(torch.float32), FusedSolver(DT), batch.to(dtype=torch.float32))
    assert {p.grad.dtype for p in model.parameters()} == {torch.float32}
    measured = batch.valid[..., None].expand_as(exact.x)
    torch.testing.assert_close(found.x[measured].double(), exact.x[measured], rtol=3e-7, atol=1e-4)
    assert difference(own, wanted) < 1e-4


def test_small_gaps_of_the_logarithm() -> None:
    # the law is held constant below its smallest gap
    batch = single([platoon([1e-4, 5.0, -2.0], samples=3)])
    model = Traffic([make_law("log", v0=3.0, L=4.0)])
    exact, wanted = gradient(model, TorchdiffeqSolver("euler", "discrete", DT), batch)
    found, own = gradient(model, FusedSolver(DT), batch)
    torch.testing.assert_close(found.x, exact.x, rtol=1e-13, atol=1e-9)
    assert difference(own, wanted) < 1e-10


def test_backward_twice(ragged) -> None:  # type: ignore[no-untyped-def]
    batch, model = collate(ragged), Traffic([network(4)])
    cost = FusedSolver(DT)(model, batch).x.square().sum()
    weights = list(model.parameters())
    once = torch.autograd.grad(cost, weights, retain_graph=True, allow_unused=True)
    again = torch.autograd.grad(cost, weights, allow_unused=True)
    for a, b in zip(once, again, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_without_gradient_nothing_is_stored(equal) -> None:  # type: ignore[no-untyped-def]
    batch, model = collate(equal), Traffic([network(4)])
    with torch.no_grad():
        found = FusedSolver(DT)(model, batch).x
    assert not found.requires_grad
    torch.testing.assert_close(found, FusedSolver(DT)(model, batch).x.detach(), rtol=0, atol=0)


def test_long_rows_and_many_blocks() -> None:
    batch = single([platoon([15.0] * 30, samples=3, name=f"{i}") for i in range(50)])
    model = Traffic([make_law("lin", v0=18.0, L=4.0)])
    exact, wanted = gradient(model, TorchdiffeqSolver("euler", "discrete", DT), batch)
    found, own = gradient(model, FusedSolver(DT, 2), batch)
    torch.testing.assert_close(found.x, exact.x, rtol=1e-13, atol=1e-9)
    assert difference(own, wanted) < 1e-10


def test_refusals() -> None:
    with pytest.raises(ConfigError, match="threads=0"):
        FusedSolver(threads=0)
    with pytest.raises(ConfigError, match="does not divide"):
        FusedSolver(0.03)(Traffic([make_law("lin")]), collate([platoon([10.0])]))
    with pytest.raises(DataError, match="2"):
        FusedSolver(DT)(Traffic([make_law("lin")]), collate([crowd(2)]))


def test_code_of_one_s_own_is_not_taken_for_the_formula() -> None:
    class Slower(Law):
        def speed(self, gap: torch.Tensor) -> torch.Tensor:
            return super().speed(gap) / 2

    batch = collate([platoon([10.0])])
    assert lanes.supports(Traffic([make_law("lin")]), batch)
    assert not lanes.supports(Traffic([Slower("lin")]), batch)
    assert not lanes.supports(Traffic([make_law("lin"), make_law("lin")]), batch)
