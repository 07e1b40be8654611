"""The Gauss-Newton method for crowds, stalled line searches and unidentified parameters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
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
from tests.builders import as_table, straight

TRUTH = (0.5, 40.0, 12.0)


def social(A: float, k: float, kappa: float) -> System:
    return build_model({**model_options("sf"), "A": A, "k": k, "kappa": kappa})


def crowd(seed: int) -> Sequence:
    """People in counter-flow who collide, simulated with the parameters :data:`TRUTH`."""
    rng = np.random.default_rng(seed)
    start = rng.uniform([0.0, -0.5], [3.0, 0.5], (6, 2))
    speed = np.where(np.arange(6)[:, None] < 3, [1.2, 0.0], [-1.2, 0.0]) * rng.uniform(0.8, 1.2)
    plain = straight(
        start,
        speed,
        25,
        0.05,
        destination=start + 10 * speed,
        name=f"s{seed}",
        recording=f"r{seed}",
        agents=tuple(f"{seed}-{n}" for n in range(6)),
    )
    with torch.no_grad():
        simulated = FusedSolver()(social(*TRUTH), collate([plain]))
    assert simulated.v is not None
    return replace(plain, x=simulated.x[:, 0].numpy(), v=simulated.v[:, 0].numpy())


@pytest.fixture(scope="module")
def people() -> list[Sequence]:
    return [crowd(seed) for seed in range(4)]


def with_start(start: tuple[float, ...]) -> dict[str, Any]:
    """Options of the social force, with start values of A, k and kappa."""
    return {**model_options("sf"), **dict(zip(("A", "k", "kappa"), start, strict=True))}


def test_derivatives_as_forward_mode_autodiff(people: list[Sequence]) -> None:
    batch, model = collate(people), social(1.0, 20.0, 5.0)
    problem = ResidualProblem(model, batch, FusedSolver(), Convention.sum)
    quadratic = problem(problem.start)
    rates, first = Rates(model, batch, 1), model.initial(batch)

    def residuals(row: torch.Tensor) -> torch.Tensor:
        names = [f"system.{name}" for name, _ in model.named_parameters()]
        y = [first]
        for k in range(batch.n_samples - 1):
            step = torch.tensor(float(k), dtype=torch.float64)
            values = dict(zip(names, row, strict=True))
            y.append(y[-1] + functional_call(rates, values, (step, y[-1])))
        return torch.stack(y)[..., :2] - batch.x

    row = torch.from_numpy(problem.start)
    residual, slope = residuals(row), torch.func.jacfwd(residuals)(row)
    gradient = torch.einsum("kbnd,kbndp->bp", residual, slope).numpy()
    hessian = torch.einsum("kbndp,kbndq->bpq", slope, slope).numpy()
    cost = 0.5 * residual.square().sum((0, 2, 3)).numpy()
    np.testing.assert_allclose(quadratic.cost, cost, rtol=1e-10)
    np.testing.assert_allclose(quadratic.gradient, gradient, atol=1e-7 * abs(gradient).max())
    np.testing.assert_allclose(quadratic.hessian, hessian, atol=1e-7 * abs(hessian).max())


@pytest.mark.parametrize("at", [0.0, 1e-9])
def test_derivatives_at_a_bound_are_one_sided(people: list[Sequence], at: float) -> None:
    batch = collate(people)
    cost = ResidualProblem(social(at, 20.0, 5.0), batch, FusedSolver())
    slope = cost(np.array([at, 20.0, 5.0])).gradient.sum(0)[0]
    costs = [cost.costs(np.array([a, 20.0, 5.0])).sum() for a in (at, at + 1e-5)]
    assert slope == pytest.approx((costs[1] - costs[0]) / 1e-5, rel=1e-2)


@pytest.mark.thorough
@pytest.mark.parametrize("start", [(48.0, 35.0, 23.0), (0.1, 300.0, 80.0), (10.0, 30.0, 10.0)])
def test_social_force_is_recovered_from_distant_starts(
    people: list[Sequence], start: tuple[float, ...]
) -> None:
    fitted = nnode.Calibrator(with_start(start), optimizer="gauss_newton").fit(people)
    assert fitted.result_.status == "converged"
    np.testing.assert_allclose(fitted.parameters_.estimate, TRUTH, rtol=1e-3)


def test_gauss_newton_is_the_default_and_gives_intervals(people: list[Sequence]) -> None:
    fitted = nnode.Calibrator("sf").fit(people)
    assert fitted.result_.clusters == 4
    assert fitted.parameters_.identified.tolist() == [True] * 3
    assert (fitted.parameters_.lower <= fitted.parameters_.upper).all()


def test_stalled_line_search_is_reported(
    people: list[Sequence], monkeypatch: pytest.MonkeyPatch
) -> None:
    # a line search that never finds a lower cost
    monkeypatch.setattr(torch.optim.LBFGS, "step", lambda self, closure: closure())
    options = with_start((2.0, 35.0, 23.0))
    result = nnode.Calibrator(options, optimizer="lbfgs", epochs=3).fit(people).result_
    assert sensitivity(result.model, FusedSolver(), collate(people)) > 1
    assert result.status == "stalled"
    assert "the line search stalled" in result.summary()
    assert result.plain({})["summary"]["status"] == "stalled"


def test_line_search_at_a_minimum_has_converged(people: list[Sequence]) -> None:
    options = with_start((0.6, 35.0, 13.0))
    result = nnode.Calibrator(options, optimizer="lbfgs", epochs=10).fit(people).result_
    np.testing.assert_allclose(result.parameters.estimate, TRUTH, rtol=1e-2)
    assert result.status == "converged"
    assert "stalled" not in result.summary()


@pytest.mark.thorough
@pytest.mark.parametrize("start", [(40.0, 30.0, 9.0), (50.0, 100.0, 50.0)])
def test_recorded_crowd_from_distant_starts(start: tuple[float, ...], real_data: Path) -> None:
    recording = "bi_corr_400_b_03"
    items = nnode.sequences(data="juelich", source=str(real_data / "juelich"), recording=recording)
    options = with_start(start)
    stalled = nnode.Calibrator(options, optimizer="lbfgs", epochs=5).fit(items).result_
    assert stalled.status == "stalled"
    assert stalled.cost > 100
    fitted = nnode.Calibrator(options, optimizer="gauss_newton").fit(items).result_
    assert fitted.status == "converged"
    np.testing.assert_allclose(fitted.parameters.estimate, [0.0249, 28.14, 28.92], rtol=5e-3)


def test_force_is_not_identified_without_encounters() -> None:
    start = [[0.0, 0.0], [10.0, 0.0]]
    table = as_table(
        straight(start, [[1.0 + 0.1 * s, 0.0], [1.3, 0.0]], 12, 0.1, name=f"s{s}") for s in range(3)
    )
    fitted = nnode.Calibrator("sf").fit(table)
    assert fitted.parameters_.identified.tolist() == [False] * 3
    assert "not identified" in fitted.result_.summary()


def test_networks_and_car_following_costs_are_refused(people: list[Sequence]) -> None:
    batch = collate(people)
    with pytest.raises(ConfigError, match="formulas without networks"):
        GaussNewton(build_model(model_options("nn"))).attach(FusedSolver(), batch, Convention.sum)
    problem = ResidualProblem(social(*TRUTH), batch, FusedSolver(), Convention.gap)
    with pytest.raises(ConfigError, match="vehicles that follow"):
        problem.costs(problem.start)
