"""First speeds as a nuisance: fitted where they are wrong, and derivatives of what is left."""

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
from tests.studies.following.test_fit import HELLY, driven


def known(name: str = "helly") -> System:
    system = EVERY[name].system()
    with torch.no_grad():
        for own, value in HELLY.items():
            getattr(system.terms[0], own).fill_(value)
    return system


def fitted_starts(system: System, batch: Batch, convention: Convention) -> ResidualProblem:
    return ResidualProblem(system, batch, FusedSolver(), convention, StartSpeeds.fitted)


def wrong_starts(sequences: list[Sequence]) -> Batch:
    """True paths, whose first speeds are off by 1 m/s to and fro."""
    batch = collate(sequences)
    batch.v[0, ::2, 0] += 1.0
    batch.v[0, 1::2, 0] -= 1.0
    return batch


@pytest.mark.thorough
def test_wrong_first_speeds_are_found_beside_the_parameters() -> None:
    sequences = driven()
    batch = wrong_starts(sequences)
    given = ResidualProblem(known(), batch, FusedSolver(), Convention.spacing)
    fitted = fitted_starts(known(), batch, Convention.spacing)
    row = np.array(list(HELLY.values()))
    assert pooled(given, row * 1.2).cost > 0.1
    found = pooled(fitted, row * 1.2)
    assert found.cost < 1e-3
    np.testing.assert_allclose(found.row, row, rtol=1e-3)
    starts = fitted.start_speeds(found.row)
    for s in sequences:
        np.testing.assert_allclose(starts[s.name], s.velocity()[0, :, 0], atol=1e-3)
    assert float(batch.v[0, 0, 0]) == pytest.approx(10.0)  # what was given is not changed


@pytest.mark.parametrize("name", ["helly", "helly + memory"])
@pytest.mark.parametrize("kind", [Convention.integral, Convention.spacing, Convention.log_gap])
def test_the_gradient_is_that_of_the_least_cost(name: str, kind: Convention) -> None:
    cost = ResidualProblem(
        known(name), wrong_starts(driven()), FusedSolver(), kind, StartSpeeds.fitted
    )
    row = cost.start * 1.1
    curved = cost(row)
    for i, value in enumerate(row):
        h = 1e-5 * value
        up, down = (cost.costs(row + s * h * np.eye(len(row))[i]) for s in (1, -1))
        wanted = (up - down) / (2 * h)
        np.testing.assert_allclose(curved.gradient[:, i], wanted, rtol=2e-3, atol=1e-5)


def test_every_follower_of_a_platoon_has_its_own() -> None:
    time = 0.1 * np.arange(80)
    lead = 12 * time + np.sin(time)
    x = np.stack([lead - 45, lead - 20, lead], 1)
    one = lane(x, 0.1, v=(12 + np.cos(time))[:, None], name="a")
    with torch.no_grad():
        run = FusedSolver()(known(), collate([one]))
    batch = collate([one])
    batch.x = run.x
    batch.v[0, 0, :2, 0] += torch.tensor([0.7, -0.4])
    cost = fitted_starts(known(), batch, Convention.gap)
    row = cost.start
    assert ResidualProblem(known(), batch, FusedSolver(), Convention.gap).costs(row)[0] > 1e-2
    np.testing.assert_allclose(cost.start_speeds(row)["a"], [13.0, 13.0, 13.0], atol=1e-4)
    assert cost.costs(row)[0] < 1e-8


@pytest.mark.thorough
def test_it_is_said_and_refused_where_there_is_no_speed() -> None:
    table = pairs(number=4, seconds=12.0)
    table.loc[table.time == 0, "v_follower"] += 0.8
    own = {"method": "ballistic", "cost": "gap"}  # that the pairs are made with
    found = nnode.Calibrator("idm", start_speeds="fitted", **own).fit(table)
    assert found.result_.start_speeds["kind"] == "fitted"
    assert found.result_.start_speeds["change"] == pytest.approx(0.8, rel=1e-3)
    assert found.cost_ < 1e-6
    assert "first speeds of training sequences are fitted" in found.result_.summary()
    given = nnode.Calibrator("idm", **own).fit(table).result_
    assert given.start_speeds == {"kind": "measured"}
    assert given.cost > 1e-3
    with pytest.raises(ConfigError, match="needs optimizer=gauss_newton"):
        nnode.Calibrator("idm", optimizer="lbfgs", start_speeds="fitted").fit(table)
    with pytest.raises(ConfigError, match="second order"):
        nnode.Calibrator("lin", optimizer="gauss_newton", start_speeds="fitted").fit(table)


