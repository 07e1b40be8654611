"""Costs and gradients of ensembles against single runs with torchdiffeq."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from nnode.calibrate.cost import Convention, sequence_costs
from nnode.calibrate.ensemble import EnsembleCost
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch, collate
from nnode.model.build import build_model
from nnode.model.system import System
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from tests.builders import lane

DT = 0.02
N4 = {
    "name": "n4",
    "term": "network_speed",
    "hidden": 4,  # as in other tests, because code is compiled per number of neurons
    "v0": 20.0,
    "leader": "constant",
    "box": 0.9,
}
LIN = {"name": "lin", "term": "lin", "v0": 20.0, "L": 4.0, "L_min": 2.0, "leader": "constant"}


@pytest.fixture(scope="module")
def batch() -> Batch:
    draw = np.random.default_rng(0)
    items = []
    for n, samples in ((3, 6), (4, 4)):
        t = 0.2 * np.arange(samples)[:, None]
        x = 14.0 * np.arange(n) + 18 * t + 0.3 * draw.standard_normal((samples, n))
        items.append(lane(x, name=f"s/{n}"))
    return collate(items).to(dtype=torch.float64)


def ensemble(
    batch: Batch, options: dict[str, Any] = LIN, convention: Convention = Convention.integral
) -> EnsembleCost:
    return EnsembleCost(build_model(options), batch, FusedSolver(DT), convention)


def reference(system: System, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Costs of sequences, and the gradient of their mean, by torchdiffeq."""
    system.zero_grad()
    costs = sequence_costs(TorchdiffeqSolver("euler", "discrete", DT)(system, batch), batch)
    costs.mean().backward()
    grads = [p.grad.flatten() for p in system.parameters() if p.grad is not None]
    return costs.detach(), torch.cat(grads)


@pytest.mark.parametrize("options", [N4, LIN], ids=["n4", "lin"])
def test_costs_and_gradients_as_single_runs(options: dict[str, Any], batch: Batch) -> None:
    cost = ensemble(batch, options)
    draw = torch.Generator().manual_seed(1)
    rows = torch.stack([ParameterVector(build_model(options, seed)).row for seed in range(3)])
    rows = rows * (1 + 0.05 * torch.rand(rows.shape, generator=draw, dtype=torch.float64))
    value, gradient = cost(rows)
    each = cost.costs(rows)
    for r in range(3):
        system = ParameterVector(build_model(options)).fill_(rows[r])
        torch.testing.assert_close(ParameterVector(system).row, rows[r])
        costs, slope = reference(system, batch)
        torch.testing.assert_close(each[r], costs, rtol=1e-10, atol=0)
        torch.testing.assert_close(value[r], costs.mean(), rtol=1e-10, atol=0)
        torch.testing.assert_close(gradient[r], slope, rtol=1e-8, atol=1e-10)


def test_weights_of_sequences(batch: Batch) -> None:
    cost = ensemble(batch)
    rows = cost.vector.row.expand(2, -1)
    value, gradient = cost(rows, torch.tensor([[1.0, 0.0], [0.25, 0.75]], dtype=torch.float64))
    each = cost.costs(rows)[0]
    assert value[0] == pytest.approx(float(each[0]))
    assert value[1] == pytest.approx(float(0.25 * each[0] + 0.75 * each[1]))
    assert not torch.allclose(gradient[0], gradient[1])


def test_conventions_differ_by_the_sampling_interval(batch: Batch) -> None:
    integral, total = (
        ensemble(batch, convention=convention)
        for convention in (Convention.integral, Convention.sum)
    )
    row = total.vector.row[None]
    torch.testing.assert_close(integral.costs(row), 0.2 * total.costs(row))


def test_bounds_are_those_of_the_model(batch: Batch) -> None:
    law = ensemble(batch)
    low = dict(zip(law.vector.names, law.low.tolist(), strict=True))
    assert low == {"terms.0.L": 2.0, "terms.0.v0": -math.inf}
    assert law.high.tolist() == [math.inf] * 2
    network = ensemble(batch, N4)
    assert len(network.low) == 1 + 4 + 4 + 4 + 1
    assert sorted(set(network.high.tolist())) == [0.9, math.inf]


def test_diverging_run_has_infinite_cost_and_does_not_affect_others(batch: Batch) -> None:
    cost = ensemble(batch)
    good = cost.vector.row
    bad = good.clone()
    bad[cost.vector.names.index("terms.0.v0")] = 1e300
    each = cost.costs(torch.stack([good, bad]))
    assert torch.isfinite(each[0]).all()
    assert torch.isinf(each[1]).all()
    torch.testing.assert_close(each[0], cost.costs(good[None])[0])


def test_diverging_sequence_without_weight_does_not_affect_the_gradient(
    batch: Batch, monkeypatch: pytest.MonkeyPatch
) -> None:
    single = batch.to(dtype=torch.float32)
    diverging = single.select([0, 1])
    diverging.x[0, 1, 0] = -3.4e38  # the network's response to this gap is infinite
    system = build_model(N4, dtype=torch.float32)
    cost = EnsembleCost(system, diverging, FusedSolver(DT))
    called = []
    original = EnsembleCost._gradient_of_weighted
    monkeypatch.setattr(
        EnsembleCost, "_gradient_of_weighted", lambda *args: called.append(1) or original(*args)
    )
    row = ParameterVector(system).row[None]
    value, gradient = cost(row, torch.tensor([[1.0, 0.0]], dtype=torch.float64))
    assert called
    expected, slope = EnsembleCost(system, single.select([0]), FusedSolver(DT))(row)
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(gradient, slope, rtol=1e-5, atol=1e-5)
