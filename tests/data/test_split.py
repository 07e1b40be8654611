"""Held-out sequences: nobody on both sides, the share met, borders dropped and counted."""

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
from nnode.data.sequence import Sequence
from nnode.data.split import Split, split
from nnode.data.store import write_store
from nnode.errors import ConfigError, DataError
from tests.data.tables import entry


def apart(n: int) -> list[dict[str, Any]]:
    """Platoons that share no vehicle."""
    return [entry(20.0 * i, 20.0 * i + 3, f"a{i}", f"b{i}") for i in range(n)]


def chain(n: int, stay: int, recording: str = "r") -> list[dict[str, Any]]:
    """A corridor: one person enters per second and is seen in ``stay`` one-second sequences."""
    people = [[f"p{j}" for j in range(i, i + stay)] for i in range(n)]
    return [entry(float(i), i + 0.96, *people[i], recording=recording) for i in range(n)]


def assert_sound(index: list[dict[str, Any]], result: Split) -> None:
    """Every sequence in one list, and no agent of a recording on both sides."""
    assert sorted(result.train + result.heldout + result.dropped) == list(range(len(index)))
    sides = [
        {(index[i]["recording"], agent) for i in side for agent in index[i]["agents"]}
        for side in (result.train, result.heldout)
    ]
    assert not sides[0] & sides[1]


def test_nothing_held_out_keeps_everything_for_training() -> None:
    result = split(chain(9, 4), SplitOptions(heldout=0.0))
    assert (result.train, result.heldout, result.dropped) == (list(range(9)), [], [])
    assert result.mode == "none"


def test_independent_sequences_are_drawn_at_random_and_meet_the_share() -> None:
    index = apart(50)
    result = split(index, SplitOptions(heldout=0.2, seed=1))
    assert_sound(index, result)
    assert result.mode == "random"
    assert len(result.heldout) == 10
    assert result.dropped == []
    assert result == split(index, SplitOptions(heldout=0.2, seed=1))
    assert result.heldout != split(index, SplitOptions(heldout=0.2, seed=2)).heldout
    # drawn from all over the recording, not as a block
    assert max(result.heldout) - min(result.heldout) > 20


def test_sequences_that_share_an_agent_stay_together() -> None:
    index = [entry(20.0 * i, 20.0 * i + 3, f"car{i // 3}", f"only{i}") for i in range(60)]
    result = split(index, SplitOptions(heldout=0.25, seed=0))
    assert_sound(index, result)
    assert len(result.heldout) == 15
    for i in range(0, 60, 3):
        assert len({i in result.heldout, i + 1 in result.heldout, i + 2 in result.heldout}) == 1


def test_a_chain_is_cut_by_a_block_of_time() -> None:
    index = chain(128, 8)
    result = split(index, SplitOptions(heldout=0.2, seed=0))
    assert_sound(index, result)
    assert result.mode == "block"
    assert len(result.heldout) == 26
    assert result.heldout == list(range(result.heldout[0], result.heldout[0] + 26))
    assert result.dropped
    assert f"{len(result.dropped)} at the borders" in result.note


@pytest.mark.parametrize("seed", range(6))
def test_a_border_costs_as_many_sequences_as_a_person_stays_less_one(seed: int) -> None:
    result = split(chain(40, 5), SplitOptions(heldout=0.25, seed=seed, mode=SplitMode.block))
    first, last = result.heldout[0], result.heldout[-1]
    expected = [i for i in range(40) if first - 4 <= i < first or last < i <= last + 4]
    assert result.dropped == expected


def test_every_recording_gives_its_block() -> None:
    index = chain(30, 4, "a") + chain(50, 4, "b")
    result = split(index, SplitOptions(heldout=0.2, seed=3))
    assert_sound(index, result)
    assert sum(i < 30 for i in result.heldout) == 6
    assert sum(i >= 30 for i in result.heldout) == 10


def test_without_identifiers_a_block_drops_its_neighbours_in_time() -> None:
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
def test_no_agent_is_ever_on_both_sides(
    data: list[tuple[str, float, float, set[str]]], heldout: float, seed: int, mode: SplitMode
) -> None:
    index = [entry(t, t + d, *sorted(agents), recording=rec) for rec, t, d, agents in data]
    options = SplitOptions(heldout=heldout, seed=seed, mode=mode)
    try:
        result = split(index, options)
    except DataError as error:
        assert "leaves no sequence for" in str(error)  # noqa: PT017
    else:
        assert_sound(index, result)
        assert result.train
        assert result.heldout


@pytest.mark.parametrize("share", [1.0, 1.5, -0.1, float("nan")])
def test_a_share_outside_its_range_is_refused(share: float) -> None:
    with pytest.raises(ConfigError, match=r"data\.split\.heldout="):
        split(apart(5), SplitOptions(heldout=share))


def test_a_negative_gap_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"data\.split\.gap=-1"):
        split(apart(5), SplitOptions(gap=-1.0))


def test_splits_that_leave_a_side_empty_are_refused() -> None:
    with pytest.raises(DataError, match="data set is empty"):
        split([], SplitOptions())
    with pytest.raises(DataError, match="leaves no sequence for the held-out part"):
        split(apart(1), SplitOptions(heldout=0.2))
    everyone = [entry(float(i), i + 0.9, "a", "b") for i in range(10)]  # a ring road
    with pytest.raises(DataError, match="leaves no sequence for training"):
        split(everyone, SplitOptions(heldout=0.2))
    with pytest.raises(DataError, match=r"data\.split\.mode=block holds out"):
        split(chain(40, 4), SplitOptions(heldout=0.2, mode=SplitMode.random))


def test_a_split_survives_a_manifest() -> None:
    result = split(chain(40, 4), SplitOptions(heldout=0.2))
    assert Split(**json.loads(json.dumps(result.to_dict()))) == result


def test_a_store_is_split_by_its_index(tmp_path: Path) -> None:
    items = [
        Sequence(name=str(i), recording="r", time=20.0 * i + np.arange(3), x=np.zeros((3, 2, 1)))
        for i in range(10)
    ]
    store = write_store(tmp_path, items, {})
    assert split(store, SplitOptions()) == split(store.index, SplitOptions())
    assert len(split(store, SplitOptions()).heldout) == 2


@pytest.mark.real
@pytest.mark.parametrize("family", [2, 3])
def test_real_platoons_are_held_out_in_groups_close_in_time(real_data: Path, family: int) -> None:
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
def test_real_corridor_is_held_out_as_a_block(real_data: Path) -> None:
    path = real_data / "juelich" / "bi_corr_400_b_03.txt"
    index = index_of(read_juelich(path, JuelichOptions()))
    result = split(index, SplitOptions(heldout=0.2))
    assert_sound(index, result)
    assert result.mode == "block"
    assert len(result.heldout) == round(0.2 * len(index))
    assert 0 < len(result.dropped) < 0.3 * len(index)


def test_runs_that_everybody_drives_through_are_held_out_whole() -> None:
    # three windows of each of four runs: no block of a run is left without dropping the rest
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
