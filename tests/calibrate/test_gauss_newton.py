"""The Gauss-Newton method with exact derivatives, and costs of car following."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnode.calibrate.cost import FOLLOWING, Convention, sequence_costs
from nnode.calibrate.intervals import intervals
from nnode.calibrate.optimizers.gauss_newton import GaussNewton
from nnode.calibrate.problem import ResidualProblem, pooled, separate
from nnode.data.sequence import Batch, collate
from nnode.errors import ConfigError
from nnode.model import System, Traffic, build_model
from nnode.model.term import State, Term
from nnode.simulation import FusedSolver, TorchdiffeqSolver, Trajectory
from tests.builders import lane
from tests.model import following
from tests.model.following import set_
from tests.simulation.fused.compare import RungeKutta

TRUE = {"v0": 25.0, "T": 1.4, "s0": 3.0, "a": 1.1, "b": 2.0}


def model(**values: float) -> System:
    return set_(following.model("idm"), **values)


def problem(batch: Batch, kind: Convention, **values: float) -> ResidualProblem:
    return ResidualProblem(model(**values), batch, FusedSolver(), kind)


@pytest.fixture(scope="module")
def pairs() -> Batch:
    """Six IDM pairs with :data:`TRUE` parameters behind stop-and-go leaders; 5 cm of noise."""
    rng = np.random.default_rng(20261122)
    sequences = []
    for i in range(6):
        time = 0.1 * np.arange(200 + 20 * i)
        speed = np.clip(12 + 10 * np.sin(0.35 * time + i), 0, None)
        lead = np.cumsum(speed) * 0.1
        x = np.stack([lead - 20 - 2 * i, lead], 1)
        v = np.stack([np.full_like(speed, 10.0), speed], 1)
        sequences.append(lane(x, 0.1, v=v, name=f"r/{i}", length=np.array([4.0, 5.0])))
    batch = collate(sequences)
    with torch.no_grad():
        run = FusedSolver()(model(**TRUE), batch)
    noise = 0.05 * torch.from_numpy(rng.standard_normal(run.x.shape))
    noise[0] = 0
    noise[:, :, 1] = 0
    batch.x, batch.v = run.x + noise * batch.valid[..., None], run.v
    return batch


@pytest.fixture(scope="module")
def differentiable(pairs: Batch) -> tuple[System, Trajectory]:
    """A model and its simulation with the graph for automatic differentiation."""
    system = model(T=1.1)
    return system, RungeKutta()(system, pairs)


@pytest.mark.parametrize("kind", list(Convention))
def test_costs_and_gradients_as_autograd(
    kind: Convention, pairs: Batch, differentiable: tuple[System, Trajectory]
) -> None:
    system, run = differentiable
    cost = ResidualProblem(system, pairs, FusedSolver(), kind)
    quadratic = cost(cost.start)
    expected = sequence_costs(run, pairs, kind)
    np.testing.assert_allclose(quadratic.cost, expected.detach().numpy(), rtol=1e-11)
    np.testing.assert_allclose(cost.costs(cost.start), quadratic.cost, rtol=1e-11)
    slopes = torch.autograd.grad(expected.sum(), list(system.parameters()), retain_graph=True)
    np.testing.assert_allclose(quadratic.gradient.sum(0), [float(s) for s in slopes], rtol=1e-9)


@pytest.mark.parametrize("kind", [Convention.integral, Convention.gap])
def test_costs_of_platoons(kind: Convention) -> None:
    time = 0.1 * np.arange(30)
    lead = 12 * time + np.sin(time)
    batch = collate([lane(np.stack([lead - 45, lead - 20, lead], 1), 0.1)])
    cost = problem(batch, kind)
    expected = sequence_costs(RungeKutta()(model(), batch), batch, kind).detach().numpy()
    np.testing.assert_allclose(cost(cost.start).cost, expected, rtol=1e-11)
    np.testing.assert_allclose(cost.costs(cost.start), expected, rtol=1e-11)


@pytest.mark.thorough
def test_definitions_of_costs(pairs: Batch) -> None:
    run = TorchdiffeqSolver(None, "discrete")(model(T=1.1), pairs)
    costs = {kind: sequence_costs(run, pairs, kind).detach().numpy() for kind in FOLLOWING}
    for b in range(len(pairs)):
        k = int(pairs.valid[:, b, 0].sum())
        gap = (run.x[1:k, b, 1, 0] - run.x[1:k, b, 0, 0] - 5).detach().numpy()
        measured = (pairs.x[1:k, b, 1, 0] - pairs.x[1:k, b, 0, 0] - 5).numpy()
        rmse = np.sqrt(np.mean((gap - measured) ** 2))
        assert costs[Convention.spacing][b] == pytest.approx(rmse, rel=1e-12)
        relative = np.mean(((gap - measured) / measured) ** 2)
        assert costs[Convention.relative_gap][b] == pytest.approx(relative, rel=1e-12)
        logarithm = np.mean((np.log(gap) - np.log(measured)) ** 2)
        assert costs[Convention.log_gap][b] == pytest.approx(logarithm, rel=1e-12)


def test_pooled_fit_and_intervals(pairs: Batch) -> None:
    cost = problem(pairs, Convention.gap, v0=30, T=1.0, s0=2, a=1.5, b=1.5)
    fit = pooled(cost)
    assert np.abs(cost(fit.row).gradient.mean(0) * (1 + np.abs(fit.row))).max() < 1e-6
    report = intervals(cost, fit.row, np.arange(6))
    assert report["clusters"] == 6
    covered = [
        interval["low"] < TRUE[name.split(".")[1]] < interval["high"]
        for name, interval in report["parameters"].items()
    ]
    assert sum(covered) >= 4  # of five intervals of 95 %
    # weights choose sequences
    single = pooled(cost, weights=np.eye(6)[2])
    _, costs = separate(cost, [fit.row])
    assert single.cost == pytest.approx(costs[2], rel=1e-6)
    assert (costs <= cost.costs(fit.row) + 1e-12).all()


def test_parameter_at_a_bound_is_flagged(pairs: Batch) -> None:
    cost = problem(pairs, Convention.gap, **{**TRUE, "b": 0.05})
    interval = intervals(cost, cost.start, np.arange(6))["parameters"]["idm.b"]
    assert interval["at_bound"] == "low"
    assert interval["low"] is None
    assert not interval["identified"]


def test_resume_is_bit_identical(pairs: Batch) -> None:
    def run(steps: int, state: dict[str, object] | None, system: System) -> GaussNewton:
        optimizer = GaussNewton(system)
        if state is not None:
            optimizer.load_state_dict(state)
        optimizer.attach(FusedSolver(), pairs, Convention.gap)
        for _ in range(steps):
            optimizer.step()
        return optimizer

    uninterrupted, resumed = model(T=1.0), model(T=1.0)
    run(6, None, uninterrupted)
    run(3, run(3, None, resumed).state_dict(), resumed)
    for a, b in zip(uninterrupted.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)


class Coded(Term):
    """A term without a formula."""

    name = "coded"

    def forward(self, state: State) -> torch.Tensor:
        return torch.zeros_like(state.x)


def test_models_without_derivatives_are_refused(pairs: Batch) -> None:
    lin = {"term": "lin", "name": "lin", "leader": "measured", "v0": 20.0, "L": 5.0, "L_min": 2.0}
    coded = Traffic([*build_model(lin).terms, Coded()], leader="measured")
    with pytest.raises(ConfigError, match="gauss_newton needs a model of a lane"):
        GaussNewton(coded).attach(FusedSolver(), pairs, Convention.sum)
    with pytest.raises(ConfigError, match="needs solver=fused"):
        GaussNewton(model()).attach(TorchdiffeqSolver(), pairs, Convention.gap)
    run = FusedSolver(0.1)(build_model(lin), pairs)
    with pytest.raises(ConfigError, match="second order"):
        sequence_costs(run, pairs, Convention.speed)
