"""Drivers who differ, simulated without the package."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import nnode
from benchmarks.drivers import LASTS, PUSH, T
from benchmarks.drivers import platoons as benchmark_platoons
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError, SimulationError
from nnode.model import Traffic, make_law
from nnode.model.effects import Effect
from nnode.model.effects.lane import Inertia, ReactionDelay, SpeedZone
from nnode.model.term import Interval
from nnode.population import followers
from nnode.population.drivers import Population, fit_drivers, refit, with_random_effects
from nnode.population.followers import longest_step, paths_of
from nnode.population.intervals import deviation_intervals, influence
from nnode.population.likelihood import NOISE
from tests.diagnosis.platoons import DT, LENGTH, V0
from tests.diagnosis.platoons import platoons as following

#: Errors of measurement, m.
ERROR = 0.05


def platoons(differ: float, seed: int) -> tuple[list[Sequence], np.ndarray]:
    """Platoons whose drivers have log-normal v0 around 28 m/s and are pushed for 4 s, and v0."""
    factor = np.exp(differ * np.random.default_rng(seed).normal(size=(8, 4)))
    sequences = following(
        lambda x, law, lead: factor * law,
        number=8,
        seconds=30.0,
        noise=ERROR,
        driver=0.2,
        lasts=4.0,
        seed=seed,
    )
    return sequences, V0 * factor


def law(**bounds: Interval) -> Traffic:
    """The law that they drive by, with other bounds of parameters."""
    lin = make_law("lin")
    lin.bounds.update(bounds)
    lin.project_()
    return Traffic([lin], leader="measured").double()


@pytest.fixture(scope="module")
def population() -> Population:
    """Drivers whose v0 differs."""
    sequences, _ = platoons(0.15, 1)
    return fit_drivers(law(), paths_of(sequences, 0.2), ["v0"], pairs=0)


def test_drivers_who_differ_are_found_and_told_apart() -> None:
    sequences, v0 = platoons(0.15, 1)
    population = fit_drivers(law(), paths_of(sequences, 0.2))
    assert len(population.estimate.variances.noise) == 3  # white errors do not last
    assert population.random == ["lin.v0"]
    own = population.estimate.agents[:, 0]
    assert np.corrcoef(own, np.log(v0).ravel())[0, 1] > 0.9
    spread, drawn = population.estimate.variances.spread[0], np.log(v0).std()
    assert spread == pytest.approx(drawn, rel=0.2)
    error = 1 / np.sqrt(np.diag(population.marginal.information))
    truth = np.array([np.log(v0).mean(), np.log(LENGTH)])
    assert (np.abs(population.estimate.theta - truth) < 4 * error).all()
    half = influence(population, population.model.paths.sequence)[0].half_widths()
    assert (np.abs(population.estimate.theta - truth) < half).all()
    assert (half < 0.1).all()
    push, lasting, _, differ, start = deviation_intervals(population)
    for (low, high), true in ((push, 0.2), (lasting, 4.0), (differ, drawn)):
        assert low < true < high < 2.5 * low
    assert np.isnan(start).all()  # it is given


def test_drivers_alike_do_not_differ() -> None:
    sequences, _ = platoons(0.0, 2)
    population = fit_drivers(law(), paths_of(sequences, 0.2), pairs=0)
    assert population.random == []
    sigma, _, error = population.estimate.variances.noise
    assert sigma == pytest.approx(0.2, rel=0.2)
    assert error == pytest.approx(ERROR, rel=0.1)


@pytest.mark.thorough
def test_differences_that_are_not_needed_are_removed() -> None:
    sequences, _ = platoons(0.15, 1)
    paths = paths_of(sequences, 0.2)
    superfluous = fit_drivers(law(), paths, ["L", "v0"], pairs=0)
    refitted = refit(superfluous, law(), paths, fixed=False)
    assert refitted.random == ["lin.L", "lin.v0"]
    assert with_random_effects(refitted).random == ["lin.v0"]


@pytest.mark.parametrize(
    ("name", "drivers"), [("lin", "auto"), ("idm", ["T", "v0"]), ("idm", "auto")]
)
def test_errors_that_last_are_found_and_told_apart_from_pushes(
    name: str, drivers: str | list[str]
) -> None:
    table = benchmark_platoons(name, "none", 0.15, 21, 16, nature="lasting")
    system = Traffic([make_law(name)], leader="measured").double()
    population = fit_drivers(system, paths_of(list(nnode.sequences(table)), 0.2), drivers, pairs=0)
    true = [PUSH[name], LASTS, None, 0.06, 1.0]
    for what, noise, value in zip(NOISE, population.estimate.variances.noise, true, strict=True):
        assert value is None or noise == pytest.approx(value, rel=0.5), what


def test_errors_of_leaders_are_neither_pushes_nor_errors_that_last() -> None:
    table = benchmark_platoons("lin", "none", 0.15, 7606, 16, error=0.3)
    system = Traffic([make_law("lin")], leader="measured").double()
    population = fit_drivers(system, paths_of(list(nnode.sequences(table)), 0.2), pairs=0)
    assert len(population.estimate.variances.noise) == 3  # the leaders' errors last, the own do not
    push, lasts = deviation_intervals(population)[:2]
    assert push[0] < PUSH["lin"] < push[1]
    assert lasts[0] < LASTS < lasts[1]


def test_a_memory_is_no_error_that_lasts() -> None:
    table = benchmark_platoons("lin", "inertia", 0.15, 9101, 16)
    system = Traffic([make_law("lin"), Inertia(tau_v=0.3)], leader="measured").double()
    population = fit_drivers(system, paths_of(list(nnode.sequences(table)), 0.2), ["v0"], pairs=0)
    assert len(population.estimate.variances.noise) == 3
    push = deviation_intervals(population)[0]
    assert push[0] < PUSH["lin"] < push[1]


def test_steps_are_as_short_as_the_model_needs() -> None:
    def longest(name: str, *effects: Effect) -> float:
        system = Traffic([make_law(name), *effects], leader="measured")
        return longest_step(system, ParameterVector(system).row[None], 0.2)

    assert longest("idm") == 0.2
    assert longest("krauss") == 0.1
    assert longest("idm", SpeedZone(alpha=0.8, a=0.0, b=50.0)) == 0.1
    # a response of Pade's delay has poles at 3.46 / T
    delayed = longest("idm", ReactionDelay(T=0.3))
    assert 0.2 * 0.3 < delayed < 0.3 / 3.4


def test_pushes_that_do_not_exist_have_an_interval_from_zero() -> None:
    sequences = following(lambda x, law, lead: law, number=8, seconds=30.0, noise=ERROR, seed=5)
    population = fit_drivers(law(), paths_of(sequences, 0.2), "none", pairs=0)
    push, lasting, *_ = deviation_intervals(population)
    assert push[0] == 0.0
    assert population.estimate.variances.noise[0] < push[1] < 0.1
    assert np.isnan(lasting).all()


def test_errors_that_may_not_exist_leave_the_intervals_of_the_others(
    population: Population,
) -> None:
    before = population.estimate.variances
    low, high = before.low.copy(), before.high.copy()
    tiny = replace(
        before,
        noise=np.append(before.noise, [0.003, 0.3]),
        low=np.insert(low, 3, [0.001, 0.1]),
        high=np.insert(high, 3, [1.0, 5.0]),
    )
    beside = Population.uncorrected(population.model, replace(population.estimate, variances=tiny))
    ends, without = deviation_intervals(beside), deviation_intervals(population)
    np.testing.assert_allclose(ends[[0, 1, 5]], without[[0, 1, 3]], rtol=1e-3)
    assert ends[3, 0] == 0.0
    assert 0.003 < ends[3, 1] < ERROR
    assert np.isnan(ends[4]).all()


def test_intervals_are_those_of_the_estimate_before_its_correction(
    population: Population,
) -> None:
    before = population.estimate.variances
    halved = replace(
        population,
        estimate=replace(
            population.estimate, variances=replace(before, spread=before.spread / 2.0)
        ),
        variance_bias=np.where(np.arange(len(before.row)) == 3, 2.0, 1.0),
    )
    ends, corrected = deviation_intervals(population), deviation_intervals(halved)
    np.testing.assert_allclose(corrected[:3], ends[:3])
    np.testing.assert_allclose(corrected[3], ends[3] / 2.0)
    less_certain = replace(halved, variance_error=np.full(len(before.row), 0.5))
    low, high = deviation_intervals(less_certain)[3]
    deviation = np.log(ends[3, 1] / ends[3, 0]) / (2 * 1.96)
    expected = 2 * 1.96 * np.hypot(deviation, 0.5)
    assert np.log(high / low) == pytest.approx(expected, rel=1e-3)


@pytest.mark.thorough
def test_differences_in_a_speed_that_few_drivers_reach_are_underestimated() -> None:
    table = benchmark_platoons("idm", "none", 0.15, 7606, 16)
    paths = paths_of(list(nnode.sequences(table)), 0.2)
    system = Traffic([make_law("idm")], leader="measured").double()
    population = fit_drivers(system, paths, ["T", "v0"])
    measurement, gap, speed = population.variance_bias[2:5]
    assert measurement == pytest.approx(1.0)  # fourth differences determine it
    assert gap == pytest.approx(1.0, abs=0.1)
    assert speed < 0.95
    # they are corrected
    _, differ = population.estimate.variances.spread
    uncorrected = fit_drivers(system, paths, ["T", "v0"], pairs=0).estimate.variances.spread
    assert differ * speed == pytest.approx(uncorrected[1])


def test_simulations_with_a_driver_who_passes_the_vehicle_ahead_are_replaced(
    population: Population,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    simulated = partial(followers.simulated_pairs, population.model, population.estimate)
    (usual,) = simulated(seed=1, pairs=1)
    draws = followers.antithetic_draws

    def passing(below: int, seed: int) -> list[followers.Draw]:
        return [lambda shape: np.full(shape, 30.0)] * 2 if seed < below else draws(seed)

    monkeypatch.setattr(followers, "antithetic_draws", partial(passing, 1))
    (replaced,) = simulated(seed=0, pairs=1)
    np.testing.assert_array_equal(replaced[0][0].paths.x, usual[0][0].paths.x)
    monkeypatch.setattr(followers, "antithetic_draws", partial(passing, 99))
    with pytest.raises(SimulationError, match="leave the road"):
        simulated(seed=0, pairs=1)


def test_simulated_drivers_start_at_the_gaps_that_they_keep() -> None:
    table = benchmark_platoons("idm", "none", 0.15, 7606, 16)
    system = Traffic([make_law("idm")], leader="measured").double()
    population = fit_drivers(system, paths_of(list(nnode.sequences(table)), 0.2), ["T"], pairs=0)
    deviations = population.estimate.agents.shape

    def mean_gap(sign: float) -> float:
        """At the start, of drivers whose T deviates by one standard deviation."""
        paths = population.model.simulated_paths(
            population.estimate, lambda shape: np.full(shape, sign * (shape == deviations))
        )
        return float((paths.ahead_at_samples[0, 0] - paths.x[:, 0]).mean())

    change = (mean_gap(1.0) - mean_gap(-1.0)) / (2 * population.estimate.variances.spread[0])
    # a gap contains v T, and benchmark drivers start at the gaps that they keep
    assert change == pytest.approx(T * population.model.paths.start[1].mean(), rel=0.2)


def test_paths_that_are_too_short_to_show_errors_have_no_errors_of_leaders() -> None:
    sequences, _ = platoons(0.15, 1)
    short = paths_of([s.part(0.0, 5.5 / s.n_samples) for s in sequences], 0.2)
    assert short.x.shape[1] == 5
    assert short.leader == pytest.approx((0.0, DT / 2))


def test_with_v0_at_its_bound_l_is_the_most_likely_one_there() -> None:
    sequences, _ = platoons(0.15, 4)
    below_most = law(v0=Interval(0.0, 24.0))
    population = fit_drivers(below_most, paths_of(sequences, 0.2), "none", pairs=0).estimate
    assert population.converged
    assert np.exp(population.theta[0]) == pytest.approx(24.0)
    products = population.marginal.agents.sum(0)
    slope = products[1:, 0]  # of the log likelihood
    assert slope[0] > 0
    assert abs(slope[1]) < 0.02 * np.sqrt(products[2, 2])


def test_an_unknown_parameter_is_refused() -> None:
    sequences, _ = platoons(0.0, 2)
    with pytest.raises(ConfigError, match=r"drivers=T is no parameter .* v0, L"):
        fit_drivers(law(), paths_of(sequences, 0.2), ["T"])


@pytest.mark.thorough
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
    population = fit_drivers(law(), apart, "none")
    deviation = 1 / np.sqrt(np.diag(population.marginal.information))
    assert (np.abs(population.estimate.theta - np.log([V0, LENGTH])) < 4 * deviation).all()
