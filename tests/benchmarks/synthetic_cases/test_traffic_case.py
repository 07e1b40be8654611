"""Cases of traffic: what is written is what was hidden, at the strength asked for."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.synthetic_cases import Case, generate
from benchmarks.synthetic_cases.arms import cases, first_seed
from benchmarks.synthetic_cases.case import TABLE, TRUTH
from benchmarks.synthetic_cases.traffic.case import TrafficCase
from benchmarks.synthetic_cases.traffic.catalogue import CATALOGUE, EFFECTS
from benchmarks.synthetic_cases.traffic.replay import cost_by_sequence
from nnode.data.quality import find_faults
from nnode.data.readers.table import TableOptions, read_table
from nnode.errors import ConfigError


def small(*effects: str, **options) -> Case:
    defaults = {"domain": "traffic", "arm": "single", "n_sequences": 6}
    return Case(**{**defaults, "effects": effects, **options})


def read(folder: Path):
    return read_table(folder / TABLE, TableOptions(domain="traffic"))


@pytest.mark.thorough
def test_equal_cases_give_equal_files_and_other_seeds_others(tmp_path):
    one = small("relative_speed", strength="full")
    for name, case in (("a", one), ("b", one), ("c", replace(one, seed=1))):
        generate(case, tmp_path / name)
    a, b, c = ((tmp_path / name / TABLE).read_bytes() for name in "abc")
    assert a == b
    assert a != c
    assert (tmp_path / "a" / TRUTH).read_text() == (tmp_path / "b" / TRUTH).read_text()


def test_a_case_survives_json_and_has_a_key_of_its_own():
    some = cases("traffic", "single", seeds=range(2), strengths=["weak", "full"])
    again = [Case(**json.loads(json.dumps(case.to_dict()))) for case in some]
    assert again == some
    assert len({case.key for case in some}) == len(some) == 2 * 2 * len(CATALOGUE)


def test_strength_and_noise_leave_the_road_and_the_coefficients_as_they_are():
    full, noisy = (
        TrafficCase(small("relative_speed", strength="full", noise=noise)) for noise in (0.0, 0.3)
    )
    assert full.truth == noisy.truth
    np.testing.assert_array_equal(full.road.lead_x, noisy.road.lead_x)


def test_the_table_is_read_with_classes_lengths_and_a_clock(tmp_path):
    case = small("vehicle_class", strength="full", noise=0.0)
    truth = generate(case, tmp_path)
    sequences = read(tmp_path)
    assert [s.name for s in sequences] == case.names == list(truth["cost"]["oracle"])
    assert all(s.x.shape == (151, 8, 1) for s in sequences)
    assert all(np.isclose(s.dt, 0.2) for s in sequences)
    starts = [s.time[0] for s in sequences]
    assert all(later - one > 30 for one, later in pairwise(starts))
    kinds = [kind for s in sequences for kind in s.kind or ()]
    assert 0.1 < kinds.count("truck") / len(kinds) < 0.45
    agents = [agent for s in sequences for agent in s.agents]
    assert len(set(agents)) == len(agents)


@pytest.mark.parametrize(
    ("effect", "strength"),
    [("relative_speed", "medium"), ("inertia", "weak"), ("speed_zone", "strong")],
)
def test_an_oracle_removes_the_share_that_was_asked_for(effect, strength):
    case = small(effect, strength=strength, n_sequences=10)
    made = TrafficCase(case)
    assert made.costs(made.truth).share == pytest.approx(made.amplitude.share, abs=0.03)


@pytest.mark.thorough
@pytest.mark.parametrize("effect", list(EFFECTS))
def test_an_oracle_explains_sound_data_and_the_base_law_does_not(effect):
    made = TrafficCase(small(effect, strength="full", noise=0.0))
    motion = made.simulate(made.truth)
    oracle = made.oracle_cost(motion.x, motion, made.truth).mean()
    base = made.base_cost(motion.x).mean()
    # what is left to the oracle is that leaders are straight between samples
    assert oracle < 4e-4
    assert base > 20 * oracle


def test_no_effect_leaves_the_base_law_true():
    made = TrafficCase(small(arm="nothing", variant="white", noise=0.0, strength="full"))
    around = made.road.around
    recording = made.recording(made.simulate(made.truth).x)
    found = recording.recalibrated(around.v0, around.L)
    assert found == pytest.approx((around.v0, around.L), rel=2e-3)
    assert cost_by_sequence(recording.errors(*found)).mean() < 4e-4


def test_without_excitation_an_effect_changes_nothing_that_is_measured():
    case = small("relative_speed", arm="no_excitation", strength="full", noise=0.0)
    made = TrafficCase(case)
    around = made.road.around
    recording = made.recording(made.simulate(made.truth).x)
    assert cost_by_sequence(recording.errors(around.v0, around.L)).mean() < 1e-8


@pytest.mark.parametrize("effect", ["reaction_delay", "inertia"])
def test_waves_do_not_grow_along_the_platoon(effect):
    for seed in range(3):
        made = TrafficCase(small(effect, strength="full", seed=seed))
        (late,) = made.truth.effects[effect].values()
        assert made.steepest() * late <= 0.45


@pytest.mark.parametrize("kind", ["identity_swap", "jump", "overlap"])
def test_inserted_faults_are_where_the_truth_says(tmp_path, kind):
    case = small(arm="fault", variant=kind, strength="full", n_sequences=10)
    truth = generate(case, tmp_path)
    sequences = {s.name: s for s in read(tmp_path)}
    wrong = {fault["sequence"]: fault for fault in truth["data_faults"]}
    assert len(wrong) == 2
    for name, sequence in sequences.items():
        found = find_faults(sequence, "traffic")
        if name not in wrong:
            assert not found
            continue
        hidden = wrong[name]
        k = int(np.argmin(np.abs(sequence.time - hidden["time"])))
        who = [sequence.agents.index(agent) for agent in hidden["agents"]]
        if kind == "overlap":
            assert abs(np.diff(sequence.x[k, who, 0])[0]) < 1.0
        else:
            step = np.abs(np.diff(sequence.x[k - 1 : k + 1, who, 0], axis=0))
            assert step.max() > 8.0


def test_windows_keep_names_and_clock_so_that_platoons_stay_clusters(tmp_path):
    whole = small(arm="nothing", variant="windows", strength="full", n_sequences=2)
    generate(whole, tmp_path)
    sequences = read(tmp_path)
    assert [s.name for s in sequences] == whole.names
    assert [s.name.split("/")[1] for s in sequences[:4]] == ["s000w0", "s000w1", "s000w2", "s001w0"]
    first, second, third, other = sequences[:4]
    assert first.agents == second.agents == third.agents
    assert not set(first.agents) & set(other.agents)
    # one clock, and no sample twice
    assert second.time[0] - first.time[-1] == pytest.approx(whole.dt)
    assert first.time[-1] - first.time[0] == pytest.approx(10 - whole.dt)
    # nobody jumps from one window to the next
    assert np.all(second.x[0] - first.x[-1] > 0)
    assert np.all(second.x[0] - first.x[-1] < 8)


def test_a_recording_is_two_streams_that_hang_together(tmp_path):
    (case,) = cases("traffic", "nothing", seeds=[0], variants=["recording"])
    assert (case.n_sequences, case.n_agents, case.duration, case.sigma) == (2, 24, 90.0, 0.1)
    truth = generate(case, tmp_path)
    assert truth["noise"]["correlation"] == 6.0
    sequences = read(tmp_path)
    assert [len(s.agents) for s in sequences] == [8] * 54
    assert {s.x.shape for s in sequences} == {(50, 8, 1)}
    assert len({agent for s in sequences for agent in s.agents}) == 48
    parts = [set(s.agents) for s in sequences]
    clusters = []
    while parts:
        one = parts.pop()
        while near := [part for part in parts if part & one]:
            one |= set().union(*near)
            parts = [part for part in parts if part not in near]
        clusters.append(one)
    assert [len(one) for one in clusters] == [24, 24]


def test_nothing_hidden_is_not_replayed(tmp_path, monkeypatch):
    monkeypatch.setattr(TrafficCase, "costs", None)
    case = small(arm="nothing", variant="heterogeneous", strength="full")
    truth = generate(case, tmp_path)
    assert (truth["cost"], truth["strength"]["reached"]) == (None, None)


def test_what_is_hidden_is_not_cut_into_windows():
    with pytest.raises(ConfigError, match="variant=windows of arm=single with 1 effect"):
        small("inertia", variant="windows")


def test_other_cases_hold_no_fault(tmp_path):
    for i, case in enumerate(cases("traffic", "nothing", seeds=[0], noises=[0.3], sizes=[6])):
        generate(case, tmp_path / str(i))
        assert not [f for s in read(tmp_path / str(i)) for f in find_faults(s, "traffic")]


def test_a_nuisance_is_told_apart_from_what_is_hidden(tmp_path):
    truth = generate(small(arm="nothing", variant="heterogeneous", strength="full"), tmp_path)
    assert truth["effects"] == []
    assert [item["name"] for item in truth["nuisance"]] == ["driver_heterogeneity"]


def test_unknown_words_are_refused():
    with pytest.raises(ConfigError, match="expected one of weak, medium"):
        small("inertia", strength="huge")
    with pytest.raises(ConfigError, match="effect telepathy is unknown in traffic"):
        TrafficCase(small("telepathy"))
    with pytest.raises(ConfigError, match="arm=solo"):
        cases("traffic", "solo", seeds=[0])


def test_seeds_follow_from_the_hash_of_a_commit():
    # printf '0%.0s' {1..40} | sha256sum
    assert first_seed("0" * 40) == 0x9692E67
    for wrong in ("0" * 7, "0" * 41, "A" * 40):
        with pytest.raises(ConfigError, match="is no full hash of a commit"):
            first_seed(wrong)
