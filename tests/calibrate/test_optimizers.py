"""Optimisers that are built from options, and short calibrations with them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.calibrate.cost import sequence_costs
from nnode.calibrate.optimizers import (
    AdadeltaOptions,
    AdamOptions,
    LbfgsOptions,
    OptimizerOptions,
    build_optimizer,
)
from nnode.calibrate.optimizers.adadelta import NoisyAdadelta
from nnode.data.sequence import Batch, collate
from nnode.errors import ConfigError
from nnode.model import Traffic, make_law
from nnode.simulation import FusedSolver
from tests.builders import linear

#: True v0 (m/s) and L (m).
TRUTH = (24.0, 6.0)
SOLVER = FusedSolver(0.1)


def platoons() -> Batch:
    """Platoons with the parameters :data:`TRUTH`."""
    gaps = ([9.0, 14.0], [20.0, 8.0], [30.0, 11.0])
    return collate(linear((np.cumsum([0.0, *g]) for g in gaps), *TRUTH, 8, 0.1))


@pytest.mark.parametrize(
    ("options", "steps", "share"),
    [
        (AdadeltaOptions(eps=1e-3), 400, 1e-2),
        (AdamOptions(lr=0.2), 200, 1e-3),
        (LbfgsOptions(), 5, 1e-9),
    ],
    ids=lambda o: getattr(o, "name", ""),
)
def test_each_optimiser_calibrates(options: OptimizerOptions, steps: int, share: float) -> None:
    batch, model = platoons(), Traffic([make_law("lin")])
    optimizer = build_optimizer(model, options, seed=1)

    def closure() -> Tensor:
        optimizer.zero_grad()
        cost = sequence_costs(SOLVER(model, batch), batch).mean()
        if cost.requires_grad:
            cost.backward()
        return cost.detach()

    first = float(closure())
    for _ in range(steps):
        optimizer.step(closure)
        model.project_()
    assert float(closure()) < share * first
    if share < 1e-5:
        estimate = [model.terms[0].v0.item(), model.terms[0].L.item()]
        np.testing.assert_allclose(estimate, TRUTH, rtol=1e-4)


@pytest.mark.parametrize(
    ("options", "kind", "expected"),
    [
        (
            AdamOptions(lr=0.3, beta1=0.7, beta2=0.8, eps=1e-5),
            torch.optim.Adam,
            {"lr": 0.3, "betas": (0.7, 0.8), "eps": 1e-5},
        ),
        (
            LbfgsOptions(lr=0.5, max_iter=7, history=3),
            torch.optim.LBFGS,
            {"lr": 0.5, "max_iter": 7, "history_size": 3, "line_search_fn": "strong_wolfe"},
        ),
        (
            AdadeltaOptions(lr=0.5, rho=0.9, eps=1e-3, eta1=2.0, eta2=0.1),
            NoisyAdadelta,
            {"lr": 0.5, "rho": 0.9, "eps": 1e-3, "eta1": 2.0, "eta2": 0.1},
        ),
        (  # the paper's constants
            AdadeltaOptions(),
            NoisyAdadelta,
            {"lr": 1.0, "rho": 0.95, "eps": 1e-6, "eta1": 1.0, "eta2": 0.55},
        ),
    ],
)
def test_options_reach_the_optimiser(
    options: OptimizerOptions, kind: type, expected: dict[str, object]
) -> None:
    optimizer = build_optimizer(Traffic([make_law("lin")]), options)
    assert isinstance(optimizer, kind)
    assert expected.items() <= optimizer.param_groups[0].items()


def test_seed_reaches_the_optimiser() -> None:
    model = Traffic([make_law("lin")])
    first, repeated, other = (
        build_optimizer(model, AdadeltaOptions(), seed=seed).state_dict()["generator"]
        for seed in (4, 4, 5)
    )
    assert torch.equal(first, repeated)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            OptimizerOptions(name="adadlta"),
            r"optimizer\.name=adadlta.*adadelta, adam, lbfgs, gauss_newton",
        ),
        (AdadeltaOptions(rho=1.5), "adadelta: rho=1.5"),
        (AdamOptions(lr=-1.0), "adam: .*learning rate"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_errors_name_the_option(options: OptimizerOptions, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_optimizer(Traffic([make_law("lin")]), options)