def test_parabolas_tell_first_speeds() -> None:
    rng = np.random.default_rng(3)
    t = 0.1 * np.arange(60)
    x = np.stack([3 + 8 * t - 0.5 * t**2, 30 + 10 * t], 1)
    exact = start_smoothed(lane(x, 0.1, start=5.0))
    np.testing.assert_allclose(exact.velocity()[0, :, 0], [8.0, 10.0], rtol=1e-9)
    np.testing.assert_allclose(exact.velocity()[1:-1, :, 0], np.diff(x, axis=0)[1:] / 0.1)
    assert (exact.x[..., 0] == x).all()
    away = []
    for _ in range(300):
        noisy = lane(x + 0.3 * rng.normal(size=x.shape), 0.1, start=5.0)
        away.append(start_smoothed(noisy).velocity()[0, :, 0] - [8.0, 10.0])
    # 0.3 m at every 0.1 s over 2 s: 0.43 m/s, where a difference of two samples has 4.2 m/s
    assert np.std(away) == pytest.approx(0.43, rel=0.15)
    short = lane(x[:3], 0.1, start=5.0)
    assert start_smoothed(short) is short
    found = nnode.sequences(pairs(number=2, seconds=5.0), data="pairs", start_speeds="smoothed")
    assert found.manifest["options"]["start_speeds"] == "smoothed"


def test_no_fit_of_first_speeds_is_worse_than_the_data_s_own() -> None:
    """From far parameters first speeds go far, where steps without damping got stuck."""
    sequences = driven()
    row = np.array(list(HELLY.values()))
    batch = collate(sequences)
    given = ResidualProblem(known(), batch, FusedSolver(), Convention.integral)
    fitted = fitted_starts(known(), batch, Convention.integral)
    fitted(row * 3.0)
    fitted(row * 0.2)
    assert (fitted.costs(row) <= given.costs(row) + 1e-9).all()


IDM = SimpleNamespace(v0=30.0, T=1.4, s0=2.0, a=1.2, b=1.5)


def noisy(sigma: float, seed: int = 1) -> list[Sequence]:
    """Platoons of four by idm with the parameters :data:`IDM`, Heun's method at 0.02 s, behind
    leaders of many speeds, with noise that is new at every 0.1 s."""
    rng, h, found = np.random.default_rng(seed), 0.02, []
    for number in range(8):
        t = h * np.arange(2001)
        # m/s, 6 to 34, accelerations up to 1.5 m/s²
        parts = [(9.0, 0.11, 0.3 * number), (3.0, 0.35, 1.7 * number), (1.5, 0.8, number)]
        lead = 20 + sum(size * np.sin(w * t + p) for size, w, p in parts)
        place = np.concatenate([[0.0], np.cumsum((lead[1:] + lead[:-1]) / 2 * h)])

        def rate(x: np.ndarray, v: np.ndarray, ahead: float, pace: float) -> np.ndarray:
            before, speed = np.append(x[1:], ahead), np.append(v[1:], pace)
            return np.asarray(idm(before - x - 4.5, v, speed, IDM))

        v = np.full(3, lead[0]) + rng.normal(size=3)
        x = -np.cumsum(4.5 + (2 + 1.4 * v[::-1]) * rng.uniform(0.8, 1.6, 3))[::-1]
        path = np.empty((401, 4))
        for k in range(2001):
            if k % 5 == 0:
                path[k // 5] = [*x, place[k]]
            if k < 2000:
                a = rate(x, v, place[k], lead[k])
                then = rate(x + h * v, v + h * a, place[k + 1], lead[k + 1])
                x, v = x + h * v + h**2 / 2 * a, v + h / 2 * (a + then)
        path += sigma * rng.normal(size=path.shape)
        found.append(lane(path, 0.1, name=f"r{number}/0", length=4.5))
    return found


@pytest.mark.thorough
def test_costs_do_not_rise_from_one_step_of_the_training_loop_to_the_next() -> None:
    """The loop attaches a new copy of the batch before each step. The law of Krauss is a map whose
    cost has several minima over the first speeds, so the search has to go on from the last ones."""
    batch = collate([replace(s, time=s.time[:81], x=s.x[:81]) for s in noisy(0.05)[:4]])
    system, costs = EVERY["krauss"].system(), []
    optimizer = GaussNewton(system)
    for _ in range(8):
        optimizer.attach(FusedSolver(), batch.to(), Convention.integral, StartSpeeds.fitted)
        costs.append(optimizer.step())
    assert costs[-1] < costs[0] / 10
    np.testing.assert_array_less(costs[1:], np.array(costs[:-1]) * (1 + 1e-9))


@pytest.mark.thorough
def test_noise_of_0_3_m_does_not_bias_what_is_fitted_by_default() -> None:
    table = noisy(0.3)
    wanted = vars(IDM)
    for drivers, kind in ((None, "fitted to each driver"), ("none", "fitted")):
        own = nnode.Calibrator("idm", leader="measured", method="rk4", drivers=drivers).fit(table)
        estimate = own.parameters_["estimate"]
        for name, value in wanted.items():
            assert estimate[f"idm.{name}"] == pytest.approx(value, rel=0.1), (name, kind)
        assert own.result_.noise.position == pytest.approx(0.3, rel=0.1)
        assert own.result_.start_speeds["kind"] == kind
        assert "speeds are those of smoothed paths" in own.result_.summary()
    given = [replace(s, v=np.maximum(s.velocity(), 0.0)) for s in table]
    raw = nnode.Calibrator(
        "idm", leader="measured", method="rk4", start_speeds="given", drivers="none"
    ).fit(given)
    away = raw.parameters_["estimate"] / np.array(list(wanted.values())) - 1
    assert away.abs().max() > 0.1
    assert "estimates are biased" in raw.result_.summary()
