"""Costs and gradients of many runs against one run at a time through torchdiffeq."""

from __future__ import annotations

import math

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
    "hidden": 4,  # as elsewhere: each number of neurons is compiled for
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


def one_by_one(system: System, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Costs by sequence, and the gradient of their mean, by another solver."""
    system.zero_grad()
    found = sequence_costs(TorchdiffeqSolver("euler", "discrete", DT)(system, batch), batch)
    found.mean().backward()
    grads = [p.grad.flatten() for p in system.parameters() if p.grad is not None]
    return found.detach(), torch.cat(grads)


@pytest.mark.parametrize("options", [N4, LIN], ids=["n4", "lin"])
def test_as_single_runs(options: dict, batch: Batch) -> None:  # type: ignore[type-arg]
    cost = EnsembleCost(build_model(options), batch, FusedSolver(DT))
    draw = torch.Generator().manual_seed(1)
    rows = torch.stack([ParameterVector(build_model(options, seed)).row for seed in range(3)])
    rows = rows * (1 + 0.05 * torch.rand(rows.shape, generator=draw, dtype=torch.float64))
    value, gradient = cost(rows)
    each = cost.costs(rows)
    for r in range(3):
        system = ParameterVector(build_model(options)).fill_(rows[r])
        torch.testing.assert_close(ParameterVector(system).row, rows[r])
        costs, slope = one_by_one(system, batch)
        torch.testing.assert_close(each[r], costs, rtol=1e-10, atol=0)
        torch.testing.assert_close(value[r], costs.mean(), rtol=1e-10, atol=0)
        torch.testing.assert_close(gradient[r], slope, rtol=1e-8, atol=1e-10)


def test_weights_choose_sequences(batch: Batch) -> None:
    cost = EnsembleCost(build_model(LIN), batch, FusedSolver(DT))
    rows = ParameterVector(build_model(LIN)).row.expand(2, -1)
    value, gradient = cost(rows, torch.tensor([[1.0, 0.0], [0.25, 0.75]], dtype=torch.float64))
    each = cost.costs(rows)[0]
    assert value[0] == pytest.approx(float(each[0]))
    assert value[1] == pytest.approx(float(0.25 * each[0] + 0.75 * each[1]))
    assert not torch.allclose(gradient[0], gradient[1])


def test_conventions_differ_by_the_sampling_interval(batch: Batch) -> None:
    row = ParameterVector(build_model(LIN)).row[None]
    found = [
        EnsembleCost(build_model(LIN), batch, FusedSolver(DT), convention).costs(row)
        for convention in (Convention.integral, Convention.sum)
    ]
    torch.testing.assert_close(found[0], 0.2 * found[1])


def test_the_admissible_set_comes_from_the_model(batch: Batch) -> None:
    law = EnsembleCost(build_model(LIN), batch, FusedSolver(DT))
    limits = dict(
        zip(law.vector.names, zip(law.low.tolist(), law.high.tolist(), strict=True), strict=True)
    )
    assert limits["terms.0.L"] == (2.0, math.inf)
    assert limits["terms.0.v0"] == (-math.inf, math.inf)
    net = EnsembleCost(build_model(N4), batch, FusedSolver(DT))
    assert len(net.low) == 1 + 4 + 4 + 4 + 1
    assert sorted(set(net.high.tolist())) == [0.9, math.inf]


def test_a_run_that_blows_up_costs_infinity_and_spares_the_others(batch: Batch) -> None:
    cost = EnsembleCost(build_model(LIN), batch, FusedSolver(DT))
    good = ParameterVector(build_model(LIN)).row
    bad = good.clone()
    bad[cost.vector.names.index("terms.0.v0")] = 1e300
    each = cost.costs(torch.stack([good, bad]))
    assert torch.isfinite(each[0]).all()
    assert torch.isinf(each[1]).all()
    torch.testing.assert_close(each[0], cost.costs(good[None])[0])


def test_a_sequence_without_weight_cannot_spoil_a_gradient(
    batch: Batch, monkeypatch: pytest.MonkeyPatch
) -> None:
    single = batch.to(dtype=torch.float32)
    wild = single.select([0, 1])
    wild.x[0, 1, 0] = -3.4e38  # a gap that the network makes infinite
    system = build_model(N4, dtype=torch.float32)
    spoiled = EnsembleCost(system, wild, FusedSolver(DT))
    called = []
    honest = EnsembleCost._gradient_of_weighted
    monkeypatch.setattr(
        EnsembleCost, "_gradient_of_weighted", lambda *args: called.append(1) or honest(*args)
    )
    row = ParameterVector(system).row[None]
    value, gradient = spoiled(row, torch.tensor([[1.0, 0.0]], dtype=torch.float64))
    assert called
    alone, slope = EnsembleCost(system, single.select([0]), FusedSolver(DT))(row)
    torch.testing.assert_close(value, alone)
    torch.testing.assert_close(gradient, slope, rtol=1e-5, atol=1e-5)
