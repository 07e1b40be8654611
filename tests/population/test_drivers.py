"""Drivers who differ, simulated without the package."""

from __future__ import annotations

import numpy as np
import pytest

import nnode
from benchmarks.drivers import LASTS, PUSH
from benchmarks.drivers import platoons as benchmark_platoons
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.model import Traffic, make_law
from nnode.model.term import Interval
from nnode.population.drivers import fit_drivers
from nnode.population.followers import paths_of
from nnode.population.intervals import deviation_intervals, influence
from nnode.population.likelihood import NOISE

#: Platoons, vehicles, s, sampling interval and step, s, errors of measurement, m.
PLATOONS, VEHICLES, SECONDS, DT, STEP, ERROR = 8, 5, 30.0, 0.2, 0.02, 0.05


def platoons(differ: float, seed: int) -> tuple[list[Sequence], np.ndarray]:
    """Platoons of v = v0 (1 - 6 m / gap), v0 log-normal around 29 m/s, pushed for 4 s."""
    rng = np.random.default_rng(seed)
    v0 = 29.0 * np.exp(differ * rng.normal(size=(PLATOONS, VEHICLES - 1)))
    keep, every = np.exp(-STEP / 4.0), round(DT / STEP)
    mean, phase = rng.uniform(11, 17, PLATOONS), rng.uniform(0, 6, PLATOONS)
    gaps = 6.0 / (1 - mean[:, None] / v0)
    x = np.concatenate([np.zeros((PLATOONS, 1)), -gaps.cumsum(1)], 1)
    push, paths = np.zeros_like(v0), []
    for k in range(round(SECONDS / STEP) + 1):
        if k % every == 0:
            paths.append(x + ERROR * rng.normal(size=x.shape))
        lead = mean + 1.5 * np.sin(2 * np.pi * k * STEP / 13 + phase)
        speed = v0 * (1 - 6.0 / (x[:, :-1] - x[:, 1:])) + push
        push = keep * push + 0.2 * np.sqrt(1 - keep**2) * rng.normal(size=push.shape)
        x = x + STEP * np.concatenate([lead[:, None], speed], 1)
    every_path = np.array(paths)[:, :, ::-1]
    time = DT * np.arange(len(paths))
    found = [
        Sequence(name=f"{b}", recording=f"{b}", time=time, x=every_path[:, b, :, None])
        for b in range(PLATOONS)
    ]
    return found, v0[:, ::-1]


def test_drivers_who_differ_are_found_and_told_apart() -> None:
    sequences, v0 = platoons(0.15, 1)
    system = Traffic([make_law("lin")], leader="measured").double()
    found = fit_drivers(system, paths_of(sequences, 0.2))
    assert found.random == ["lin.v0"]
    own = found.estimate.agents[:, 0]
    assert np.corrcoef(own, np.log(v0).ravel())[0, 1] > 0.9
    spread, drawn = found.estimate.variances.spread[0], np.log(v0).std()
    assert spread == pytest.approx(drawn, rel=0.2)
    error = 1 / np.sqrt(np.diag(found.marginal.information))
    truth = np.array([np.log(v0).mean(), np.log(6.0)])
    assert (np.abs(found.estimate.theta - truth) < 4 * error).all()
    half = influence(found, found.model.paths.sequence)[0].half_widths()
    assert (np.abs(found.estimate.theta - truth) < half).all()
    assert (half < 0.1).all()
    push, lasting, _, differ, start = deviation_intervals(found)
    for (low, high), true in ((push, 0.2), (lasting, 4.0), (differ, drawn)):
        assert low < true < high < 2.5 * low
    assert np.isnan(start).all()  # it is given


def test_drivers_alike_do_not_differ() -> None:
    sequences, _ = platoons(0.0, 2)
    system = Traffic([make_law("lin")], leader="measured").double()
    found = fit_drivers(system, paths_of(sequences, 0.2))
    assert found.random == []
    sigma, _, error = found.estimate.variances.noise
    assert sigma == pytest.approx(0.2, rel=0.2)
    assert error == pytest.approx(ERROR, rel=0.1)


@pytest.mark.parametrize("law", ["lin", "idm"])
def test_errors_that_last_are_found_and_told_apart_from_pushes(law: str) -> None:
    table = benchmark_platoons(law, "none", 0.15, 21, 16, nature="lasting")
    system = Traffic([make_law(law)], leader="measured").double()
    found = fit_drivers(system, paths_of(list(nnode.sequences(table)), 0.2), pairs=0)
    true = {"push": PUSH[law], "push_time": LASTS, "lasting_error": 0.06, "lasting_error_time": 1.0}
    noise = dict(zip(NOISE, found.estimate.variances.noise, strict=True))
    for name, value in true.items():
        assert noise[name] == pytest.approx(value, rel=0.5), name


def test_white_errors_do_not_last() -> None:
    sequences, _ = platoons(0.15, 3)
    system = Traffic([make_law("lin")], leader="measured").double()
    found = fit_drivers(system, paths_of(sequences, 0.2), pairs=0)
    assert len(found.estimate.variances.noise) == 3


def test_with_v0_at_its_bound_l_is_the_most_likely_one_there() -> None:
    sequences, _ = platoons(0.15, 4)
    law = make_law("lin")
    law.bounds["v0"] = Interval(0.0, 24.0)  # below most drivers
    law.project_()
    system = Traffic([law], leader="measured").double()
    found = fit_drivers(system, paths_of(sequences, 0.2), "none", pairs=0).estimate
    assert found.converged
    assert np.exp(found.theta[0]) == pytest.approx(24.0)
    products = found.marginal.agents.sum(0)
    slope = products[1:, 0]  # of the log likelihood
    assert slope[0] > 0
    assert abs(slope[1]) < 0.02 * np.sqrt(products[2, 2])


def test_an_unknown_parameter_is_refused() -> None:
    sequences, _ = platoons(0.0, 2)
    system = Traffic([make_law("lin")], leader="measured").double()
    with pytest.raises(ConfigError, match=r"drivers=T is no parameter .* v0, L"):
        fit_drivers(system, paths_of(sequences, 0.2), ["T"])


def test_positions_apart_in_time_have_the_same_starts_and_parameters() -> None:
    sequences, _ = platoons(0.0, 5)
    every = paths_of(sequences, 0.2)
    apart = every.apart(1.0)
    times = np.flatnonzero(apart.observed[0])
    assert len(times) == 31
    np.testing.assert_allclose(np.diff(times) * DT, 1.0)
    everything = np.ones(every.x.shape[1], dtype=bool)
    np.testing.assert_allclose(
        apart.starting_from(everything).start, every.starting_from(everything).start
    )
    system = Traffic([make_law("lin")], leader="measured").double()
    found = fit_drivers(system, apart, "none")
    deviation = 1 / np.sqrt(np.diag(found.marginal.information))
    assert (np.abs(found.estimate.theta - np.log([29.0, 6.0])) < 4 * deviation).all()
