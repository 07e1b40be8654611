"""The marginal likelihood (Kalman filter, Woodbury identity) against a dense Gaussian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from nnode.population.likelihood import (
    Linearised,
    Marginal,
    PushNoise,
    RestartNoise,
    marginal,
)

#: Pushes: standard deviation and correlation time (s); sampling interval, s; measurement error, m.
SIGMA, TAU, DT, ERROR = 0.4, 1.7, 0.2, 0.05
#: Standard deviations of the random effects and of the starts.
SPREAD, START = np.array([0.3, 0.7]), np.array([0.2])
#: Standard deviations of positions, m, and speeds, m/s, where simulated paths restart.
POSITION, SPEED = 0.15, 0.3


def example(seed: int, states: int, leader: tuple[float, float] = (0.0, 1.0)) -> Linearised:
    """Three segments of two agents; some samples are missing.

    Args:
        leader: standard deviation and correlation time of errors of the leader's path.
    """
    rng = np.random.default_rng(seed)
    segments, samples = 3, 12
    observed = rng.random((segments, samples)) < 0.8
    observed[1, 9:] = False
    step = 0.9 * np.eye(states) + 0.05 * rng.normal(size=(segments, samples - 1, states, states))
    return Linearised(
        residual=rng.normal(size=(segments, samples)),
        fixed=rng.normal(size=(segments, samples, 3)),
        random=np.array([2, 0]),
        start=rng.normal(size=(segments, samples, 1)),
        observed=observed,
        agent=np.array([0, 1, 0]),
        step=step,
        forced=rng.normal(size=(segments, samples - 1, states, 2)),
        leader=leader,
        dt=DT,
    )


def mean_covariance(number: int, step: float) -> np.ndarray:
    """``(number, number)`` covariances of the means of an Ornstein-Uhlenbeck process of variance 1
    over intervals, one after the other, that are ``step`` correlation times long."""
    keep, lag = np.exp(-step), np.abs(np.subtract.outer(np.arange(number), np.arange(number)))
    apart = (1 - keep) ** 2 / step**2 * np.exp(-step * (lag - 1))
    return np.asarray(np.where(lag == 0, 2 / step**2 * (step - 1 + keep), apart))


def mean_given_ends(step: float) -> tuple[float, float]:
    """The regression of such a mean on the mean of both ends of its interval, and the variance that
    remains."""
    keep = np.exp(-step)
    share = 2 / step * (1 - keep) / (1 + keep)
    return share, mean_covariance(1, step)[0, 0] - share**2 * (1 + keep) / 2


def covariance(data: Linearised, lasting: tuple[float, ...]) -> np.ndarray:
    """The dense covariance matrix of all samples of all segments.

    Args:
        lasting: standard deviation and correlation time of measurement errors, or nothing.
    """
    segments, samples = data.residual.shape
    lag = np.abs(np.arange(samples)[:, None] - np.arange(samples)) * DT
    matrix = np.zeros((segments * samples, segments * samples))
    assert data.step is not None
    assert data.forced is not None
    for s in range(segments):
        block = slice(s * samples, (s + 1) * samples)
        start = data.start[s] * START
        matrix[block, block] = start @ start.T + ERROR**2 * np.eye(samples)
        for p, (sigma, tau) in enumerate([(SIGMA, TAU), data.leader]):
            response = np.zeros((samples, samples))
            state = np.zeros((data.step.shape[-1], samples))
            process = sigma**2 * np.exp(-lag / tau)
            if p == 0:
                process = sigma**2 * mean_covariance(samples, DT / tau)
            for k in range(samples - 1):
                # of a push twice its mean over the interval
                ends = 2 * np.eye(samples)[k] if p == 0 else np.eye(samples)[k : k + 2].sum(0)
                state = data.step[s, k] @ state + np.outer(data.forced[s, k, :, p], ends)
                response[k + 1] = state[0]
            matrix[block, block] += response @ process @ response.T
        if lasting:
            matrix[block, block] += lasting[0] ** 2 * np.exp(-lag / lasting[1])
    random = (data.by_deviation * SPREAD).reshape(segments * samples, -1)
    same = np.equal.outer(*[np.repeat(data.agent, samples)] * 2)
    return np.asarray(matrix + same * (random @ random.T))


@pytest.mark.parametrize("leader", [(0.0, 1.0), (0.3, 0.5)])
@pytest.mark.parametrize("lasting", [(), (0.1, 0.7)])
@pytest.mark.parametrize("states", [1, 2])
@pytest.mark.parametrize("seed", range(3))
def test_filter_equals_a_dense_gaussian(
    seed: int, states: int, lasting: tuple[float, ...], leader: tuple[float, float]
) -> None:
    data = example(seed, states, leader)
    observed = data.observed.ravel()
    v = covariance(data, lasting)[np.ix_(observed, observed)]
    x, w = data.fixed.reshape(-1, 3)[observed], data.residual.ravel()[observed]
    information = x.T @ np.linalg.solve(v, x)
    change = np.linalg.solve(information, x.T @ np.linalg.solve(v, w))
    loglik = multivariate_normal(np.zeros(len(w)), v).logpdf(w - x @ change)
    # Harville 1977
    loss = 1.5 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(information)[1]

    noise = PushNoise()
    products = noise.products(data, np.array([SIGMA, TAU, ERROR, *lasting]))
    result = marginal(data, products, SPREAD, START)
    restricted = marginal(data, products, SPREAD, START, restricted=True)

    assert result.loglik == pytest.approx(loglik, rel=1e-8)
    assert result.each.sum() == pytest.approx(loglik, rel=1e-8)
    assert restricted.loglik == pytest.approx(loglik + loss, rel=1e-8)
    np.testing.assert_allclose(result.change, change, rtol=1e-8)
    np.testing.assert_allclose(result.information, information, rtol=1e-8)
    agent = np.repeat(data.agent, data.observed.shape[1])[observed]
    weighted = np.linalg.solve(v, w - x @ change)
    for d in range(2):
        z = data.by_deviation.reshape(-1, 2)[observed] * (agent == d)[:, None]
        np.testing.assert_allclose(result.deviations[d], SPREAD**2 * (z.T @ weighted), rtol=1e-7)
        variance = SPREAD**2 - SPREAD**4 * np.diag(z.T @ np.linalg.solve(v, z))
        np.testing.assert_allclose(result.variances[d], variance, rtol=1e-7)


@pytest.mark.parametrize("restricted", [False, True])
def test_derivatives_by_standard_deviations(restricted: bool) -> None:
    data, number = example(4, 2), len(SPREAD)
    products = PushNoise().products(data, np.array([SIGMA, TAU, ERROR]))
    logs = np.log([*SPREAD, *START])

    def likelihood(shifted: np.ndarray) -> Marginal:
        deviations = np.exp(shifted)
        return marginal(
            data, products, deviations[:number], deviations[number:], restricted=restricted
        )

    calculated = likelihood(logs)
    derivatives = np.concatenate([calculated.by_spread.sum(0), calculated.by_start.sum(0)])
    step = 1e-5
    differences = [
        (likelihood(logs + change).loglik - likelihood(logs - change).loglik) / (2 * step)
        for change in step * np.eye(len(logs))
    ]
    np.testing.assert_allclose(derivatives, differences, rtol=1e-5)


def test_bounded_change_maximises_the_likelihood() -> None:
    data = example(5, 2)
    products = PushNoise().products(data, np.array([SIGMA, TAU, ERROR]))
    free = marginal(data, products, SPREAD, START)
    low, high = free.change - 1.0, free.change + np.array([-0.2, 1.0, 1.0])
    bounded = marginal(data, products, SPREAD, START, low=low, high=high)
    assert bounded.change[0] == pytest.approx(high[0])
    fixed = bounded.change + np.outer(np.linspace(-1e-3, 1e-3, 3), [0.0, 1.0, 0.0])
    values = [marginal(data, products, SPREAD, START, low=c, high=c).loglik for c in fixed]
    assert values[1] == pytest.approx(bounded.loglik)
    assert max(values) == values[1] < free.loglik


def restarting(seed: int) -> Linearised:
    """Two people in two dimensions, whose paths restart after eight of twelve times; the last four
    of the second person are missing."""
    rng = np.random.default_rng(seed)
    people, times = 2, 12
    step = 0.9 * np.eye(4) + 0.05 * rng.normal(size=(people, times - 1, 4, 4))
    restart = np.zeros((people, times), dtype=bool)
    restart[:, [0, 8]] = True
    observed = np.ones((people, 2 * times), dtype=bool)
    observed[1, 16:] = False
    observed[0, 5] = False
    data = Linearised(
        residual=rng.normal(size=(people, 2 * times)),
        fixed=rng.normal(size=(people, 2 * times, 3)),
        random=np.array([2, 0]),
        start=np.zeros((people, 2 * times, 0)),
        observed=observed,
        agent=np.array([0, 1]),
        step=step,
        forced=rng.normal(size=(people, times - 1, 4, 2)),
        restart=restart,
        weight=np.ones((people, 2 * times)),
        dt=DT,
    )
    heading = rng.normal(size=(people, times, 2))
    return replace(data, heading=heading / np.linalg.norm(heading, axis=-1, keepdims=True))


def restarting_covariance(data: Linearised, person: int, sway: tuple[float, ...]) -> np.ndarray:
    """The dense covariance of a person's samples, from independent numbers of variance 1."""
    assert data.step is not None
    assert data.forced is not None
    assert data.restart is not None
    assert data.heading is not None
    times, keep = len(data.restart[person]), np.exp(-DT / TAU)
    numbers = iter(np.eye(14 * times))
    share, within = mean_given_ends(DT / TAU)

    def drawn(deviations: list[float]) -> np.ndarray:
        return np.array([deviation * next(numbers) for deviation in deviations])

    sizes, frequency, lasts = sway[:2], sway[2], sway[3]
    swings = [drawn([size, size]) for size in sizes]
    d, e, rows = np.zeros((4, 14 * times)), drawn([SIGMA] * 2), []
    for k in range(times):
        if k:
            before = e
            e = keep * e + drawn([SIGMA * np.sqrt(1 - keep**2)] * 2)
            twice = share * (before + e) + drawn([2 * SIGMA * np.sqrt(within)] * 2)
            d = data.step[person, k - 1] @ d + data.forced[person, k - 1] @ twice
            for number, size in enumerate(sizes):
                angle, kept = 2 * np.pi * frequency * (number + 1) * DT, np.exp(-DT / lasts)
                cosine, sine = np.cos(angle), np.sin(angle)
                turned = kept * np.array([[cosine, sine], [-sine, cosine]]) @ swings[number]
                swings[number] = turned + drawn([size * np.sqrt(1 - kept**2)] * 2)
        along = data.heading[person, k]
        ways = np.array([-along[1], along[0]]), along
        place = sum(np.outer(way, swing[0]) for way, swing in zip(ways, swings, strict=True))
        if data.restart[person, k]:
            d, e = drawn([POSITION] * 2 + [SPEED] * 2), drawn([SIGMA] * 2)
        rows += list(d[:2] + place)
    map_ = np.array(rows)
    random = data.by_deviation[person] * SPREAD
    covariance: np.ndarray = map_ @ map_.T + ERROR**2 * np.eye(len(map_)) + random @ random.T
    return covariance


