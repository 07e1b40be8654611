"""Which clusters are kept for the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest

from nnode.data.sequence import Sequence
from nnode.diagnosis.division import Division, divide
from nnode.diagnosis.options import DiscoverOptions
from nnode.errors import DataError
from tests.builders import lane


def recorded(
    agents: Iterable[str], start: Callable[[int], float] = lambda number: 20.0 * number
) -> list[Sequence]:
    """Sequences of two seconds of a recording.

    Args:
        agents: of each sequence the letters that name its agents; empty: two without names.
        start: of the number of a sequence, s.
    """
    found = []
    for number, names in enumerate(agents):
        x = np.zeros((3, len(names) or 2)) + np.arange(len(names) or 2)
        name = f"r/{number}"
        found.append(lane(x, 1.0, start=start(number), name=name, agents=tuple(names)))
    return found


def pairs(number: int) -> list[str]:
    """The letters of two agents for each of some sequences."""
    return [chr(200 + 2 * i) + chr(201 + 2 * i) for i in range(number)]


def alone(number: int) -> list[Sequence]:
    return recorded(pairs(number))


def assert_sound(found: Division, sequences: list[Sequence]) -> None:
    """Every sequence once, no cluster on both sides, at least half of them open."""
    assert sorted(found.exploration.places + found.confirmation.places) == list(
        range(len(sequences))
    )
    assert not set(found.exploration.label) & set(found.confirmation.label)
    assert 0 < len(found.confirmation.places) <= len(sequences) / 2


@pytest.mark.parametrize("seed", range(5))
def test_five_of_sixteen_clusters_are_sealed_as_it_takes_to_confirm(seed: int) -> None:
    sequences = alone(16)
    found = divide(sequences, DiscoverOptions(seed=seed))
    assert_sound(found, sequences)
    assert (found.exploration.clusters, found.confirmation.clusters) == (11, 5)
    assert found.note == ""
    again = divide(sequences, DiscoverOptions(seed=seed))
    assert again.exploration.places == found.exploration.places
    assert again.confirmation.places == found.confirmation.places


def test_another_seed_seals_other_clusters() -> None:
    parts = [divide(alone(16), DiscoverOptions(seed=seed)).confirmation for seed in range(5)]
    drawn = {tuple(part.places) for part in parts}
    assert len(drawn) > 1


@pytest.mark.parametrize("seed", range(8))
def test_whole_clusters_are_sealed_but_never_more_than_half_of_the_sequences(seed: int) -> None:
    # clusters of 1 to 6 sequences in no order, and one that holds half of them all
    sizes = [1, 4, 2, 6, 1, 3, 5, 2, 24]
    names = [chr(200 + cluster) for cluster, size in enumerate(sizes) for _ in range(size)]
    order = np.random.default_rng(seed).permutation(len(names))
    sequences = recorded(names[i] + chr(400 + int(i)) for i in order)
    for share in (0.1, 0.3, 0.6, 0.9):
        found = divide(sequences, DiscoverOptions(seed=seed, confirmation=share))
        assert_sound(found, sequences)
        assert found.exploration.clusters + found.confirmation.clusters == len(sizes)
        assert found.confirmation.clusters <= max(round(share * len(sizes)), 1)
        assert found.note == ""


def test_one_cluster_alone_gives_a_block_of_time_and_says_so() -> None:
    # everybody is in two sequences: all of them hang together
    sequences = recorded(chr(200 + i) + chr(201 + i) for i in range(20))
    found = divide(sequences, DiscoverOptions())
    assert found.exploration.clusters == found.confirmation.clusters == 1
    assert "are not independent of the exploration sequences" in found.note
    places = found.confirmation.places
    assert places == list(range(min(places), max(places) + 1))
    who = {agent for i in places for agent in sequences[i].agents}
    assert not who & {agent for i in found.exploration.places for agent in sequences[i].agents}


def test_what_is_simultaneous_is_on_one_side_where_that_is_asked_for() -> None:
    # two lanes side by side, whose sequences begin a second after each other
    sequences = recorded(pairs(32), lambda number: 20.0 * (number // 2) + number % 2)
    for together, number in ((False, 32), (True, 16)):
        found = divide(sequences, DiscoverOptions(), together=together)
        assert_sound(found, sequences)
        assert found.exploration.clusters + found.confirmation.clusters == number
        assert found.why.endswith("or overlap in time") == together
    assert len(found.confirmation.places) == 10


def test_the_gap_between_sequences_without_names_is_an_option() -> None:
    sequences = recorded([""] * 16, lambda number: 6.0 * number)
    found = divide(sequences, DiscoverOptions(gap=3.0))
    assert found.exploration.clusters == 11
    assert "are closer than 3 s in time" in found.why
    assert divide(sequences, DiscoverOptions()).note  # 4 s apart, so one chain


def test_two_sequences_are_too_few() -> None:
    with pytest.raises(DataError, match="at least 3 sequences without a fault, there are 2"):
        divide(alone(2), DiscoverOptions())
