"""Clusters of dependent sequences, and sign tests of few clusters."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy import stats

from nnode.data.clusters import (
    GAP,
    better,
    clusters,
    every_sign,
    index_of,
    least_number,
    level,
    relation,
    signs,
)
from nnode.data.sequence import Sequence
from tests.builders import lane
from tests.data.tables import entry


def sequence(recording: str, number: int, **covariates: Any) -> Sequence:
    name = f"{recording}/{number}"
    return lane(np.arange(6.0).reshape(3, 2), 1.0, start=50.0 * number, name=name, **covariates)


def test_shared_agents_join_sequences() -> None:
    index = [entry(0, 5, "a", "b"), entry(5, 9, "c"), entry(900, 905, "b", "d"), entry(6, 8, "d")]
    assert clusters(index).tolist() == [0, 1, 0, 0]


def test_same_name_in_two_recordings_is_not_one_agent() -> None:
    index = [entry(0, 5, "a"), entry(0, 5, "a", recording="s")]
    assert clusters(index, together=True).tolist() == [0, 1]


def test_gaps_in_time_without_identifiers() -> None:
    # the last vehicle of a sequence is rarely observed for more than 5 s after its end
    index = [entry(0, 10), entry(10 + GAP - 0.1, 20), entry(20 + GAP, 30)]
    assert clusters(index).tolist() == [0, 0, 1]
    assert clusters(index, 5.2).tolist() == [0, 0, 0]
    assert clusters(index, 0.0).tolist() == [0, 1, 2]
    assert relation(index) == "are closer than 5 s in time"
    # a long sequence that covers a short one
    assert clusters([entry(0, 30), entry(1, 2), entry(32, 33)]).tolist() == [0, 0, 0]


def test_one_sequence_without_identifiers() -> None:
    index = [entry(0, 10, "a"), entry(12, 20), entry(40, 50, "a")]
    assert clusters(index).tolist() == [0, 0, 1]
    assert relation(index) == "share an agent or are closer than 5 s in time"


def test_simultaneous_sequences_are_joined_by_option() -> None:
    index = [entry(0, 10, "a"), entry(9, 20, "b"), entry(20, 30, "c"), entry(31, 40, "a")]
    assert clusters(index).tolist() == [0, 1, 2, 0]
    # no agent before 20 s is present after 20 s
    assert clusters(index, together=True).tolist() == [0, 0, 1, 0]


def test_index_of_sequences() -> None:
    sequences = [sequence("r", n, agents=("a", f"b{n}")) for n in range(2)]
    first, second = index_of(sequences)
    assert (first["start"], first["end"], second["agents"]) == (0.0, 2.0, ["a", "b1"])
    assert clusters([first, second]).tolist() == [0, 0]


@pytest.mark.parametrize("name", ["kind", "group", "length"])
def test_covariate_constant_in_a_recording(name: str) -> None:
    def value(long: bool) -> Any:
        return np.full(2, 12.0 if long else 4.0) if name == "length" else ("ab"[long],) * 2

    fixed = [sequence(f"r{i}", n, **{name: value(bool(i))}) for i in range(2) for n in range(3)]
    label = np.arange(6)
    assert level(fixed, label, name).tolist() == [0, 0, 0, 1, 1, 1]
    assert level(fixed, label, None) is label
    # an agent that differs within its recording separates the clusters
    other = np.array([4.0, 12.0]) if name == "length" else ("a", "b")
    assert level([*fixed, sequence("r1", 9, **{name: other})], label, name) is label


@pytest.mark.parametrize("number", [1, 2, 4, 7])
def test_one_sided_p_is_uniform(number: int) -> None:
    size = np.random.default_rng(number).exponential(size=number)
    result = np.array([better(size * np.array(s)) for s in product([-1.0, 1.0], repeat=number)])
    assert result.min() == 2.0**-number
    assert better(1e6 * size) == 2.0**-number
    # p takes every multiple of its minimum once, so that it is exactly uniform
    np.testing.assert_allclose(np.sort(result), np.arange(1, 2**number + 1) / 2**number)


def test_sign_test_of_many_clusters() -> None:
    gains = np.random.default_rng(4).normal(0.25, 1.0, 40)
    t = gains.mean() / (gains.std(ddof=1) / np.sqrt(40))
    # the t test is a good approximation here; the tolerance is the error of 16,384 draws
    assert better(gains) == pytest.approx(stats.t.sf(t, 39), rel=0.1)
    assert better(-gains) == pytest.approx(stats.t.cdf(t, 39), rel=0.1)


@pytest.mark.parametrize("gains", [[], [1.0, np.inf, 1.0], [0.0] * 6])
def test_p_is_one_without_comparable_gains(gains: list[float]) -> None:
    assert better(np.array(gains)) == 1.0


@pytest.mark.parametrize("number", [1, 2, 5])
def test_all_signs_of_few_clusters(number: int) -> None:
    result = signs(number, 1999, np.random.default_rng(0))
    # each combination once up to a common sign, the data first
    assert result[0].tolist() == [1.0] * number
    assert len({tuple(row * row[0]) for row in result}) == len(result) == 2 ** (number - 1)
    combinations = every_sign(number)
    assert len({tuple(row) for row in combinations}) == len(combinations) == 2**number
    assert set(np.unique(combinations)) == {-1.0, 1.0}


def test_number_of_signs_of_many_clusters() -> None:
    result = signs(12, 1999, np.random.default_rng(0))
    assert result.shape == (2000, 12)
    assert (result[0] == 1).all()
    assert signs(11, 1999, np.random.default_rng(0)).shape == (1024, 11)


@pytest.mark.parametrize("sided", [1, 2])
@pytest.mark.parametrize("hypotheses", [1, 2, 13])
@pytest.mark.parametrize("alpha", [0.05, 0.01, 0.5])
def test_least_number_of_clusters(alpha: float, hypotheses: int, sided: int) -> None:
    number = least_number(alpha, hypotheses=hypotheses, sided=sided)
    assert sided * hypotheses * 2.0**-number <= alpha
    assert number == 1 or sided * hypotheses * 2.0 ** (1 - number) > alpha
