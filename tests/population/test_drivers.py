"""Mixed-effects fits to platoons that are simulated without the package."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

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
from nnode.population.drivers import PAIRS, Population, fit_drivers, refit, with_random_effects
from nnode.population.followers import Paths, longest_step, paths_of
from nnode.population.intervals import deviation_intervals, influence
from nnode.population.likelihood import NOISE
from tests.diagnosis.platoons import DT, LENGTH, V0
from tests.diagnosis.platoons import platoons as following

#: Standard deviation of measurement errors, m.
ERROR = 0.05


def platoons(spread: float, seed: int) -> tuple[list[Sequence], np.ndarray]:
    """Platoons with transient deviations of 4 s, and each driver's v0.

    Args:
        spread: standard deviation of the logarithm of v0, around 28 m/s.
    """
    factor = np.exp(spread * np.random.default_rng(seed).normal(size=(8, 4)))
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


def platoon_paths(spread: float, seed: int) -> Paths:
    return paths_of(platoons(spread, seed)[0], 0.2)


def law(**bounds: Interval) -> Traffic:
    """The law of :func:`platoons` with other bounds of parameters."""
    lin = make_law("lin")
    lin.bounds.update(bounds)
    lin.project_()
    return Traffic([lin], leader="measured").double()


@pytest.fixture(scope="module")
def population() -> Population:
    """A fit to drivers whose v0 differs."""
    return fit_drivers(law(), platoon_paths(0.15, 1), ["v0"], pairs=0)


def fit_benchmark(
    name: str,
    drivers: str | list[str] = "auto",
    *effects: Effect,
    effect: str = "none",
    seed: int = 7606,
    pairs: int = 0,
    **options: Any,
) -> Population:
    """A fit of a law with effects to 16 platoons of the benchmark."""
    table = benchmark_platoons(name, effect, 0.15, seed, 16, **options)
    system = Traffic([make_law(name), *effects], leader="measured").double()
    return fit_drivers(system, paths_of(list(nnode.sequences(table)), 0.2), drivers, pairs=pairs)


def test_driver_parameters_are_recovered() -> None:
    sequences, v0 = platoons(0.15, 1)
    population = fit_drivers(law(), paths_of(sequences, 0.2))
    assert len(population.estimate.variances.noise) == 3  # no autocorrelated measurement errors
    assert population.random == ["lin.v0"]
    deviations = population.estimate.agents[:, 0]
    assert np.corrcoef(deviations, np.log(v0).ravel())[0, 1] > 0.9
    spread, true_spread = population.estimate.variances.spread[0], np.log(v0).std()
    assert spread == pytest.approx(true_spread, rel=0.2)
    error = 1 / np.sqrt(np.diag(population.marginal.information))
    truth = np.array([np.log(v0).mean(), np.log(LENGTH)])
    assert (np.abs(population.estimate.theta - truth) < 4 * error).all()
    half_widths = influence(population, population.model.paths.sequence)[0].half_widths()
    assert (np.abs(population.estimate.theta - truth) < half_widths).all()
    assert (half_widths < 0.1).all()
    push, push_time, _, spread_interval, start = deviation_intervals(population)
    for (low, high), true in ((push, 0.2), (push_time, 4.0), (spread_interval, true_spread)):
        assert low < true < high < 2.5 * low
    assert np.isnan(start).all()  # the start's deviation is given, not estimated


def test_identical_drivers_get_no_random_effects() -> None:
    population = fit_drivers(law(), platoon_paths(0.0, 2), pairs=0)
    assert population.random == []
    sigma, _, error = population.estimate.variances.noise
    assert sigma == pytest.approx(0.2, rel=0.2)
    assert error == pytest.approx(ERROR, rel=0.1)


@pytest.mark.thorough
def test_superfluous_random_effects_are_removed() -> None:
    paths = platoon_paths(0.15, 1)
    superfluous = fit_drivers(law(), paths, ["L", "v0"], pairs=0)
    refitted = refit(superfluous, law(), paths, fixed=False)
    assert refitted.random == ["lin.L", "lin.v0"]
    assert with_random_effects(refitted).random == ["lin.v0"]


@pytest.mark.parametrize(
    ("name", "drivers", "seed"),
    # seed 9996: shorter pushes and smaller errors are a second maximum of the likelihood
    [("lin", "auto", 9996), ("idm", ["T", "v0"], 21), ("idm", "auto", 21)],
)
def test_autocorrelated_measurement_errors_are_separated_from_pushes(
    name: str, drivers: str | list[str], seed: int
) -> None:
    population = fit_benchmark(name, drivers, seed=seed, nature="lasting")
    truth = [PUSH[name], LASTS, None, 0.06, 1.0]
    for label, noise, value in zip(NOISE, population.estimate.variances.noise, truth, strict=True):
        assert value is None or noise == pytest.approx(value, rel=0.5), label


def test_leader_errors_do_not_bias_pushes() -> None:
    population = fit_benchmark("lin", error=0.3)
    # the leaders' errors are autocorrelated, the followers' own errors are not
    assert len(population.estimate.variances.noise) == 3
    push, push_time = deviation_intervals(population)[:2]
    assert push[0] < PUSH["lin"] < push[1]
    assert push_time[0] < LASTS < push_time[1]


def test_inertia_is_not_fitted_as_autocorrelated_errors() -> None:
    population = fit_benchmark("lin", ["v0"], Inertia(tau_v=0.3), effect="inertia", seed=9101)
    assert len(population.estimate.variances.noise) == 3
    push = deviation_intervals(population)[0]
    assert push[0] < PUSH["lin"] < push[1]


def test_longest_step_depends_on_the_model() -> None:
    def longest(name: str, *effects: Effect) -> float:
        system = Traffic([make_law(name), *effects], leader="measured")
        return longest_step(system, ParameterVector(system).row[None], 0.2)

    assert longest("idm") == 0.2
    assert longest("krauss") == 0.1
    assert longest("idm", SpeedZone(alpha=0.8, a=0.0, b=50.0)) == 0.1
    # the Padé approximation of the delay has poles at 3.46 / T
    delayed = longest("idm", ReactionDelay(T=0.3))
    assert 0.2 * 0.3 < delayed < 0.3 / 3.4


def test_interval_of_absent_pushes_starts_at_zero() -> None:
    sequences = following(lambda x, law, lead: law, number=8, seconds=30.0, noise=ERROR, seed=5)
    population = fit_drivers(law(), paths_of(sequences, 0.2), "none", pairs=0)
    push, push_time, *_ = deviation_intervals(population)
    assert push[0] == 0.0
    assert population.estimate.variances.noise[0] < push[1] < 0.1
    assert np.isnan(push_time).all()


@pytest.mark.parametrize("longest", [1.0, 1.05])
def test_pushes_with_a_time_near_its_bound_have_no_interval(
    longest: float, population: Population
) -> None:
    before = population.estimate.variances
    high = before.high.copy()
    high[1] = longest * before.noise[1]
    bounded = replace(population.estimate, variances=replace(before, high=high))
    ends = deviation_intervals(Population.uncorrected(population.model, bounded))
    assert np.isnan(ends[:2]).all()
    assert ends[3, 0] < ends[3, 1]  # that of differences between drivers remains


def test_negligible_autocorrelated_errors_do_not_change_other_intervals(
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
    extended = Population.uncorrected(
        population.model, replace(population.estimate, variances=tiny)
    )
    ends, expected = deviation_intervals(extended), deviation_intervals(population)
    np.testing.assert_allclose(ends[[0, 1, 5]], expected[[0, 1, 3]], rtol=1e-3)
    assert ends[3, 0] == 0.0
    assert 0.003 < ends[3, 1] < ERROR
    assert np.isnan(ends[4]).all()


def test_intervals_follow_from_the_uncorrected_estimate(
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
def test_variance_bias_of_rarely_reached_speeds_is_corrected() -> None:
    population = fit_benchmark("idm", ["T", "v0"], pairs=PAIRS)
    measurement, gap, speed = population.variance_bias[2:5]
    assert measurement == pytest.approx(1.0)  # fourth differences determine it
    assert gap == pytest.approx(1.0, abs=0.1)
    assert speed < 0.95
    _, corrected = population.estimate.variances.spread
    _, uncorrected = fit_benchmark("idm", ["T", "v0"]).estimate.variances.spread
    assert corrected * speed == pytest.approx(uncorrected)


def test_simulations_with_overtaking_drivers_are_drawn_again(
    population: Population,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    simulated = partial(followers.simulated_pairs, population.model, population.estimate)
    (expected,) = simulated(seed=1, pairs=1)
    draws = followers.antithetic_draws

    def passing(below: int, seed: int) -> list[followers.Draw]:
        return [lambda shape: np.full(shape, 30.0)] * 2 if seed < below else draws(seed)

    monkeypatch.setattr(followers, "antithetic_draws", partial(passing, 1))
    (replaced,) = simulated(seed=0, pairs=1)
    np.testing.assert_array_equal(replaced[0][0].paths.x, expected[0][0].paths.x)
    monkeypatch.setattr(followers, "antithetic_draws", partial(passing, 99))
    with pytest.raises(SimulationError, match="leave the road"):
        simulated(seed=0, pairs=1)


def test_simulated_drivers_start_at_their_equilibrium_gaps() -> None:
    population = fit_benchmark("idm", ["T"])
    deviations = population.estimate.agents.shape

    def mean_gap(sign: float) -> float:
        """The mean gap at the start if T deviates by one standard deviation."""
        paths = population.model.simulated_paths(
            population.estimate, lambda shape: np.full(shape, sign * (shape == deviations))
        )
        return float((paths.ahead_at_samples[0, 0] - paths.x[:, 0]).mean())

    change = (mean_gap(1.0) - mean_gap(-1.0)) / (2 * population.estimate.variances.spread[0])
    # a gap contains v T, and benchmark drivers start at their equilibrium gaps
    assert change == pytest.approx(T * population.model.paths.start[1].mean(), rel=0.2)


def test_short_paths_have_no_leader_errors() -> None:
    sequences, _ = platoons(0.15, 1)
    short = paths_of([s.part(0.0, 5.5 / s.n_samples) for s in sequences], 0.2)
    assert short.x.shape[1] == 5
    assert short.leader == pytest.approx((0.0, DT / 2))


def test_length_is_most_likely_given_v0_at_its_bound() -> None:
    bounded = law(v0=Interval(0.0, 24.0))
    estimate = fit_drivers(bounded, platoon_paths(0.15, 4), "none", pairs=0).estimate
    assert estimate.converged
    assert np.exp(estimate.theta[0]) == pytest.approx(24.0)
    products = estimate.marginal.agents.sum(0)
    slope = products[1:, 0]  # of the log-likelihood
    assert slope[0] > 0
    assert abs(slope[1]) < 0.02 * np.sqrt(products[2, 2])


def test_unknown_parameter_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"drivers=T is no parameter .* v0, L"):
        fit_drivers(law(), platoon_paths(0.0, 2), ["T"])


@pytest.mark.thorough
def test_thinned_positions_give_the_same_starts_and_parameters() -> None:
    paths = platoon_paths(0.0, 5)
    thinned = paths.apart(1.0)
    times = np.flatnonzero(thinned.observed[0])
    assert len(times) == 31
    np.testing.assert_allclose(np.diff(times) * DT, 1.0)
    everything = np.ones(paths.x.shape[1], dtype=bool)
    np.testing.assert_allclose(
        thinned.starting_from(everything).start, paths.starting_from(everything).start
    )
    population = fit_drivers(law(), thinned, "none")
    deviation = 1 / np.sqrt(np.diag(population.marginal.information))
    assert (np.abs(population.estimate.theta - np.log([V0, LENGTH])) < 4 * deviation).all()


def circular_roads(spread: float) -> list[Sequence]:
    """Dense traffic of ``idm`` on circular roads, where nobody drives near v0. Without a vehicle
    length, s0 contains that of 4.5 m."""
    rng, cars, step, measured = np.random.default_rng(3), 12, 0.05, []
    length = 13.6 * cars
    for run in range(4):
        headway = 1.2 * np.exp(spread * rng.normal(size=cars))
        x = length / cars * np.arange(cars) + rng.normal(0, 0.5, cars)
        v, push, path = np.full(cars, 4.0), np.zeros(cars), []
        for k in range(1000):
            if k % 4 == 0:
                path.append(x + 0.1 * rng.normal(size=cars))
            gap = np.maximum((np.roll(x, -1) - x) % length - 4.5, 0.5)
            braking = v * (v - np.roll(v, -1)) / (2 * np.sqrt(1.2 * 1.5))
            wish = 2 + np.maximum(0, v * headway + braking)
            push = push * np.exp(-step / 4) + 0.1 * np.sqrt(step / 2) * rng.normal(size=cars)
            v = np.maximum(v + step * (1.2 * (1 - (v / 12) ** 4 - (wish / gap) ** 2) + push), 0.0)
            x = x + step * v
        time, positions = 0.2 * np.arange(len(path)), np.array(path)[..., None]
        measured.append(Sequence(name=f"{run}", recording=f"{run}", time=time, x=positions))
    return measured


def test_parameter_at_a_bound_is_fixed_in_the_correction_of_biases() -> None:
    start = make_law("idm", v0=14.0, T=1.3, s0=6.0, a=1.3, b=1.5)
    paths = paths_of(circular_roads(0.15), 0.2)
    population = fit_drivers(Traffic([start], leader="measured").double(), paths, ["T"])
    assert population.estimate.converged
    reached = population.model.bounds_reached(population.estimate.theta)
    assert dict(zip(population.model.names, reached, strict=True))["idm.v0"] == "high"
    assert population.bias[population.model.names.index("idm.v0")] == 0
    assert np.abs(population.bias).max() < 0.15
    assert population.estimate.variances.spread == pytest.approx([0.15], rel=0.35)
    assert population.estimate.agents.std() == pytest.approx(0.15, rel=0.35)
