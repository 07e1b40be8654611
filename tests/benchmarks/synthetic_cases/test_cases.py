"""Synthetic cases: files, hidden effects and their strengths."""

from __future__ import annotations

import json
from dataclasses import replace
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
EFFECTS = [(domain, name) for domain in DOMAINS for name in CATALOGUES[domain].effects]


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
def test_files_are_reproducible(domain, tmp_path):
    case = small("relative_speed" if domain == "traffic" else "group_cohesion", domain=domain)
    for name, other in (("a", case), ("b", case), ("c", replace(case, seed=1))):
        generate(other, tmp_path / name)
    a, b, c = ((tmp_path / name / TABLE).read_bytes() for name in "abc")
    assert a == b
    assert a != c
    assert (tmp_path / "a" / TRUTH).read_text() == (tmp_path / "b" / TRUTH).read_text()


def test_cases_survive_json_and_have_unique_keys():
    arm_cases = cases("traffic", "single", seeds=range(2), strengths=["weak", "full"])
    assert [Case(**json.loads(json.dumps(case.to_dict()))) for case in arm_cases] == arm_cases
    assert len({case.key for case in arm_cases}) == len(arm_cases) == 2 * 2 * 10


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("arm", ARMS)
def test_effects_of_arms_are_in_the_catalogue(domain, arm):
    arm_cases = cases(domain, arm, seeds=[0])
    assert arm_cases
    assert {name for case in arm_cases for name in case.effects} <= set(CATALOGUES[domain].effects)


def test_leaders_and_coefficients_do_not_depend_on_noise():
    full, noisy = (subject_of(small("relative_speed", noise=noise)) for noise in (0.0, 0.3))
    assert full.truth == noisy.truth
    np.testing.assert_array_equal(full.lead, noisy.lead)


def test_platoons_are_read_with_classes_and_times(tmp_path):
    case = small("vehicle_class", noise=0.0)
    truth = generate(case, tmp_path)
    sequences = read(tmp_path)
    assert [s.name for s in sequences] == case.names == list(truth["cost"]["oracle"])
    assert {(*s.x.shape, round(s.dt, 9)) for s in sequences} == {(151, 8, 1, 0.2)}
    starts = [s.time[0] for s in sequences]
    assert (np.diff(starts) > 30).all()
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
        # destinations are not reached
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
def test_oracle_removes_the_requested_share(domain, effect, strength):
    subject = subject_of(small(effect, domain=domain, strength=strength, n_sequences=8))
    share = {"weak": 0.15, "medium": 0.4, "strong": 0.7}[strength]
    assert subject.costs(subject.truth).share == pytest.approx(share, abs=0.04)


@pytest.mark.thorough
@pytest.mark.parametrize(("domain", "effect"), EFFECTS)
def test_only_the_oracle_explains_noiseless_data(domain, effect):
    subject = subject_of(small(effect, domain=domain, noise=0.0))
    costs = subject.costs(subject.truth)
    assert costs.floor == 0
    # the oracle of traffic interpolates leaders linearly between samples
    assert costs.oracle.mean() < {"traffic": 4e-4, "crowd": 4e-6}[domain]
    assert costs.base.mean() > 20 * costs.oracle.mean()


@pytest.mark.parametrize("domain", DOMAINS)
def test_base_law_explains_data_without_effects(domain):
    subject = subject_of(nothing("white", domain=domain, noise=0.0))
    assert subject.costs(subject.truth).base.mean() < {"traffic": 4e-4, "crowd": 4e-6}[domain]


@pytest.mark.parametrize(
    ("domain", "effect"),
    [
        ("traffic", "relative_speed"),
        ("crowd", "alignment"),
        ("crowd", "side_preference"),
        ("crowd", "anticipation"),
    ],
)
def test_effects_without_excitation_change_no_positions(domain, effect):
    subject = subject_of(small(effect, domain=domain, arm="no_excitation", noise=0.0))
    motion = subject.simulate(subject.truth)
    error = subject.errors(motion, motion.x, list(subject.base.values()))
    assert subject.cost(error).mean() < {"traffic": 1e-8, "crowd": 2.5e-5}[domain]


@pytest.mark.parametrize("effect", ["reaction_delay", "inertia"])
def test_delays_are_string_stable(effect):
    for seed in range(3):
        subject = subject_of(small(effect, seed=seed))
        (delay,) = subject.truth.effects[effect].values()
        assert subject.steepest() * delay <= 0.45


