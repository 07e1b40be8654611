"""Initial speeds as nuisance parameters, and derivatives of the profiled cost."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import nnode
from nnode.calibrate.cost import Convention
from nnode.calibrate.optimizers.gauss_newton import GaussNewton
from nnode.calibrate.options import StartSpeeds
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.smooth import start_smoothed
from nnode.errors import ConfigError
from nnode.model import System
from nnode.simulation import FusedSolver
from studies.following.tasks import EVERY
from tests.app.following import pairs
from tests.builders import lane
from tests.model.following import idm
from tests.studies.following.test_fit import HELLY, helly_pairs


def helly_model(name: str = "helly") -> System:
    """A candidate of the study with the parameters of :func:`helly_pairs`."""
    system = EVERY[name].system()
    with torch.no_grad():
        for parameter, value in HELLY.items():
            getattr(system.terms[0], parameter).fill_(value)
    return system


def fitted_starts(system: System, batch: Batch, convention: Convention) -> ResidualProblem:
    return ResidualProblem(system, batch, FusedSolver(), convention, StartSpeeds.fitted)


def wrong_starts(sequences: list[Sequence]) -> Batch:
    """Exact paths with errors of the first speeds, alternately 1 m/s and -1 m/s."""
    batch = collate(sequences)
    batch.v[0, ::2, 0] += 1.0
    batch.v[0, 1::2, 0] -= 1.0
    return batch


@pytest.mark.thorough
def test_initial_speeds_and_parameters_are_fitted_jointly() -> None:
    sequences = helly_pairs()
    batch = wrong_starts(sequences)
    given = ResidualProblem(helly_model(), batch, FusedSolver(), Convention.spacing)
    fitted = fitted_starts(helly_model(), batch, Convention.spacing)
    row = np.array(list(HELLY.values()))
    assert pooled(given, row * 1.2).cost > 0.1
    fit = pooled(fitted, row * 1.2)
    assert fit.cost < 1e-3
    np.testing.assert_allclose(fit.row, row, rtol=1e-3)
    starts = fitted.start_speeds(fit.row)
    for s in sequences:
        np.testing.assert_allclose(starts[s.name], s.velocity()[0, :, 0], atol=1e-3)
    assert float(batch.v[0, 0, 0]) == pytest.approx(10.0)  # the given speeds are not modified


@pytest.mark.parametrize("name", ["helly", "helly + memory"])
@pytest.mark.parametrize("kind", [Convention.integral, Convention.spacing, Convention.log_gap])
def test_gradient_of_the_profiled_cost_as_finite_differences(name: str, kind: Convention) -> None:
    cost = fitted_starts(helly_model(name), wrong_starts(helly_pairs()), kind)
    row = cost.start * 1.1
    gradient = cost(row).gradient
    for i, value in enumerate(row):
        h = 1e-5 * value
        up, down = (cost.costs(row + s * h * np.eye(len(row))[i]) for s in (1, -1))
        np.testing.assert_allclose(gradient[:, i], (up - down) / (2 * h), rtol=2e-3, atol=1e-5)


def test_each_follower_of_a_platoon_has_an_initial_speed() -> None:
    time = 0.1 * np.arange(80)
    lead = 12 * time + np.sin(time)
    x = np.stack([lead - 45, lead - 20, lead], 1)
    batch = collate([lane(x, 0.1, v=(12 + np.cos(time))[:, None], name="a")])
    with torch.no_grad():
        batch.x = FusedSolver()(helly_model(), batch).x
    batch.v[0, 0, :2, 0] += torch.tensor([0.7, -0.4])
    cost = fitted_starts(helly_model(), batch, Convention.gap)
    row = cost.start
    assert ResidualProblem(helly_model(), batch, FusedSolver(), Convention.gap).costs(row)[0] > 1e-2
    np.testing.assert_allclose(cost.start_speeds(row)["a"], [13.0, 13.0, 13.0], atol=1e-4)
    assert cost.costs(row)[0] < 1e-8


@pytest.mark.thorough
def test_fitted_start_speeds_are_reported_and_need_second_order() -> None:
    table = pairs(number=4, seconds=12.0)
    table.loc[table.time == 0, "v_follower"] += 0.8
    options = {"method": "ballistic", "cost": "gap"}  # the method of the synthetic pairs
    fitted = nnode.Calibrator("idm", start_speeds="fitted", **options).fit(table).result_
    assert fitted.start_speeds["kind"] == "fitted"
    assert fitted.start_speeds["change"] == pytest.approx(0.8, rel=1e-3)
    assert fitted.cost < 1e-6
    assert "first speeds of training sequences are fitted" in fitted.summary()
    given = nnode.Calibrator("idm", **options).fit(table).result_
    assert given.start_speeds == {"kind": "measured"}
    assert given.cost > 1e-3
    with pytest.raises(ConfigError, match="needs optimizer=gauss_newton"):
        nnode.Calibrator("idm", optimizer="lbfgs", start_speeds="fitted").fit(table)
    with pytest.raises(ConfigError, match="second order"):
        nnode.Calibrator("lin", optimizer="gauss_newton", start_speeds="fitted").fit(table)


def test_initial_speeds_from_fitted_parabolas() -> None:
    rng = np.random.default_rng(3)
    t = 0.1 * np.arange(60)
    x = np.stack([3 + 8 * t - 0.5 * t**2, 30 + 10 * t], 1)
    exact = start_smoothed(lane(x, 0.1, start=5.0))
    np.testing.assert_allclose(exact.velocity()[0, :, 0], [8.0, 10.0], rtol=1e-9)
    np.testing.assert_allclose(exact.velocity()[1:-1, :, 0], np.diff(x, axis=0)[1:] / 0.1)
    assert (exact.x[..., 0] == x).all()
    errors = []
    for _ in range(300):
        noisy = lane(x + 0.3 * rng.normal(size=x.shape), 0.1, start=5.0)
        errors.append(start_smoothed(noisy).velocity()[0, :, 0] - [8.0, 10.0])
    # 0.3 m at every 0.1 s over 2 s gives 0.43 m/s; a difference of two samples has 4.2 m/s
    assert np.std(errors) == pytest.approx(0.43, rel=0.15)
    short = lane(x[:3], 0.1, start=5.0)
    assert start_smoothed(short) is short
    smoothed = nnode.sequences(pairs(number=2, seconds=5.0), data="pairs", start_speeds="smoothed")
    assert smoothed.manifest["options"]["start_speeds"] == "smoothed"


def test_fitted_initial_speeds_are_never_worse_than_given_ones() -> None:
    """Distant parameters lead to distant first speeds, where undamped steps got stuck."""
    sequences = helly_pairs()
    row = np.array(list(HELLY.values()))
    batch = collate(sequences)
    given = ResidualProblem(helly_model(), batch, FusedSolver(), Convention.integral)
    fitted = fitted_starts(helly_model(), batch, Convention.integral)
    fitted(row * 3.0)
    fitted(row * 0.2)
    assert (fitted.costs(row) <= given.costs(row) + 1e-9).all()


IDM = SimpleNamespace(v0=30.0, T=1.4, s0=2.0, a=1.2, b=1.5)


def noisy(sigma: float) -> list[Sequence]:
    """Platoons of four with the parameters :data:`IDM` behind leaders of varying speeds.

    Heun's method with steps of 0.02 s; white noise at every 0.1 s.
    """
    rng, h, sequences = np.random.default_rng(1), 0.02, []
    for number in range(8):
        t = h * np.arange(2001)
        # m/s, 6 to 34, accelerations up to 1.5 m/s²
        parts = [(9.0, 0.11, 0.3 * number), (3.0, 0.35, 1.7 * number), (1.5, 0.8, number)]
        lead = 20 + sum(size * np.sin(w * t + p) for size, w, p in parts)
        place = np.concatenate([[0.0], np.cumsum((lead[1:] + lead[:-1]) / 2 * h)])

        def rate(x: np.ndarray, v: np.ndarray, lead_x: float, lead_v: float) -> np.ndarray:
            x_ahead, v_ahead = np.append(x[1:], lead_x), np.append(v[1:], lead_v)
            return np.asarray(idm(x_ahead - x - 4.5, v, v_ahead, IDM))

        v = np.full(3, lead[0]) + rng.normal(size=3)
        x = -np.cumsum(4.5 + (2 + 1.4 * v[::-1]) * rng.uniform(0.8, 1.6, 3))[::-1]
        path = np.empty((401, 4))
        for k in range(2001):
            if k % 5 == 0:
                path[k // 5] = [*x, place[k]]
            if k < 2000:
                a = rate(x, v, place[k], lead[k])
                a_next = rate(x + h * v, v + h * a, place[k + 1], lead[k + 1])
                x, v = x + h * v + h**2 / 2 * a, v + h / 2 * (a + a_next)
        path += sigma * rng.normal(size=path.shape)
        sequences.append(lane(path, 0.1, name=f"r{number}/0", length=4.5))
    return sequences


@pytest.mark.thorough
def test_costs_decrease_in_each_step_of_the_training_loop() -> None:
    """The loop attaches a new copy of the batch before each step.

    The cost of Krauss' law has several minima over the first speeds, so each search has to start
    at the speeds of the previous one.
    """
    batch = collate([replace(s, time=s.time[:81], x=s.x[:81]) for s in noisy(0.05)[:4]])
    system, costs = EVERY["krauss"].system(), []
    optimizer = GaussNewton(system)
    for _ in range(8):
        optimizer.attach(FusedSolver(), batch.to(), Convention.integral, StartSpeeds.fitted)
        costs.append(optimizer.step())
    assert costs[-1] < costs[0] / 10
    np.testing.assert_array_less(costs[1:], np.array(costs[:-1]) * (1 + 1e-9))


@pytest.mark.thorough
def test_default_fits_are_unbiased_by_noise_of_0_3_m() -> None:
    sequences = noisy(0.3)
    options = {"leader": "measured", "method": "rk4"}
    for drivers, kind in ((None, "fitted to each driver"), ("none", "fitted")):
        fitted = nnode.Calibrator("idm", drivers=drivers, **options).fit(sequences)
        estimate = fitted.parameters_["estimate"]
        for name, value in vars(IDM).items():
            assert estimate[f"idm.{name}"] == pytest.approx(value, rel=0.1), (name, kind)
        assert fitted.result_.noise.position == pytest.approx(0.3, rel=0.1)
        assert fitted.result_.start_speeds["kind"] == kind
        assert "speeds are those of smoothed paths" in fitted.result_.summary()
    given = [replace(s, v=np.maximum(s.velocity(), 0.0)) for s in sequences]
    raw = nnode.Calibrator("idm", start_speeds="given", drivers="none", **options).fit(given)
    bias = raw.parameters_["estimate"] / np.array(list(vars(IDM).values())) - 1
    assert bias.abs().max() > 0.1
    assert "estimates are biased" in raw.result_.summary()
