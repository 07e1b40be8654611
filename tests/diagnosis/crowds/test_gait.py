"""People who sway as they step, and how much they accelerate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import nnode
from benchmarks.people import STRIDES, crowds
from nnode.data.sequence import Sequence
from nnode.diagnosis.crowds.engine import SECONDS
from nnode.diagnosis.crowds.gait import (
    estimated_gait,
    walking_straight,
    window_log_likelihoods,
)
from nnode.diagnosis.crowds.people import Gait, People
from nnode.diagnosis.crowds.windows import Windows
from tests.population.test_likelihood import mean_given_ends


def sequences(sway: float, every: int = 1) -> list[Sequence]:
    """People who sway by ``sway`` m; every ``every``-th sample."""
    table = crowds("none", 8, sequences=8, sway=sway)
    return list(nnode.sequences(table[table["time"].rank(method="dense") % every == 0]))


@pytest.fixture(scope="module")
def swaying() -> People:
    return People(Windows(sequences(0.02), SECONDS))


def gait_of(walking: list[Sequence]) -> Gait:
    return estimated_gait(People(Windows(walking, SECONDS)))


def test_parameters_of_sway(swaying: People) -> None:
    (across, along, frequency, lasts), acceleration, *_ = estimated_gait(swaying)
    assert across == pytest.approx(0.02 * np.exp(0.3**2), rel=0.2)
    # smoothed speeds at starts contain less of the sway along the direction, which is fast
    assert 0.3 * across < along < 0.6 * across
    assert frequency == pytest.approx(STRIDES, rel=0.03)
    assert lasts > 2.0  # frequencies of people differ by 8 %
    assert acceleration == pytest.approx(gait_of(sequences(0.0)).acceleration, rel=0.5)


def test_likelihood_of_windows_in_which_people_walk_straight_on() -> None:
    """A dense Gaussian: a person's push is unknown at the start, then it decays."""
    people = People(Windows(sequences(0.0), SECONDS))
    variances = people.initial_variances([])
    windows = walking_straight(people)
    _, terms = window_log_likelihoods(people, windows, variances.noise)
    push, lasts, error = variances.noise
    times, dt = people.windows.length, windows.dt
    step, forced, keep = windows.step[0, 0], windows.forced[0, 0], np.exp(-dt / lasts)
    share, within = mean_given_ends(dt / lasts)
    # the state of one coordinate (position, speed, push) as a sum of independent numbers
    numbers = iter(np.eye(3 + 2 * (times - 1)))
    start = (people.noise.position, people.noise.speed, push)
    state = np.array([deviation * next(numbers) for deviation in start])
    rows = [state[0]]
    for _ in range(times - 1):
        push_now = keep * state[2] + push * np.sqrt(1 - keep**2) * next(numbers)
        twice = share * (state[2] + push_now) + 2 * push * np.sqrt(within) * next(numbers)
        moved = step[[0, 2]][:, [0, 2]] @ state[:2] + np.outer(forced[[0, 2], 0], twice)
        state = np.vstack([moved, push_now])
        rows.append(state[0])
    covariance = np.array(rows) @ np.array(rows).T + error**2 * np.eye(times)
    normal = multivariate_normal(cov=covariance)
    x, y = np.moveaxis(windows.residual.reshape(-1, times, 2), -1, 0)
    expected = normal.logpdf(x) + normal.logpdf(y)
    usual = terms > np.median(terms)  # without the loss of outlying ones
    np.testing.assert_allclose(terms[usual], expected[usual], rtol=1e-9)
    outlying = expected < np.median(expected) - 50
    assert outlying.any()
    assert (terms > expected)[outlying].all()


def test_people_without_sway() -> None:
    sway, acceleration, *_ = gait_of(sequences(0.0))
    assert not len(sway)
    assert 0.1 < acceleration < 0.4


def test_sway_is_not_resolved_by_few_samples() -> None:
    assert not len(gait_of(sequences(0.02, every=2)).sway)


def test_given_sway_is_kept() -> None:
    given = np.array([0.01, 0.003, 0.8, 4.0])
    people = People(Windows(sequences(0.0), SECONDS))
    people.gait = people.gait._replace(sway=given, acceleration=0.2)
    variances = people.initial_variances(["desired_speed"])
    np.testing.assert_array_equal(variances.noise[-4:], given)
    fixed = variances.low == variances.high
    assert fixed[3:7].all()
    assert fixed.sum() == 5  # and the error of positions


def test_heading(swaying: People) -> None:
    np.testing.assert_allclose(np.hypot(*np.moveaxis(swaying.heading, -1, 0)), 1.0)
    assert (np.abs(swaying.heading[..., 0]) > 0.8).all()  # along the corridor
