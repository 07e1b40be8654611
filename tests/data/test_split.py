"""Held-out sequences: disjoint agents, their share, and dropped sequences at borders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nnode.data.clusters import index_of
from nnode.data.options import SplitMode, SplitOptions
from nnode.data.readers.esimas import EsimasOptions, esimas_files, read_esimas
from nnode.data.readers.juelich import JuelichOptions, read_juelich
from nnode.data.split import Split, split
from nnode.data.store import write_store
from nnode.errors import ConfigError, DataError
from tests.builders import lane
from tests.data.tables import entry


def separate(n: int) -> list[dict[str, Any]]:
    """Entries of platoons that share no vehicle."""
    return [entry(20.0 * i, 20.0 * i + 3, f"a{i}", f"b{i}") for i in range(n)]


def chain(n: int, n_sequences: int, recording: str = "r") -> list[dict[str, Any]]:
    """A corridor: one person enters per second and is in ``n_sequences`` sequences of 1 s."""
    people = [[f"p{j}" for j in range(i, i + n_sequences)] for i in range(n)]
    return [entry(float(i), i + 0.96, *people[i], recording=recording) for i in range(n)]


def assert_disjoint(index: list[dict[str, Any]], result: Split) -> None:
    """Assert that each sequence is in one list, and no agent of a recording in both parts."""
    assert sorted(result.train + result.heldout + result.dropped) == list(range(len(index)))
    sides = [
        {(index[i]["recording"], agent) for i in side for agent in index[i]["agents"]}
        for side in (result.train, result.heldout)
    ]
    assert not sides[0] & sides[1]


def test_without_held_out_sequences() -> None:
    result = split(chain(9, 4), SplitOptions(heldout=0.0))
    assert (result.train, result.heldout, result.dropped) == (list(range(9)), [], [])
    assert result.mode == "none"


def test_independent_sequences_are_drawn_at_random() -> None:
    index = separate(50)
    result = split(index, SplitOptions(heldout=0.2, seed=1))
    assert_disjoint(index, result)
    assert result.mode == "random"
    assert len(result.heldout) == 10
    assert result.dropped == []
    assert result == split(index, SplitOptions(heldout=0.2, seed=1))
    assert result.heldout != split(index, SplitOptions(heldout=0.2, seed=2)).heldout
    # not a block
    assert max(result.heldout) - min(result.heldout) > 20


def test_sequences_that_share_an_agent_stay_together() -> None:
    index = [entry(20.0 * i, 20.0 * i + 3, f"car{i // 3}", f"only{i}") for i in range(60)]
    result = split(index, SplitOptions(heldout=0.25, seed=0))
    assert_disjoint(index, result)
    assert len(result.heldout) == 15
    for i in range(0, 60, 3):
        assert len({i in result.heldout, i + 1 in result.heldout, i + 2 in result.heldout}) == 1


def test_chain_is_split_by_a_block_of_time() -> None:
    index = chain(128, 8)
    result = split(index, SplitOptions(heldout=0.2, seed=0))
    assert_disjoint(index, result)
    assert result.mode == "block"
    assert len(result.heldout) == 26
    assert result.heldout == list(range(result.heldout[0], result.heldout[0] + 26))
    assert result.dropped
    assert f"{len(result.dropped)} at the borders" in result.note


@pytest.mark.parametrize("seed", range(6))
def test_dropped_sequences_at_a_border(seed: int) -> None:
    result = split(chain(40, 5), SplitOptions(heldout=0.25, seed=seed, mode=SplitMode.block))
    first, last = result.heldout[0], result.heldout[-1]
    expected = [i for i in range(40) if first - 4 <= i < first or last < i <= last + 4]
    assert result.dropped == expected


def test_each_recording_has_a_block() -> None:
    index = chain(30, 4, "a") + chain(50, 4, "b")
    result = split(index, SplitOptions(heldout=0.2, seed=3))
    assert_disjoint(index, result)
    assert sum(i < 30 for i in result.heldout) == 6
    assert sum(i >= 30 for i in result.heldout) == 10


def test_neighbours_in_time_are_dropped_without_identifiers() -> None:
    index = [entry(3.0 * i, 3.0 * i + 2) for i in range(40)]
    result = split(index, SplitOptions(heldout=0.25, gap=5.0))
    assert result.mode == "block"
    first, last = result.heldout[0], result.heldout[-1]
    near = {first - 2, first - 1, last + 1, last + 2} & set(range(40))  # 1 s and 4 s away
    assert set(result.dropped) == near


@settings(max_examples=60, deadline=None)
@given(
    data=st.lists(
        st.tuples(
            st.sampled_from("ab"),
            st.floats(0, 100),
            st.floats(0, 5),
            st.sets(st.sampled_from("pqrstuvw"), min_size=1, max_size=3),
        ),
        min_size=1,
        max_size=30,
    ),
    heldout=st.floats(0.05, 0.9),
    seed=st.integers(0, 5),
    mode=st.sampled_from([mode for mode in SplitMode if mode is not SplitMode.published]),
)
def test_no_agent_is_in_both_parts(
    data: list[tuple[str, float, float, set[str]]], heldout: float, seed: int, mode: SplitMode
) -> None:
    index = [entry(t, t + d, *sorted(agents), recording=rec) for rec, t, d, agents in data]
    options = SplitOptions(heldout=heldout, seed=seed, mode=mode)
    try:
        result = split(index, options)
    except DataError as error:
        assert "leaves no sequence for" in str(error)  # noqa: PT017
    else:
        assert_disjoint(index, result)
        assert result.train
        assert result.heldout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(
            ({"heldout": share}, r"data\.split\.heldout=")
            for share in (1.0, 1.5, -0.1, float("nan"))
        ),
        ({"gap": -1.0}, r"data\.split\.gap=-1"),
    ],
)
def test_invalid_options(options: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        split(separate(5), SplitOptions(**options))


RING_ROAD = [entry(float(i), i + 0.9, "a", "b") for i in range(10)]


@pytest.mark.parametrize(
    ("index", "mode", "message"),
    [
        ([], "auto", "data set is empty"),
        (separate(1), "auto", "leaves no sequence for the held-out part"),
        (RING_ROAD, "auto", "leaves no sequence for training"),
        (chain(40, 4), "random", r"data\.split\.mode=block holds out"),
    ],
)
def test_empty_parts_are_refused(index: list[dict[str, Any]], mode: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        split(index, SplitOptions(heldout=0.2, mode=SplitMode[mode]))


def test_split_round_trip_through_json() -> None:
    result = split(chain(40, 4), SplitOptions(heldout=0.2))
    assert Split(**json.loads(json.dumps(result.to_dict()))) == result


def test_store_is_split_by_its_index(tmp_path: Path) -> None:
    items = [lane(np.zeros((3, 2)), 1.0, start=20.0 * i, name=f"r/{i}") for i in range(10)]
    store = write_store(tmp_path, items, {})
    result = split(store, SplitOptions())
    assert result == split(store.index, SplitOptions())
    assert len(result.heldout) == 2


@pytest.mark.real
@pytest.mark.parametrize("family", [2, 3])
def test_split_of_real_platoons(real_data: Path, family: int) -> None:
    files = esimas_files(EsimasOptions(source=str(real_data), min_vehicles=family))
    index = index_of(s for path in files.values() for s in read_esimas(path))
    result = split(index, SplitOptions(heldout=0.2))
    assert result.mode == "random"
    assert len(result.heldout) == pytest.approx(0.2 * len(index), abs=2)
    for i in result.heldout:
        for j in result.train:
            if index[i]["recording"] == index[j]["recording"]:
                first, second = sorted((index[i], index[j]), key=lambda e: e["start"])
                assert second["start"] - first["end"] >= 5.0


@pytest.mark.real
def test_split_of_a_real_corridor(real_data: Path) -> None:
    path = real_data / "juelich" / "bi_corr_400_b_03.txt"
    index = index_of(read_juelich(path, JuelichOptions()))
    result = split(index, SplitOptions(heldout=0.2))
    assert_disjoint(index, result)
    assert result.mode == "block"
    assert len(result.heldout) == round(0.2 * len(index))
    assert 0 < len(result.dropped) < 0.3 * len(index)


def test_runs_with_the_same_agents_throughout_are_held_out_as_a_whole() -> None:
    # three windows of each of four runs; a block of a run would drop its other windows
    index = [
        entry(10.0 * k, 10.0 * k + 10, "a", "b", recording=f"run{r}")
        for r in range(4)
        for k in range(3)
    ]
    for seed in range(5):
        result = split(index, SplitOptions(heldout=0.4, seed=seed))
        assert result.mode == "random"
        assert not result.dropped
        sides = [{index[i]["recording"] for i in side} for side in (result.train, result.heldout)]
        assert not sides[0] & sides[1]
        assert all(sides)
