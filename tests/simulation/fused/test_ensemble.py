"""Runs side by side are the runs one after the other."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nnode.errors import ConfigError
from nnode.model import Crowd, Traffic, make_law
from nnode.simulation import FusedSolver
from nnode.simulation.kernels import lanes
from tests.builders import social_forces
from tests.simulation.fused.compare import difference, single
from tests.simulation.fused.test_fallback import Sway
from tests.simulation.scenes import crowd, platoon

DT = 0.02

MODELS = {
    "lin": lambda: Traffic([make_law("lin", v0=18.0, L=4.0)]),
    "log": lambda: Traffic([make_law("log", v0=18.0, L=6.0)], leader="measured"),
    "n4": lambda: Traffic(
        [make_law("network_speed", hidden=4, v0=18.0, generator=torch.Generator().manual_seed(3))]
    ),
    "fallback": lambda: Traffic([make_law("lin", v0=18.0, L=4.0), Sway()]),
    "crowd": lambda: Crowd(social_forces(B=0.1)),
}


def spread(model: torch.nn.Module, runs: int) -> dict[str, Tensor]:
    """Parameters scattered around the model's own, as leaves."""
    draw = torch.Generator().manual_seed(2)
    return {
        name: (p * (1 + 0.1 * torch.rand(runs, *p.shape, generator=draw, dtype=p.dtype)))
        .detach()
        .requires_grad_()
        for name, p in model.named_parameters()
    }


#: Laws that are compiled like the others, for as long.
LONG = ("log", "n4")


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.thorough if n in LONG else ()) for n in MODELS],
)
def test_every_run_is_its_own(name, threads, ragged) -> None:  # type: ignore[no-untyped-def]
    people = [crowd(3, samples=4, name="a"), crowd(2, samples=3, name="b")]
    batch = single(people if name == "crowd" else ragged)
    model, solver = MODELS[name](), FusedSolver(DT, threads)
    parameters = spread(model, 3)
    together = solver.ensemble(model, parameters, batch).x
    k, b, n, d = batch.x.shape
    assert together.shape == (k, 3, b, n, d)
    weight = torch.arange(1.0, 4.0, dtype=together.dtype)[:, None, None, None]
    mask = batch.valid[:, None, :, :, None]
    (weight * together).masked_fill(~mask, 0.0).square().sum().backward()
    for r in range(3):
        with torch.no_grad():
            for key, p in model.named_parameters():
                p.copy_(parameters[key][r])
        model.zero_grad()
        alone = solver(model, batch).x
        one = together[:, r].detach()[:, batch.agent]
        torch.testing.assert_close(one, alone.detach()[:, batch.agent], rtol=1e-14, atol=1e-13)
        ((r + 1) * alone).masked_fill(~batch.valid[..., None], 0.0).square().sum().backward()
        for key, p in model.named_parameters():
            share = parameters[key].grad
            assert share is not None
            if p.grad is not None and p.grad.abs().max() > 0:
                assert difference(share[r], p.grad) < 1e-10, key


def test_missing_parameters_are_the_own_ones(ragged) -> None:  # type: ignore[no-untyped-def]
    batch, model = single(ragged), Traffic([make_law("lin", v0=18.0, L=4.0)])
    lengths = torch.tensor([3.0, 4.0], dtype=torch.float64)
    results = FusedSolver(DT).ensemble(model, {"terms.0.L": lengths}, batch).x
    torch.testing.assert_close(results[:, 1], FusedSolver(DT)(model, batch).x, rtol=0, atol=0)
    assert (results[:, 0] - results[:, 1]).abs().max() > 0.01


def test_a_run_that_blows_up_stays_alone() -> None:
    batch, model = single([platoon([10.0, 6.0])]), Traffic([make_law("lin", v0=18.0, L=4.0)])
    v0 = torch.tensor([18.0, float("nan")], dtype=torch.float64, requires_grad=True)
    x = FusedSolver(DT).ensemble(model, {"terms.0.v0": v0}, batch).x
    assert x[:, 0].isfinite().all()
    assert not x[1:, 1].isfinite().any()
    x[:, 0].sum().backward()
    assert v0.grad is not None
    assert v0.grad[0].isfinite()


def test_refusals(ragged) -> None:  # type: ignore[no-untyped-def]
    batch, model, solver = single(ragged), Traffic([make_law("lin")]), FusedSolver(DT)
    with pytest.raises(ConfigError, match=r"\['terms\.0\.M'\].*terms\.0\.v0, terms\.0\.L"):
        solver.ensemble(model, {"terms.0.M": torch.ones(2)}, batch)
    with pytest.raises(ConfigError, match="found none"):
        solver.ensemble(model, {}, batch)
    with pytest.raises(ConfigError, match="shape"):
        solver.ensemble(model, {"terms.0.L": torch.ones(())}, batch)
    with pytest.raises(ConfigError, match="same R"):
        solver.ensemble(model, {"terms.0.L": torch.ones(2), "terms.0.v0": torch.ones(3)}, batch)


@pytest.mark.parametrize(
    "dtype", [torch.float64, pytest.param(torch.float32, marks=pytest.mark.thorough)]
)
@pytest.mark.parametrize(
    "name", ["lin", *(pytest.param(law, marks=pytest.mark.thorough) for law in LONG)]
)
def test_both_arrangements_agree(name, dtype, equal, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    batch, model = single(equal).to(dtype=dtype), MODELS[name]().to(dtype)
    results = []
    for enough in (0, 10_000):
        monkeypatch.setattr(lanes, "_ENOUGH", enough)
        parameters = spread(model, 5)
        x = FusedSolver(DT).ensemble(model, parameters, batch).x
        (x - batch.x[:, None]).square().sum().backward()
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters.values()]
        results.append((x.detach(), torch.cat([g.flatten() for g in grads])))
    small = torch.finfo(dtype).eps
    torch.testing.assert_close(results[0][0], results[1][0], rtol=10 * small, atol=100 * small)
    assert difference(results[0][1], results[1][1]) < 1e3 * small
