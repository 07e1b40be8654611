"""Cases: what is written is what was hidden, at the strength asked for."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic_cases import ARMS, Case, generate, subject_of
from benchmarks.synthetic_cases.case import FAULTS, TABLE, TRUTH, WALLS, cases, first_seed
from benchmarks.synthetic_cases.catalogue import CATALOGUES
from nnode.data.quality import find_faults
from nnode.data.readers.table import TableOptions, read_table
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError

DOMAINS = ["traffic", "crowd"]
EVERY = [(domain, name) for domain in DOMAINS for name in CATALOGUES[domain].effects]


def small(*effects: str, domain: str = "traffic", **options: Any) -> Case:
    size = 6 if domain == "traffic" else 2
    defaults = {"domain": domain, "arm": "single", "n_sequences": size, "strength": "full"}
    return Case(**{**defaults, "effects": effects, **options})


def nothing(variant: str, **options: Any) -> Case:
    return small(arm="nothing", variant=variant, **options)


def read(folder: Path) -> list[Sequence]:
    domain = "crowd" if (folder / WALLS).exists() else "traffic"
    walls = folder / WALLS if domain == "crowd" else None
    return read_table(folder / TABLE, TableOptions(domain=domain), walls)


@pytest.mark.thorough
@pytest.mark.parametrize("domain", DOMAINS)
def test_equal_cases_give_equal_files_and_other_seeds_others(domain, tmp_path):
    one = small("relative_speed" if domain == "traffic" else "group_cohesion", domain=domain)
    for name, case in (("a", one), ("b", one), ("c", replace(one, seed=1))):
        generate(case, tmp_path / name)
    a, b, c = ((tmp_path / name / TABLE).read_bytes() for name in "abc")
    assert a == b
    assert a != c
    assert (tmp_path / "a" / TRUTH).read_text() == (tmp_path / "b" / TRUTH).read_text()


def test_a_case_survives_json_and_has_a_key_of_its_own():
    some = cases("traffic", "single", seeds=range(2), strengths=["weak", "full"])
    assert [Case(**json.loads(json.dumps(case.to_dict()))) for case in some] == some
    assert len({case.key for case in some}) == len(some) == 2 * 2 * 10


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("arm", ARMS)
def test_every_arm_hides_effects_of_its_domain(domain, arm):
    some = cases(domain, arm, seeds=[0])
    assert some
    assert {name for case in some for name in case.effects} <= set(CATALOGUES[domain].effects)


def test_strength_and_noise_leave_the_road_and_the_coefficients_as_they_are():
    full, noisy = (subject_of(small("relative_speed", noise=noise)) for noise in (0.0, 0.3))
    assert full.truth == noisy.truth
    np.testing.assert_array_equal(full.lead, noisy.lead)


def test_platoons_are_read_with_classes_and_a_clock(tmp_path):
    case = small("vehicle_class", noise=0.0)
    truth = generate(case, tmp_path)
    sequences = read(tmp_path)
    assert [s.name for s in sequences] == case.names == list(truth["cost"]["oracle"])
    assert {(*s.x.shape, round(s.dt, 9)) for s in sequences} == {(151, 8, 1, 0.2)}
    starts = [s.time[0] for s in sequences]
    assert all(later - one > 30 for one, later in pairwise(starts))
    kinds = [kind for s in sequences for kind in s.kind or ()]
    assert 0.1 < kinds.count("truck") / len(kinds) < 0.45
    assert len({agent for s in sequences for agent in s.agents}) == 8 * len(sequences)


@pytest.mark.thorough
def test_crowds_are_read_with_walls_groups_and_destinations(tmp_path):
    case = small("group_cohesion", domain="crowd")
    generate(case, tmp_path)
    sequences = read(tmp_path)
    assert [s.name for s in sequences] == case.names
    for s in sequences:
        assert (*s.x.shape, round(s.dt, 9), len(s.walls)) == (61, 16, 2, 0.1, 2)
        names = [name for name in s.group or () if name]
        assert {names.count(name) for name in names} <= {2, 3}
        assert names
        # everyone walks towards a destination that is still ahead
        assert np.hypot(*(s.destination - s.x[-1]).T).min() > 1.0
    assert len({agent for s in sequences for agent in s.agents}) == 32


@pytest.mark.parametrize(
    ("domain", "effect", "strength"),
    [
        ("traffic", "relative_speed", "medium"),
        ("traffic", "inertia", "weak"),
        ("traffic", "speed_zone", "strong"),
        ("crowd", "drift", "medium"),
    ],
)
def test_an_oracle_removes_the_share_that_was_asked_for(domain, effect, strength):
    made = subject_of(small(effect, domain=domain, strength=strength, n_sequences=8))
    share = {"weak": 0.15, "medium": 0.4, "strong": 0.7}[strength]
    assert made.costs(made.truth).share == pytest.approx(share, abs=0.04)


@pytest.mark.thorough
@pytest.mark.parametrize(("domain", "effect"), EVERY)
def test_an_oracle_explains_sound_data_and_the_base_law_does_not(domain, effect):
    made = subject_of(small(effect, domain=domain, noise=0.0))
    costs = made.costs(made.truth)
    assert costs.floor == 0
    # what is left to the oracle of traffic is that leaders are straight between samples
    assert costs.oracle.mean() < {"traffic": 4e-4, "crowd": 4e-6}[domain]
    assert costs.base.mean() > 20 * costs.oracle.mean()


@pytest.mark.parametrize("domain", DOMAINS)
def test_nothing_hidden_leaves_the_base_law_true(domain):
    made = subject_of(nothing("white", domain=domain, noise=0.0))
    assert made.costs(made.truth).base.mean() < {"traffic": 4e-4, "crowd": 4e-6}[domain]


@pytest.mark.parametrize(
    ("domain", "effect"),
    [
        ("traffic", "relative_speed"),
        ("crowd", "alignment"),
        ("crowd", "side_preference"),
        ("crowd", "anticipation"),
    ],
)
def test_without_excitation_an_effect_changes_nothing_that_is_measured(domain, effect):
    made = subject_of(small(effect, domain=domain, arm="no_excitation", noise=0.0))
    motion = made.simulate(made.truth)
    error = made.errors(motion, motion.x, list(made.base.values()))
    assert made.cost(error).mean() < {"traffic": 1e-8, "crowd": 2.5e-5}[domain]


@pytest.mark.parametrize("effect", ["reaction_delay", "inertia"])
def test_waves_do_not_grow_along_the_platoon(effect):
    for seed in range(3):
        made = subject_of(small(effect, seed=seed))
        (late,) = made.truth.effects[effect].values()
        assert made.steepest() * late <= 0.45


def test_people_mostly_stay_in_the_corridor_and_apart():
    made = subject_of(nothing("autocorrelated", domain="crowd", n_sequences=6))
    x, v, _ = made.simulate(made.truth)
    assert ((x[..., 1] < 0) | (x[..., 1] > made.width)).mean() < 0.02
    assert 0.7 < np.median(np.hypot(v[..., 0], v[..., 1])) < 1.6
    distance = np.hypot(*(x[:, :, :, None] - x[:, :, None]).transpose(4, 0, 1, 2, 3))
    assert distance[..., ~np.eye(16, dtype=bool)].min() > 0.12


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("kind", FAULTS)
def test_inserted_faults_are_where_the_truth_says_and_nowhere_else(tmp_path, domain, kind):
    truth = generate(small(domain=domain, arm="fault", variant=kind, n_sequences=10), tmp_path)
    hidden = {fault["sequence"]: fault for fault in truth["data_faults"]}
    assert len(hidden) == 2
    for sequence in read(tmp_path):
        found, fault = find_faults(sequence, domain), hidden.get(sequence.name)
        if fault is None:
            assert not found
            continue
        k = int(np.argmin(np.abs(sequence.time - fault["time"])))
        who = [sequence.agents.index(agent) for agent in fault["agents"]]
        assert who == fault["places"]
        x = sequence.x[k - 1 : k + 1, who]
        if kind == "overlap":
            assert np.linalg.norm(x[1, 0] - x[1, 1]) < {"traffic": 1.0, "crowd": 0.1}[domain]
        elif domain == "traffic":
            assert np.abs(np.diff(x, axis=0)).max() > 8.0
        if domain == "crowd":
            near = [f for f in found if abs(f.time - fault["time"]) < 0.15]
            assert any(set(f.agents) & set(who) for f in near)


@pytest.mark.parametrize(
    ("domain", "shape", "farthest"), [("traffic", (50, 8, 1), 8.0), ("crowd", (30, 16, 2), 0.4)]
)
def test_windows_keep_names_and_clock_so_that_runs_stay_clusters(tmp_path, domain, shape, farthest):
    case = nothing("windows", domain=domain, n_sequences=2)
    generate(case, tmp_path)
    sequences = read(tmp_path)
    assert [s.name for s in sequences] == case.names
    names = [s.name.split("/")[1] for s in sequences[:4]]
    assert names == ["s000w0", "s000w1", "s000w2", "s001w0"]
    assert {s.x.shape for s in sequences} == {shape}
    first, second, third, other = sequences[:4]
    assert first.agents == second.agents == third.agents
    assert first.group == second.group
    assert not set(first.agents) & set(other.agents)
    # one clock, and no sample twice; nobody jumps from one window to the next
    assert second.time[0] - first.time[-1] == pytest.approx(case.size[2])
    assert 0 < np.abs(second.x[0] - first.x[-1]).max() < farthest


def test_a_recording_is_two_streams_that_hang_together(tmp_path):
    (case,) = cases("traffic", "nothing", seeds=[0], variants=["recording"])
    assert (case.n_sequences, case.size, case.sigma) == (2, (24, 90.0, 0.2), 0.1)
    assert generate(case, tmp_path)["noise"]["correlation"] == 6.0
    sequences = read(tmp_path)
    assert [s.x.shape for s in sequences] == [(50, 8, 1)] * 54
    clusters: list[set[str]] = []
    for s in sequences:
        joined = [c for c in clusters if c & set(s.agents)]
        clusters = [c for c in clusters if c not in joined]
        clusters.append(set(s.agents).union(*joined))
    assert [len(cluster) for cluster in clusters] == [24, 24]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("variant", "low", "high"),
    [("autocorrelated", 0.3, 0.6), ("windows", 0.3, 0.6), ("slow", 1.0, 2.0)],
)
def test_disturbances_of_people_that_last_are_no_faults(tmp_path, variant, low, high):
    truth = generate(nothing(variant, domain="crowd", n_sequences=6), tmp_path)
    assert low <= truth["noise"]["correlation"] <= high
    assert truth["noise"]["amplitude"] > 0
    assert not [f for s in read(tmp_path) for f in find_faults(s, "crowd")]


def test_platoons_of_other_cases_have_no_faults(tmp_path):
    for i, case in enumerate(cases("traffic", "nothing", seeds=[0], noises=[0.3], sizes=[6])):
        generate(case, tmp_path / str(i))
        assert not [f for s in read(tmp_path / str(i)) for f in find_faults(s, "traffic")]


def test_a_nuisance_is_no_hidden_effect_and_is_not_replayed(tmp_path, monkeypatch):
    made = subject_of(nothing("heterogeneous"))
    monkeypatch.setattr(type(made), "costs", None)
    truth = generate(made.case, tmp_path)
    assert truth["effects"] == []
    assert [item["name"] for item in truth["nuisance"]] == ["driver_heterogeneity"]
    assert (truth["cost"], truth["strength"]["reached"]) == (None, None)


def test_people_differ_by_the_standard_deviation_of_the_truth():
    made = subject_of(small("walker_heterogeneity", domain="crowd"))
    assert made.people.eta.std() == pytest.approx(1.0)
    sigma = made.truth.effects["walker_heterogeneity"]["sigma"]
    assert made._people(made.truth, slice(None)).eta.std() == pytest.approx(sigma)


@pytest.mark.parametrize(
    ("effects", "options", "message"),
    [
        (["inertia"], {"strength": "huge"}, "strength=huge: expected one of weak, medium"),
        (["telepathy"], {}, "traffic effect=telepathy: expected one of"),
        ([], {"arm": "solo"}, "arm=solo"),
        (["inertia"], {"variant": "windows"}, "variant=windows of arm=single with 1 effect"),
        ([], {"n_sequences": 0}, "n_sequences=0"),
        ([], {"noise": -0.1}, "noise=-0.1"),
    ],
)
def test_cases_that_make_no_sense_are_refused(effects, options, message):
    with pytest.raises(ConfigError, match=message):
        small(*effects, **options)


def test_seeds_follow_from_the_hash_of_a_commit():
    # printf '0%.0s' {1..40} | sha256sum
    assert first_seed("0" * 40) == 0x9692E67
    for wrong in ("0" * 7, "0" * 41, "A" * 40):
        with pytest.raises(ConfigError, match="is no full hash of a commit"):
            first_seed(wrong)
