"""Simultaneous runs against single runs."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from nnode.errors import ConfigError
from nnode.model import Crowd, Traffic
from nnode.simulation import FusedSolver
from nnode.simulation.kernels import lanes
from tests.builders import social_forces
from tests.simulation.fused.compare import difference, flat_gradient, single
from tests.simulation.fused.test_fallback import Sway
from tests.simulation.scenes import LAWS, crowd, platoon

DT = 0.02

MODELS = {
    "lin": lambda: Traffic([LAWS["lin"]()]),
    "log": lambda: Traffic([LAWS["log"]()], leader="measured"),
    "n4": lambda: Traffic([LAWS["n4"]()]),
    "fallback": lambda: Traffic([LAWS["lin"](), Sway()]),
    "crowd": lambda: Crowd(social_forces(B=0.1)),
}


def spread(model: torch.nn.Module, runs: int) -> dict[str, Tensor]:
    """Parameters near those of the model, with gradients."""
    draw, parameters = torch.Generator().manual_seed(2), {}
    for name, p in model.named_parameters():
        factor = 1 + 0.1 * torch.rand(runs, *p.shape, generator=draw, dtype=p.dtype)
        parameters[name] = (p * factor).detach().requires_grad_()
    return parameters


#: Laws with a long compilation.
LONG = ("log", "n4")


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.thorough if n in LONG else ()) for n in MODELS],
)
def test_states_and_gradients_of_runs(name, threads, ragged) -> None:
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
        states = (path.detach()[:, batch.agent] for path in (together[:, r], alone))
        torch.testing.assert_close(*states, rtol=1e-14, atol=1e-13)
        ((r + 1) * alone).masked_fill(~batch.valid[..., None], 0.0).square().sum().backward()
        for key, p in model.named_parameters():
            assert parameters[key].grad is not None
            if p.grad is not None and p.grad.abs().max() > 0:
                assert difference(parameters[key].grad[r], p.grad) < 1e-10, key


def test_other_parameters_are_those_of_the_model(ragged) -> None:
    batch, model = single(ragged), MODELS["lin"]()
    lengths = torch.tensor([3.0, 4.0], dtype=torch.float64)
    results = FusedSolver(DT).ensemble(model, {"terms.0.L": lengths}, batch).x
    torch.testing.assert_close(results[:, 1], FusedSolver(DT)(model, batch).x, rtol=0, atol=0)
    assert (results[:, 0] - results[:, 1]).abs().max() > 0.01


def test_divergent_run_does_not_affect_others() -> None:
    batch, model = single([platoon([10.0, 6.0])]), MODELS["lin"]()
    v0 = torch.tensor([18.0, float("nan")], dtype=torch.float64, requires_grad=True)
    x = FusedSolver(DT).ensemble(model, {"terms.0.v0": v0}, batch).x
    assert x[:, 0].isfinite().all()
    assert not x[1:, 1].isfinite().any()
    x[:, 0].sum().backward()
    assert v0.grad[0].isfinite()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"terms.0.M": torch.ones(2)}, r"\['terms\.0\.M'\].*terms\.0\.v0, terms\.0\.L"),
        ({}, "found none"),
        ({"terms.0.L": torch.ones(())}, "shape"),
        ({"terms.0.L": torch.ones(2), "terms.0.v0": torch.ones(3)}, "same R"),
    ],
)
def test_invalid_parameters(parameters: dict[str, Tensor], message: str, ragged) -> None:
    with pytest.raises(ConfigError, match=message):
        FusedSolver(DT).ensemble(MODELS["lin"](), parameters, single(ragged))


@pytest.mark.parametrize(
    "dtype", [torch.float64, pytest.param(torch.float32, marks=pytest.mark.thorough)]
)
@pytest.mark.parametrize(
    "name", ["lin", *(pytest.param(law, marks=pytest.mark.thorough) for law in LONG)]
)
def test_memory_layouts_agree(name, dtype, equal, monkeypatch) -> None:
    batch, model = single(equal).to(dtype=dtype), MODELS[name]().to(dtype)
    results = []
    for enough in (0, 10_000):
        monkeypatch.setattr(lanes, "_ENOUGH", enough)
        parameters = spread(model, 5)
        x = FusedSolver(DT).ensemble(model, parameters, batch).x
        (x - batch.x[:, None]).square().sum().backward()
        results.append((x.detach(), flat_gradient(parameters.values())))
    states, gradients = zip(*results, strict=True)
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(*states, rtol=10 * eps, atol=100 * eps)
    assert difference(*gradients) < 1e3 * eps