def test_people_stay_in_the_corridor_and_keep_distance():
    subject = subject_of(nothing("autocorrelated", domain="crowd", n_sequences=6))
    x, v, _ = subject.simulate(subject.truth)
    assert ((x[..., 1] < 0) | (x[..., 1] > subject.width)).mean() < 0.02
    assert 0.7 < np.median(np.hypot(v[..., 0], v[..., 1])) < 1.6
    distance = np.hypot(*(x[:, :, :, None] - x[:, :, None]).transpose(4, 0, 1, 2, 3))
    assert distance[..., ~np.eye(16, dtype=bool)].min() > 0.12


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("kind", FAULTS)
def test_faults_are_where_the_truth_says(tmp_path, domain, kind):
    truth = generate(small(domain=domain, arm="fault", variant=kind, n_sequences=10), tmp_path)
    hidden = {fault["sequence"]: fault for fault in truth["data_faults"]}
    assert len(hidden) == 2
    for sequence in read(tmp_path):
        faults, fault = find_faults(sequence, domain), hidden.get(sequence.name)
        if fault is None:
            assert not faults
            continue
        k = int(np.argmin(np.abs(sequence.time - fault["time"])))
        places = [sequence.agents.index(agent) for agent in fault["agents"]]
        assert places == fault["places"]
        x = sequence.x[k - 1 : k + 1, places]
        if kind == "overlap":
            assert np.linalg.norm(x[1, 0] - x[1, 1]) < {"traffic": 1.0, "crowd": 0.1}[domain]
        elif domain == "traffic":
            assert np.abs(np.diff(x, axis=0)).max() > 8.0
        if domain == "crowd":
            near = [f for f in faults if abs(f.time - fault["time"]) < 0.15]
            assert any(set(f.agents) & set(places) for f in near)


@pytest.mark.parametrize(
    ("domain", "shape", "farthest"), [("traffic", (50, 8, 1), 8.0), ("crowd", (30, 16, 2), 0.4)]
)
def test_windows_keep_names_and_times_of_their_run(tmp_path, domain, shape, farthest):
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
    # windows are consecutive without shared samples or jumps
    assert second.time[0] - first.time[-1] == pytest.approx(case.size[2])
    assert 0 < np.abs(second.x[0] - first.x[-1]).max() < farthest


def test_recording_has_two_clusters(tmp_path):
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
def test_autocorrelated_noise_of_people_is_no_fault(tmp_path, variant, low, high):
    truth = generate(nothing(variant, domain="crowd", n_sequences=6), tmp_path)
    assert low <= truth["noise"]["correlation"] <= high
    assert truth["noise"]["amplitude"] > 0
    assert not [f for s in read(tmp_path) for f in find_faults(s, "crowd")]


def test_platoons_without_inserted_faults_have_none(tmp_path):
    for i, case in enumerate(cases("traffic", "nothing", seeds=[0], noises=[0.3], sizes=[6])):
        generate(case, tmp_path / str(i))
        assert not [f for s in read(tmp_path / str(i)) for f in find_faults(s, "traffic")]


def test_nuisance_is_no_effect_and_has_no_costs(tmp_path, monkeypatch):
    subject = subject_of(nothing("heterogeneous"))
    monkeypatch.setattr(type(subject), "costs", None)
    truth = generate(subject.case, tmp_path)
    assert truth["effects"] == []
    assert [item["name"] for item in truth["nuisance"]] == ["driver_heterogeneity"]
    assert (truth["cost"], truth["strength"]["reached"]) == (None, None)


def test_standard_deviation_of_people():
    subject = subject_of(small("walker_heterogeneity", domain="crowd"))
    assert subject.people.eta.std() == pytest.approx(1.0)
    sigma = subject.truth.effects["walker_heterogeneity"]["sigma"]
    assert subject._people(subject.truth, slice(None)).eta.std() == pytest.approx(sigma)


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
def test_invalid_cases_are_refused(effects, options, message):
    with pytest.raises(ConfigError, match=message):
        small(*effects, **options)


def test_first_seed_of_a_commit():
    # printf '0%.0s' {1..40} | sha256sum
    assert first_seed("0" * 40) == 0x9692E67
    for wrong in ("0" * 7, "0" * 41, "A" * 40):
        with pytest.raises(ConfigError, match="is no full hash of a commit"):
            first_seed(wrong)
