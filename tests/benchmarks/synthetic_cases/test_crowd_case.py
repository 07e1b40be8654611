"""Cases of crowds: what is written is what was hidden, at the strength asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.synthetic_cases import Case, generate
from benchmarks.synthetic_cases.arms import cases
from benchmarks.synthetic_cases.case import TABLE, WALLS
from benchmarks.synthetic_cases.crowd.case import CrowdCase
from benchmarks.synthetic_cases.crowd.catalogue import CATALOGUE, EFFECTS
from benchmarks.synthetic_cases.crowd.replay import Windows, cost_by_sequence
from nnode.data.quality import find_faults
from nnode.data.readers.table import TableOptions, read_table


def small(*effects: str, **options) -> Case:
    defaults = {"domain": "crowd", "arm": "single", "n_sequences": 2, "strength": "full"}
    return Case(**{**defaults, "effects": effects, **options})


def read(folder: Path):
    return read_table(folder / TABLE, TableOptions(domain="crowd"), folder / WALLS)


@pytest.mark.thorough
def test_equal_cases_give_equal_files_that_the_reader_takes(tmp_path):
    case = small("group_cohesion")
    for name in "ab":
        truth = generate(case, tmp_path / name)
    assert (tmp_path / "a" / TABLE).read_bytes() == (tmp_path / "b" / TABLE).read_bytes()
    sequences = read(tmp_path / "a")
    assert [s.name for s in sequences] == case.names == list(truth["cost"]["oracle"])
    for s in sequences:
        assert s.x.shape == (61, 16, 2)
        assert s.dt == pytest.approx(0.1)
        assert s.walls is not None
        assert len(s.walls) == 2
        names = [name for name in s.group or () if name]
        assert names
        assert all(names.count(name) in (2, 3) for name in names)
        # everyone walks towards a destination that is still ahead
        way = s.destination - s.x[-1]
        assert np.hypot(*way.T).min() > 1.0
    assert len({agent for s in sequences for agent in s.agents}) == 32


@pytest.mark.thorough
@pytest.mark.parametrize("effect", list(EFFECTS))
def test_an_oracle_explains_sound_data_and_the_base_law_does_not(effect):
    made = CrowdCase(small(effect, noise=0.0))
    costs = made.costs(made.truth)
    assert costs.floor == 0
    assert costs.oracle.mean() < 4e-6
    assert costs.base.mean() > 20 * costs.oracle.mean()


def test_nothing_hidden_leaves_the_base_law_true():
    made = CrowdCase(small(arm="nothing", variant="white", noise=0.0))
    assert made.costs(made.truth).base.mean() < 4e-6


def test_an_oracle_removes_the_share_that_was_asked_for():
    made = CrowdCase(small("drift", strength="medium", n_sequences=8))
    assert made.costs(made.truth).share == pytest.approx(0.4, abs=0.04)


@pytest.mark.parametrize("effect", ["alignment", "side_preference", "anticipation"])
def test_people_who_walk_the_same_way_hide_what_needs_encounters(effect):
    made = CrowdCase(small(effect, arm="no_excitation", noise=0.0))
    x, v = made.simulate(made.truth)
    windows = Windows(made.scene, x, v, x, 0.1)
    assert cost_by_sequence(windows.errors(made.scene.base)).mean() ** 0.5 < 5e-3


def test_people_mostly_stay_in_the_corridor_and_apart():
    made = CrowdCase(small(arm="nothing", variant="autocorrelated", n_sequences=6))
    x, v = made.simulate(made.truth)
    outside = (x[..., 1] < 0) | (x[..., 1] > made.scene.width)
    assert outside.mean() < 0.02
    speed = np.hypot(v[..., 0], v[..., 1])
    assert 0.7 < np.median(speed) < 1.6
    distance = np.hypot(*(x[:, :, :, None] - x[:, :, None]).transpose(4, 0, 1, 2, 3))
    assert distance[..., ~np.eye(16, dtype=bool)].min() > 0.12


@pytest.mark.parametrize("kind", ["identity_swap", "jump", "overlap"])
def test_inserted_faults_are_found_where_the_truth_says_and_nowhere_else(tmp_path, kind):
    truth = generate(small(arm="fault", variant=kind, n_sequences=5), tmp_path)
    (hidden,) = truth["data_faults"]
    for sequence in read(tmp_path):
        found = find_faults(sequence, "crowd")
        if sequence.name != hidden["sequence"]:
            assert not found
            continue
        assert any(
            abs(fault.time - hidden["time"]) < 0.15 and set(fault.agents) & set(hidden["places"])
            for fault in found
        )


def test_windows_of_crowds_hold_the_same_people_on_one_clock(tmp_path):
    case = small(arm="nothing", variant="windows")
    generate(case, tmp_path)
    sequences = read(tmp_path)
    assert [s.name for s in sequences] == case.names
    assert len(sequences) == 6
    assert {s.x.shape for s in sequences} == {(30, 16, 2)}
    assert sequences[0].agents == sequences[2].agents
    assert not set(sequences[2].agents) & set(sequences[3].agents)
    assert sequences[1].time[0] - sequences[0].time[-1] == pytest.approx(case.dt)
    assert np.abs(sequences[1].x[0] - sequences[0].x[-1]).max() < 0.4
    assert sequences[0].group == sequences[1].group


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("variant", "low", "high"),
    [("autocorrelated", 0.3, 0.6), ("windows", 0.3, 0.6), ("slow", 1.0, 2.0)],
)
def test_disturbances_that_last_blame_nobody(tmp_path, variant, low, high):
    truth = generate(small(arm="nothing", variant=variant, n_sequences=6), tmp_path)
    assert low <= truth["noise"]["correlation"] <= high
    assert truth["noise"]["amplitude"] > 0
    assert not [f for s in read(tmp_path) for f in find_faults(s, "crowd")]


def test_heterogeneity_has_the_standard_deviation_that_the_truth_tells():
    made = CrowdCase(small("walker_heterogeneity"))
    assert made.scene.eta.std() == pytest.approx(1.0)
    assert made.truth.eta == made.truth.effects["walker_heterogeneity"]["sigma"]


def test_all_arms_have_cases():
    for arm in ("single", "pair", "nothing", "outside", "near_miss", "no_excitation", "fault"):
        found = cases("crowd", arm, seeds=[0])
        assert found
        assert all(name in EFFECTS for case in found for name in case.effects)
    assert len(cases("crowd", "single", seeds=[0])) == len(CATALOGUE) == 16