@pytest.mark.parametrize("sway", [(), (0.3, 0.1, 0.9, 2.0)])
@pytest.mark.parametrize("seed", range(3))
def test_filter_with_restarts_equals_a_dense_gaussian(seed: int, sway: tuple[float, ...]) -> None:
    data, values = restarting(seed), np.array([SIGMA, TAU, ERROR, *sway])
    products = RestartNoise(POSITION, SPEED).products(data, values)
    zero = np.zeros(3)
    result = marginal(data, products, SPREAD, np.zeros(0), low=zero, high=zero)
    for person in range(2):
        seen = data.observed[person]
        matrix = restarting_covariance(data, person, sway or (0.0, 0.0, 1.0, 1.0))
        gaussian = multivariate_normal(np.zeros(seen.sum()), matrix[np.ix_(seen, seen)])
        expected = gaussian.logpdf(data.residual[person, seen])
        assert result.each[person] == pytest.approx(expected, abs=1e-8)


def test_weights_scale_whitened_samples() -> None:
    data, noise = restarting(5), RestartNoise(POSITION, SPEED)
    values = np.array([SIGMA, TAU, ERROR])
    weight = np.repeat([1.0, 0.25, 0.5], 8)[None].repeat(2, 0)
    plain = noise.whitened(data, data.columns, values)
    weighted = noise.whitened(replace(data, weight=weight), data.columns, values)
    np.testing.assert_allclose(weighted[0], np.sqrt(weight)[..., None] * plain[0])
    np.testing.assert_array_equal(weighted[1], plain[1])
