"""Derivatives of simulated states by parameters, against autograd and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.data.sequence import Batch, collate
from nnode.model import Traffic, build_model
from nnode.model.arrays import Formulas
from nnode.model.effects.lane import ReactionDelay
from nnode.model.laws import CAR_FOLLOWING_LAWS
from nnode.model.tangent import with_tangents
from nnode.simulation import Solver, TorchdiffeqSolver
from nnode.simulation.kernels import lanes
from tests.model.following import DT, driven, model, set_
from tests.simulation.fused.compare import RungeKutta


def platoons(numbers: tuple[int, ...] = (4, 2, 3)) -> Batch:
    """Platoons of different lengths in vehicles and time, in a wave."""
    found = []
    for i, n in enumerate(numbers):
        t = DT * np.arange(9 - 2 * i)[:, None] - 0.3 * np.arange(n)[::-1]
        x = 12 * t + 2 * np.sin(t + i) + (22.3 + i) * np.arange(n)
        found.append(driven(DT * np.arange(len(t)), x, 12 + 2 * np.cos(t + i), 4.0, f"p{i}"))
    return collate(found)


def by_autograd(
    system: Traffic, batch: Batch, method: str | None, names: list[str], substeps: int
) -> tuple[Tensor, Tensor]:
    """Places at the samples and ``(P, K, B, N)`` their derivatives, one number after another."""
    solver: Solver = TorchdiffeqSolver(method, "discrete", batch.dt / substeps)
    if (method or system.step) == "rk4":
        solver = RungeKutta(substeps)
    x = solver(system, batch).x
    lane = system.formula
    assert lane is not None
    places = [lane.owned[name] for name in names]
    known = dict(system.named_parameters())
    out = torch.zeros(len(names), *x.shape[:3], dtype=x.dtype)
    for index in (batch.valid & (x[..., 0] == x[..., 0])).nonzero().tolist():
        k, b, i = index
        slopes = (
            torch.autograd.grad(
                x[k, b, i, 0], [known[p] for p, *_ in places], retain_graph=True, allow_unused=True
            )
            if x[k, b, i, 0].requires_grad
            else [None] * len(names)
        )
        for p, (slope, (_, place, _)) in enumerate(zip(slopes, places, strict=True)):
            if slope is not None:
                out[p, k, b, i] = slope.flatten()[place]
    return x.detach(), out


def compared(system: Traffic, batch: Batch, names: list[str], method: str | None = None) -> Tensor:
    """The tangents of places, after they were compared."""
    lane = lanes.supports(system, batch)
    assert lane is not None
    states, slopes = lanes.tangents(system, lane, batch, 2, names, method=method)
    x, wanted = by_autograd(system, batch, method, names, 2)
    follows = batch.valid & system.scene(batch).follower
    torch.testing.assert_close(states[..., 0][follows], x[..., 0][follows], rtol=1e-12, atol=1e-10)
    found = torch.where(follows, slopes[..., 0], 0.0)
    wanted = torch.where(follows, wanted, 0.0)
    for own, exact, name in zip(found, wanted, names, strict=True):
        assert exact.abs().max() > 0, name
        assert (own - exact).norm() <= 1e-10 * exact.norm(), name
    return slopes


def owned(system: Traffic) -> list[str]:
    lane = system.formula
    assert lane is not None
    return list(lane.owned)


def linear(*effects: dict[str, Any], leader: str = "measured") -> Traffic:
    found = build_model(
        {
            "term": "lin",
            "name": "lin",
            "leader": leader,
            "v0": 25.0,
            "L": 6.0,
            "L_min": 2.0,
            "effects": list(effects),
        }
    )
    assert isinstance(found, Traffic)
    return found


def test_of_speeds_that_depend_on_the_speed_ahead() -> None:
    """A first-order law with a recursion along the platoon, and a leader at v0."""
    system = linear({"name": "relative_speed", "kappa": 0.4}, leader="constant")
    slopes = compared(system, platoons(), owned(system))
    # the leader of the first platoon drives at v0: x = x_0 + v0 t
    time = DT * torch.arange(9, dtype=torch.float64)
    torch.testing.assert_close(slopes[0, :, 0, 3, 0], time, rtol=1e-13, atol=1e-14)


def test_of_a_delay_between_two_steps() -> None:
    """Newell's law: d and T are all that places depend on, once its leader's path has come."""
    short = {**CAR_FOLLOWING_LAWS["newell"], "remembered": 4}  # compiles in a few seconds
    system = set_(model(short), T=0.13, d=16.6, v0=50)  # steps are 0.05 s
    slopes = compared(system, platoons((3,)), ["mine__T", "mine__d"])
    follower = slopes[1, -1, 0, 1, 0]  # behind the leader: d further back
    assert float(follower) == pytest.approx(-1, rel=1e-12)
    assert float(slopes[1, -1, 0, 0, 0]) == pytest.approx(-2, rel=1e-9)


def test_every_sequence_with_parameters_of_its_own() -> None:
    system, batch, names = model("idm"), platoons(), ["idm__T", "idm__s0"]
    lane = lanes.supports(system, batch)
    assert lane is not None
    each = torch.tensor([[0.9, 2.0], [1.4, 3.0], [1.1, 1.5]], dtype=torch.float64)
    states, slopes = lanes.tangents(system, lane, batch, 2, names, each=each)
    for b, (T, s0) in enumerate(each.tolist()):
        own = set_(model("idm"), T=T, s0=s0)
        x, wanted = by_autograd(own, batch, None, names, 2)
        follows = batch.valid[:, b] & own.scene(batch).follower[b]
        torch.testing.assert_close(
            states[:, b, :, 0][follows], x[:, b, :, 0][follows], rtol=1e-12, atol=1e-10
        )
        found, exact = slopes[:, :, b, :, 0][:, follows], wanted[:, :, b][:, follows]
        assert (found - exact).norm() <= 1e-10 * exact.norm()
        assert exact.abs().max() > 0


def test_of_starts_that_depend_on_the_law_and_on_measured_speeds() -> None:
    """Of first order: the gap opens at the start as the law says; a leader's speed is measured."""
    system = linear({"name": ReactionDelay.name, "T": 0.4})
    compared(system, platoons(), owned(system))


def test_their_formulas_are_the_slopes_of_the_rate() -> None:
    """Of v0 (1 - L/gap): by v0 the rate 1 - L/gap and v0 L/gap² times the gap's own tangent."""
    lane = linear().formula
    assert lane is not None
    twice = with_tangents(lane, ("lin__v0", "lin__L"))
    assert list(twice.rates) == ["x", "x__d0", "x__d1"]
    assert twice.rates["x"] is lane.rates["x"]
    given = {
        "x": 3.0,
        "x_1": 23.0,
        "lin__v0": 25.0,
        "lin__L": 6.0,
        "x__d0": 0.5,
        "x__d0_1": 2.0,
        "x__d1": -1.0,
        "x__d1_1": 0.0,
    }
    values = {k: torch.tensor(v, dtype=torch.float64) for k, v in given.items()}
    by_v0, by_L = Formulas([twice.rates["x__d0"], twice.rates["x__d1"]])(values)
    steep = 25 * 6 / 20**2
    assert float(by_v0) == pytest.approx(1 - 6 / 20 + steep * 1.5, rel=1e-14)
    assert float(by_L) == pytest.approx(-25 / 20 + steep * 1.0, rel=1e-14)
