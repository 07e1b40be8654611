"""Clusters: what is taken as independent, and what so few of them can show at all."""

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
from tests.data.tables import entry


def sequence(recording: str, number: int, **covariates: Any) -> Sequence:
    time = 50.0 * number + np.arange(3)
    x = np.arange(6.0).reshape(3, 2, 1)
    name = f"{recording}/{number}"
    return Sequence(name=name, recording=recording, time=time, x=x, **covariates)


# -- which sequences -------------------------------------------------------------------------


def test_sequences_that_share_an_agent_are_one_however_far_apart() -> None:
    index = [entry(0, 5, "a", "b"), entry(5, 9, "c"), entry(900, 905, "b", "d"), entry(6, 8, "d")]
    assert clusters(index).tolist() == [0, 1, 0, 0]


def test_who_has_one_name_in_two_recordings_is_not_one_agent() -> None:
    index = [entry(0, 5, "a"), entry(0, 5, "a", recording="s")]
    assert clusters(index, together=True).tolist() == [0, 1]


def test_without_identifiers_a_gap_in_time_parts_them() -> None:
    # the last vehicle of a sequence is in view for 5 s more at most, mostly
    index = [entry(0, 10), entry(10 + GAP - 0.1, 20), entry(20 + GAP, 30)]
    assert clusters(index).tolist() == [0, 0, 1]
    assert clusters(index, 5.2).tolist() == [0, 0, 0]
    assert clusters(index, 0.0).tolist() == [0, 1, 2]
    assert relation(index) == "are closer than 5 s in time"
    # a long sequence reaches over a short one that ends before it
    assert clusters([entry(0, 30), entry(1, 2), entry(32, 33)]).tolist() == [0, 0, 0]


def test_one_sequence_without_identifiers_leaves_its_recording_to_time() -> None:
    index = [entry(0, 10, "a"), entry(12, 20), entry(40, 50, "a")]
    assert clusters(index).tolist() == [0, 0, 1]
    assert relation(index) == "share an agent or are closer than 5 s in time"


def test_what_is_simultaneous_is_one_where_that_is_asked_for() -> None:
    index = [entry(0, 10, "a"), entry(9, 20, "b"), entry(20, 30, "c"), entry(31, 40, "a")]
    assert clusters(index).tolist() == [0, 1, 2, 0]
    # from 20 s on nobody is there who was there before
    assert clusters(index, together=True).tolist() == [0, 0, 1, 0]


def test_sequences_are_told_by_what_they_hold() -> None:
    two = [sequence("r", n, agents=("a", f"b{n}")) for n in range(2)]
    (first, second) = index_of(two)
    assert (first["start"], first["end"], second["agents"]) == (0.0, 2.0, ["a", "b1"])
    assert clusters([first, second]).tolist() == [0, 0]


@pytest.mark.parametrize("name", ["kind", "group", "length"])
def test_what_is_fixed_per_recording_is_told_by_recordings(name: str) -> None:
    def value(long: bool) -> Any:
        return np.full(2, 12.0 if long else 4.0) if name == "length" else ("ab"[long],) * 2

    fixed = [sequence(f"r{i}", n, **{name: value(bool(i))}) for i in range(2) for n in range(3)]
    label = np.arange(6)
    assert level(fixed, label, name).tolist() == [0, 0, 0, 1, 1, 1]
    assert level(fixed, label, None) is label
    # one agent who differs within his recording tells the clusters of it apart
    other = np.array([4.0, 12.0]) if name == "length" else ("a", "b")
    assert level([*fixed, sequence("r1", 9, **{name: other})], label, name) is label


# -- how many --------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [1, 2, 4, 7])
def test_no_one_sided_p_is_below_its_floor_and_each_is_as_likely_as_it_says(number: int) -> None:
    size = np.random.default_rng(number).exponential(size=number)
    result = np.array([better(size * np.array(s)) for s in product([-1.0, 1.0], repeat=number)])
    assert result.min() == 2.0**-number
    assert better(1e6 * size) == 2.0**-number
    # of all signs alike p takes every multiple of the floor once: it is exactly uniform
    np.testing.assert_allclose(np.sort(result), np.arange(1, 2**number + 1) / 2**number)


def test_signs_of_many_clusters_are_drawn() -> None:
    gains = np.random.default_rng(4).normal(0.25, 1.0, 40)
    t = gains.mean() / (gains.std(ddof=1) / np.sqrt(40))
    # so many clusters behave like a normal variable; the error is that of 16,384 draws
    assert better(gains) == pytest.approx(stats.t.sf(t, 39), rel=0.1)
    assert better(-gains) == pytest.approx(stats.t.cdf(t, 39), rel=0.1)


def test_nothing_is_better_that_cannot_be_compared() -> None:
    assert better(np.empty(0)) == 1.0
    assert better(np.array([1.0, np.inf, 1.0])) == 1.0
    assert better(np.zeros(6)) == 1.0


@pytest.mark.parametrize("number", [1, 2, 5])
def test_few_clusters_are_tried_with_all_their_signs(number: int) -> None:
    result = signs(number, 1999, np.random.default_rng(0))
    # but for the sign of everything each combination once, the data first
    assert result[0].tolist() == [1.0] * number
    assert len({tuple(row * row[0]) for row in result}) == len(result) == 2 ** (number - 1)
    every = every_sign(number)
    assert len({tuple(row) for row in every}) == len(every) == 2**number
    assert set(np.unique(every)) == {-1.0, 1.0}


def test_many_clusters_are_tried_with_as_many_signs_as_are_asked_for() -> None:
    result = signs(12, 1999, np.random.default_rng(0))
    assert result.shape == (2000, 12)
    assert (result[0] == 1).all()
    assert signs(11, 1999, np.random.default_rng(0)).shape == (1024, 11)


@pytest.mark.parametrize("sided", [1, 2])
@pytest.mark.parametrize("hypotheses", [1, 2, 13])
@pytest.mark.parametrize("alpha", [0.05, 0.01, 0.5])
def test_so_many_clusters_reach_a_level_and_no_fewer(
    alpha: float, hypotheses: int, sided: int
) -> None:
    number = least_number(alpha, hypotheses=hypotheses, sided=sided)
    assert sided * hypotheses * 2.0**-number <= alpha
    assert number == 1 or sided * hypotheses * 2.0 ** (1 - number) > alpha
