"""Scores of made-up reports against made-up truths."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from benchmarks.synthetic_cases import score as scoring

#: Classes as a catalogue states them.
CLASSES = {
    "reaction_delay": "late",
    "inertia": "late",
    "relative_speed": "ahead",
    "time_gap": "ahead",
    "asymmetric_response": "ahead",
    "speed_zone": "",
    "speed_period": "",
}
NAMES = [f"trajectories/s{i:03d}" for i in range(4)]


def truth(*effects: str, arm: str = "single", **more: Any) -> dict[str, Any]:
    values = {
        "relative_speed": {"kappa": 0.4},
        "speed_zone": {"alpha": 0.8, "a": 300.0, "b": 500.0},
        "vehicle_class": {"phi": 0.9},
        "field_of_view": {"lambda_": 0.2},
    }
    content: dict[str, Any] = {
        "key": "case",
        "case": {
            "domain": "traffic",
            "arm": arm,
            "effects": list(effects),
            "variant": "plain",
            "strength": "medium",
            "noise": 0.05,
            "n_sequences": 4,
            "seed": 0,
        },
        "effects": [
            {
                "name": name,
                "coefficients": {k: {"value": v} for k, v in values.get(name, {}).items()},
            }
            for name in effects
        ],
        "outside": [],
        "nuisance": [],
        "data_faults": [],
        "not_testable": [],
        "strength": {"reached": 0.4},
    }
    return {**content, **more}


def report(*effects: str, verdict: str = "named", **more: Any) -> dict[str, Any]:
    return {
        "verdict": verdict,
        "effects": [{"name": name, "coefficients": {}, "alternatives": []} for name in effects],
        "data_faults": [],
        "not_testable": [],
        "leads": [],
        "gap": {"before": 2.0, "after": 2.0, "closed": 0.0},
        **more,
    }


def score(truth: dict[str, Any], report: dict[str, Any]) -> dict[str, Any]:
    return scoring.score(truth, report, CLASSES)


def listed(name: str, *others: str, verdict: str = "indistinguishable") -> dict[str, Any]:
    """A report of equals."""
    found = report(name, verdict=verdict)
    found["effects"][0]["alternatives"] = [{"name": other, "loss": 1.0} for other in others]
    return found


def test_an_exact_name_is_exact_and_right():
    row = score(truth("relative_speed"), report("relative_speed"))
    assert (row["exact"], row["class_right"], row["right"]) == (True, True, True)
    assert not row["false_name"]


@pytest.mark.parametrize(
    ("found", "equals", "class_right", "false"),
    [
        (listed("inertia", "relative_speed"), True, True, ""),
        (listed("relative_speed", "inertia"), True, True, ""),
        (listed("relative_speed", "time_gap"), False, False, "relative_speed"),
        (listed("reaction_delay", "time_gap"), False, True, "reaction_delay"),
    ],
)
def test_equals_are_never_exact_and_have_a_measure_of_their_own(found, equals, class_right, false):
    row = score(truth("inertia"), found)
    assert (row["exact"], row["right"]) == (False, False)
    assert (row["among_equals"], row["class_right"]) == (equals, class_right)
    assert row["false_names"] == false


def test_kin_is_what_the_catalogue_says_and_nothing_else():
    hidden, said = truth("inertia"), report("reaction_delay")
    assert score(hidden, said)["class_right"]
    assert not scoring.score(hidden, said, {})["class_right"]
    # no class is none: two effects without one are no kin
    assert not score(truth("speed_zone"), report("speed_period"))["class_right"]


def test_unconfirmed_effects_are_leads_and_no_names():
    def found(name: str) -> dict[str, Any]:
        lead = {"name": name, "coefficients": {}, "alternatives": []}
        return {**report(verdict="none"), "leads": [lead]}

    row = score(truth("relative_speed"), found("relative_speed"))
    assert (row["exact"], row["class_right"], row["right"]) == (False, False, False)
    assert (row["named"], row["hypotheses"]) == ("", "relative_speed")
    assert not score(truth("relative_speed"), found("speed_zone"))["false_name"]
    idle = score(truth(arm="nothing"), found("speed_zone"))
    assert (idle["right"], idle["hypothesis"]) == (True, True)


def test_a_further_name_is_false():
    row = score(truth("relative_speed"), report("relative_speed", "speed_zone"))
    assert (row["exact"], row["class_right"]) == (False, False)
    assert (row["false_names"], row["false_name"]) == ("speed_zone", True)


def test_pairs_count_what_was_found_and_match_one_to_one():
    pair = truth("relative_speed", "time_gap", arm="pair")
    row = score(pair, report("time_gap"))
    assert (row["exact"], row["class_right"]) == (False, False)
    # the exact name must not be matched with its kin
    row = score(pair, report("time_gap", "asymmetric_response"))
    assert (row["exact"], row["class_right"]) == (False, True)
    assert score(pair, report("time_gap", "relative_speed"))["exact"]


def test_people_who_differ_may_be_named_where_they_do():
    quiet, nuisance = truth(arm="nothing"), truth(arm="nothing")
    nuisance["nuisance"] = [{"name": "walker_heterogeneity", "coefficients": {}}]
    assert score(quiet, report(verdict="none"))["right"]
    assert not score(quiet, report("walker_heterogeneity"))["right"]
    assert score(nuisance, report("walker_heterogeneity"))["right"]
    assert not score(nuisance, report("walker_heterogeneity", "inertia"))["right"]


def test_what_the_catalogue_lacks_is_to_be_called_unknown():
    outside = truth(arm="outside")
    assert score(outside, report(verdict="unknown"))["right"]
    # whatever the verdict, its first sentence names something
    for verdict in ("named", "indistinguishable", "unknown"):
        row = score(outside, report("speed_zone", verdict=verdict))
        assert (row["right"], row["false_names"]) == (False, "speed_zone")
        assert (row["exact"], row["unknown"]) == (None, False)


def test_without_excitation_an_effect_is_to_be_called_not_testable():
    still = truth("inertia", arm="no_excitation")
    assert not score(still, report(verdict="none"))["right"]
    assert score(still, report(verdict="none", not_testable=["inertia"]))["right"]
    assert not score(still, report("inertia", not_testable=["inertia"]))["right"]
    assert not score(still, report("time_gap", not_testable=["inertia"]))["right"]


@pytest.mark.parametrize(
    ("found", "located", "false"),
    [
        ({"sequence": "s001", "agents": ["s001v2"], "time": 10.9}, True, False),
        ({"sequence": "other/s001", "agents": [3], "time": 9.2}, True, False),
        ({"sequence": "s001", "agents": ["s001v2"], "time": 11.1}, False, False),
        ({"sequence": "s001", "agents": ["s001v5"], "time": 10.0}, False, False),
        ({"sequence": "s001", "agents": ["s001v2"], "time": None}, False, False),
        ({"sequence": "s002", "agents": ["s002v2"], "time": 10.0}, False, True),
    ],
)
def test_a_fault_is_located_by_sequence_agent_and_time(found, located, false):
    hidden = {
        "kind": "jump",
        "sequence": NAMES[1],
        "agents": ["s001v2", "s001v3"],
        "places": [2, 3],
        "time": 10.0,
    }
    said = report(verdict="none", data_faults=[found])
    row = score(truth(arm="fault", data_faults=[hidden]), said)
    assert (row["located"], row["blamed"], row["right"]) == (located, false, located)
    both = report(verdict="none", data_faults=[found, {**hidden, "sequence": NAMES[3]}, hidden])
    row = score(truth(arm="fault", data_faults=[hidden]), both)
    assert (row["located"], row["blamed"], row["right"]) == (True, True, False)


def test_a_sound_sequence_that_is_blamed_makes_nothing_hidden_wrong():
    found = {"sequence": "s001", "agents": ["s001v2"], "time": 1.0}
    row = score(truth(arm="nothing"), report(verdict="none", data_faults=[found]))
    assert (row["located"], row["blamed"], row["right"]) == (None, True, False)


@pytest.mark.parametrize(
    ("p_value", "effect", "false"),
    [
        (0.04, "inertia", True),
        (0.06, "inertia", False),
        (0.04, "walker_heterogeneity", False),
        (None, None, None),
    ],
)
def test_the_first_screen_is_kept_with_its_clusters(p_value, effect, false):
    quiet = truth(arm="nothing")
    quiet["nuisance"] = [{"name": "walker_heterogeneity", "coefficients": {}}]
    found = report(
        verdict="none",
        screen={"p_value": p_value, "effect": effect},
        clusters={"open": 15, "sealed": 5},
    )
    row = score(quiet, found)
    assert (row["screen_p"], row["screen_false"]) == (p_value, false)
    assert row["clusters"] == 15


def test_coefficients_are_compared_with_regard_to_what_means_no_effect():
    found = report("speed_zone")
    found["effects"][0]["coefficients"] = {
        "alpha": {"value": 0.84, "low": 0.79, "high": 0.89},
        "a": {"value": 320.0, "low": 310.0, "high": 330.0},
        "b": {"value": 520.0, "low": 480.0, "high": 560.0},
    }
    hidden = truth("speed_zone")
    alpha, a, b = scoring.coefficient_rows(hidden["effects"], found["effects"])
    assert alpha["relative"] == pytest.approx(0.05)
    assert alpha["of_size"] == pytest.approx(0.2)
    assert [r["covered"] for r in (alpha, a, b)] == [True, False, True]
    assert a["relative"] is None
    assert a["absolute"] == pytest.approx(20.0)
    assert score(hidden, found)["overlap"] == pytest.approx(180 / 220)
    apart = copy.deepcopy(found)
    apart["effects"][0]["coefficients"]["a"]["value"] = 510.0
    assert score(hidden, apart)["overlap"] == 0.0


def test_errors_on_confirmation_sequences_are_kept():
    found = report("relative_speed", gap={"before": 10.0, "after": 6.0, "closed": 0.5})
    row = score(truth("relative_speed"), found)
    assert (row["closed"], row["worse"]) == (0.5, False)
    found["gap"]["after"] = 10.1
    assert score(truth("relative_speed"), found)["worse"]
