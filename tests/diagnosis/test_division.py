"""Division into exploration and confirmation clusters."""

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
        agents: one letter for each agent of a sequence; empty: two agents without names.
        start: start (s) of a sequence, by its number.
    """
    sequences = []
    for number, names in enumerate(agents):
        x = np.zeros((3, len(names) or 2)) + np.arange(len(names) or 2)
        name = f"r/{number}"
        sequences.append(lane(x, 1.0, start=start(number), name=name, agents=tuple(names)))
    return sequences


def pairs(number: int) -> list[str]:
    """The letters of two different agents for each sequence."""
    return [chr(200 + 2 * i) + chr(201 + 2 * i) for i in range(number)]


def independent(number: int) -> list[Sequence]:
    return recorded(pairs(number))


def assert_valid(division: Division, number: int) -> None:
    """Every sequence is used once, no cluster is in both parts, at most half are held back."""
    exploration, confirmation = division.exploration, division.confirmation
    assert sorted(exploration.places + confirmation.places) == list(range(number))
    assert not set(exploration.label) & set(confirmation.label)
    assert 0 < len(confirmation.places) <= number / 2


@pytest.mark.parametrize("seed", range(5))
def test_five_of_sixteen_clusters_confirm(seed: int) -> None:
    sequences = independent(16)
    division, repeated = (divide(sequences, DiscoverOptions(seed=seed)) for _ in range(2))
    assert_valid(division, 16)
    assert (division.exploration.clusters, division.confirmation.clusters) == (11, 5)
    assert division.note == ""
    assert repeated.exploration.places == division.exploration.places
    assert repeated.confirmation.places == division.confirmation.places


def test_division_depends_on_seed() -> None:
    parts = [divide(independent(16), DiscoverOptions(seed=seed)).confirmation for seed in range(5)]
    assert len({tuple(part.places) for part in parts}) > 1


@pytest.mark.parametrize("seed", range(8))
def test_clusters_of_different_size(seed: int) -> None:
    # clusters of 1 to 6 sequences in random order, and one with half of all sequences
    sizes = [1, 4, 2, 6, 1, 3, 5, 2, 24]
    names = [chr(200 + cluster) for cluster, size in enumerate(sizes) for _ in range(size)]
    order = np.random.default_rng(seed).permutation(len(names))
    sequences = recorded(names[i] + chr(400 + int(i)) for i in order)
    for share in (0.1, 0.3, 0.6, 0.9):
        division = divide(sequences, DiscoverOptions(seed=seed, confirmation=share))
        assert_valid(division, len(sequences))
        confirmation = division.confirmation.clusters
        assert division.exploration.clusters + confirmation == len(sizes)
        assert confirmation <= max(round(share * len(sizes)), 1)
        assert division.note == ""


def test_one_cluster_is_divided_in_time() -> None:
    # every agent is in two sequences
    sequences = recorded(chr(200 + i) + chr(201 + i) for i in range(20))
    division = divide(sequences, DiscoverOptions())
    assert division.exploration.clusters == division.confirmation.clusters == 1
    assert "are not independent of the exploration sequences" in division.note
    places = division.confirmation.places
    assert places == list(range(min(places), max(places) + 1))
    exploration, confirmation = (
        {agent for sequence in part.sequences for agent in sequence.agents}
        for part in (division.exploration, division.confirmation)
    )
    assert exploration.isdisjoint(confirmation)


def test_simultaneous_sequences_form_one_cluster_if_required() -> None:
    # two lanes, whose sequences start one second apart
    sequences = recorded(pairs(32), lambda number: 20.0 * (number // 2) + number % 2)
    for together, number in ((False, 32), (True, 16)):
        division = divide(sequences, DiscoverOptions(), together=together)
        assert_valid(division, 32)
        assert division.exploration.clusters + division.confirmation.clusters == number
        assert division.why.endswith("or overlap in time") == together
    assert len(division.confirmation.places) == 10


def test_gap_between_sequences_without_names() -> None:
    sequences = recorded([""] * 16, lambda number: 6.0 * number)
    division = divide(sequences, DiscoverOptions(gap=3.0))
    assert division.exploration.clusters == 11
    assert "are closer than 3 s in time" in division.why
    assert divide(sequences, DiscoverOptions()).note  # 4 s apart, so they are all connected


def test_two_sequences_are_too_few() -> None:
    with pytest.raises(DataError, match="at least 3 sequences without a fault, there are 2"):
        divide(independent(2), DiscoverOptions())
