"""Gauss and Newton's method for people, stalled line searches and flat directions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from torch.func import functional_call

import nnode
from nnode.app.python.inputs import model_options
from nnode.calibrate.cost import Convention
from nnode.calibrate.evaluate import sensitivity
from nnode.calibrate.optimizers.gauss_newton import GaussNewton
from nnode.calibrate.problem import ResidualProblem
from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError
from nnode.model import System
from nnode.model.build import build_model
from nnode.simulation import FusedSolver
from nnode.simulation.ode import Rates
from tests.builders import straight

TRUTH = (0.5, 40.0, 12.0)


def social(A: float, k: float, kappa: float) -> System:
    return build_model({**model_options("sf"), "A": A, "k": k, "kappa": kappa})


def crowd(seed: int) -> Sequence:
    """People who meet, bump into each other and walk on, by the model of :data:`TRUTH`."""
    rng = np.random.default_rng(seed)
    start = rng.uniform([0.0, -0.5], [3.0, 0.5], (6, 2))
    speed = np.where(np.arange(6)[:, None] < 3, [1.2, 0.0], [-1.2, 0.0]) * rng.uniform(0.8, 1.2)
    names = {
        "name": f"s{seed}",
        "recording": f"r{seed}",
        "agents": tuple(f"{seed}-{n}" for n in range(6)),
    }
    plain = straight(start, speed, 25, 0.05, destination=start + 10 * speed, **names)
    batch = collate([plain])
    with torch.no_grad():
        found = FusedSolver()(social(*TRUTH), batch)
    assert found.v is not None
    return Sequence(**{**vars(plain), "x": found.x[:, 0].numpy(), "v": found.v[:, 0].numpy()})


@pytest.fixture(scope="module")
def people() -> list[Sequence]:
    return [crowd(seed) for seed in range(4)]


def test_derivatives_are_those_of_forward_mode(people: list[Sequence]) -> None:
    batch, model = collate(people), social(1.0, 20.0, 5.0)
    found = ResidualProblem(model, batch, FusedSolver(), Convention.sum)
    curved = found(found.start)
    rates, first = Rates(model, batch, 1), model.initial(batch)

    def residuals(row: torch.Tensor) -> torch.Tensor:
        names = [f"system.{name}" for name, _ in model.named_parameters()]
        y = [first]
        for k in range(batch.n_samples - 1):
            step = torch.tensor(float(k), dtype=torch.float64)
            values = dict(zip(names, row, strict=True))
            y.append(y[-1] + functional_call(rates, values, (step, y[-1])))
        return torch.stack(y)[..., :2] - batch.x

    row = torch.from_numpy(found.start)
    away, slope = residuals(row), torch.func.jacfwd(residuals)(row)
    gradient = torch.einsum("kbnd,kbndp->bp", away, slope).numpy()
    hessian = torch.einsum("kbndp,kbndq->bpq", slope, slope).numpy()
    np.testing.assert_allclose(curved.cost, 0.5 * away.square().sum((0, 2, 3)).numpy(), rtol=1e-10)
    np.testing.assert_allclose(curved.gradient, gradient, atol=1e-7 * abs(gradient).max())
    np.testing.assert_allclose(curved.hessian, hessian, atol=1e-7 * abs(hessian).max())


@pytest.mark.parametrize("at", [0.0, 1e-9])
def test_derivatives_at_a_bound_stay_inside(people: list[Sequence], at: float) -> None:
    batch = collate(people)
    cost = ResidualProblem(social(at, 20.0, 5.0), batch, FusedSolver())
    slope = cost(np.array([at, 20.0, 5.0])).gradient.sum(0)[0]
    costs = [cost.costs(np.array([a, 20.0, 5.0])).sum() for a in (at, at + 1e-5)]
    assert slope == pytest.approx((costs[1] - costs[0]) / 1e-5, rel=1e-2)


@pytest.mark.thorough
@pytest.mark.parametrize("start", [(48.0, 35.0, 23.0), (0.1, 300.0, 80.0), (10.0, 30.0, 10.0)])
def test_the_social_force_is_found_from_any_start(
    people: list[Sequence], start: tuple[float, ...]
) -> None:
    options = {**model_options("sf"), **dict(zip(("A", "k", "kappa"), start, strict=True))}
    fitted = nnode.Calibrator(options, optimizer="gauss_newton").fit(people)
    assert fitted.result_.status == "converged"
    np.testing.assert_allclose(fitted.parameters_.estimate, TRUTH, rtol=1e-3)


def test_the_social_force_takes_gauss_newton_and_has_intervals(people: list[Sequence]) -> None:
    fitted = nnode.Calibrator("sf").fit(people)
    assert fitted.result_.clusters == 4
    assert fitted.parameters_.identified.tolist() == [True] * 3
    assert (fitted.parameters_.lower <= fitted.parameters_.upper).all()


def test_a_stalled_line_search_says_so(
    people: list[Sequence], monkeypatch: pytest.MonkeyPatch
) -> None:
    # a line search that finds no lower cost, whatever the gradient says
    monkeypatch.setattr(torch.optim.LBFGS, "step", lambda self, closure: closure())
    options = {**model_options("sf"), "A": 2.0, "k": 35.0, "kappa": 23.0}
    found = nnode.Calibrator(options, optimizer="lbfgs", epochs=3).fit(people).result_
    assert sensitivity(found.model, FusedSolver(), collate(people)) > 1
    assert found.status == "stalled"
    assert "the line search stalled" in found.summary()
    assert found.plain({})["summary"]["status"] == "stalled"


def test_a_line_search_that_ends_at_a_minimum_has_converged(people: list[Sequence]) -> None:
    options = {**model_options("sf"), "A": 0.6, "k": 35.0, "kappa": 13.0}
    found = nnode.Calibrator(options, optimizer="lbfgs", epochs=10).fit(people).result_
    np.testing.assert_allclose(found.parameters.estimate, TRUTH, rtol=1e-2)
    assert found.status == "converged"
    assert "stalled" not in found.summary()


@pytest.mark.thorough
@pytest.mark.parametrize("start", [(40.0, 30.0, 9.0), (50.0, 100.0, 50.0)])
def test_measured_people_from_far_starts(start: tuple[float, ...], real_data: Path) -> None:
    recording = "bi_corr_400_b_03"
    items = nnode.sequences(data="juelich", source=str(real_data / "juelich"), recording=recording)
    options = {**model_options("sf"), **dict(zip(("A", "k", "kappa"), start, strict=True))}
    found = nnode.Calibrator(options, optimizer="lbfgs", epochs=5).fit(items).result_
    assert found.status == "stalled"
    assert found.cost > 100
    fitted = nnode.Calibrator(options, optimizer="gauss_newton").fit(items).result_
    assert fitted.status == "converged"
    np.testing.assert_allclose(fitted.parameters.estimate, [0.0249, 28.14, 28.92], rtol=5e-3)


def test_people_who_do_not_meet_identify_no_force() -> None:
    time = 0.1 * np.arange(12)
    rows = [
        {"sequence": f"s{s}", "time": t, "agent": f"{s}-{n}", "x": 10.0 * n + v * t, "y": 0.0}
        for s in range(3)
        for n, v in enumerate((1.0 + 0.1 * s, 1.3))
        for t in time
    ]
    fitted = nnode.Calibrator("sf").fit(pd.DataFrame(rows))
    assert fitted.parameters_.identified.tolist() == [False] * 3
    assert "not identified" in fitted.result_.summary()


def test_networks_and_costs_of_vehicles_are_refused(people: list[Sequence]) -> None:
    batch = collate(people)
    with pytest.raises(ConfigError, match="formulas without networks"):
        GaussNewton(build_model(model_options("nn"))).attach(FusedSolver(), batch, Convention.sum)
    problem = ResidualProblem(social(*TRUTH), batch, FusedSolver(), Convention.gap)
    with pytest.raises(ConfigError, match="vehicles that follow"):
        problem.costs(problem.start)
