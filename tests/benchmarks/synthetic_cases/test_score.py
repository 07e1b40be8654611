"""Scores of synthetic reports for known truths."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.synthetic_cases import score as scoring

#: Classes of effects, as in a catalogue.
CLASSES = {
    **dict.fromkeys(("reaction_delay", "inertia"), "late"),
    **dict.fromkeys(("relative_speed", "time_gap", "asymmetric_response"), "ahead"),
    **dict.fromkeys(("speed_zone", "speed_period"), ""),
}
WALKERS = {"nuisance": [{"name": "walker_heterogeneity", "coefficients": {}}]}
ZONE = {"alpha": 0.8, "a": 300.0, "b": 500.0}
FAULT = {
    "kind": "jump",
    "sequence": "trajectories/s001",
    "agents": ["s001v2", "s001v3"],
    "places": [2, 3],
    "time": 10.0,
}


def truth(*effects: str, arm: str = "single", **more: Any) -> dict[str, Any]:
    case = {"domain": "traffic", "arm": arm, "effects": list(effects), "variant": "plain"}
    case |= {"strength": "medium", "noise": 0.05, "n_sequences": 4, "seed": 0}
    zone = {name: {"value": value} for name, value in ZONE.items()}
    hidden = [
        {"name": name, "coefficients": zone if name == "speed_zone" else {}} for name in effects
    ]
    content = {"case": case, "effects": hidden, "nuisance": [], "data_faults": []}
    return content | {"strength": {"reached": 0.4}} | more


def report(*effects: str, verdict: str = "named", **more: Any) -> dict[str, Any]:
    """A report of effects, each with its alternatives after a slash."""
    named = []
    for effect in effects:
        name, *equals = effect.split("/")
        alternatives = [{"name": other, "loss": 1.0} for other in equals]
        named.append({"name": name, "coefficients": {}, "alternatives": alternatives})
    return {"verdict": verdict, "effects": named} | more


def hypothesis(name: str) -> dict[str, Any]:
    """A report of an unconfirmed effect."""
    return report(
        verdict="none", hypotheses=[{"name": name, "coefficients": {}, "alternatives": []}]
    )


EQUALS, UNKNOWN, NONE = ({"verdict": v} for v in ("indistinguishable", "unknown", "none"))
NOTHING = truth(arm="nothing")
DIFFERENT = truth(arm="nothing", **WALKERS)
PAIR = truth("relative_speed", "time_gap", arm="pair")
STILL, OUTSIDE = truth("inertia", arm="no_excitation"), truth(arm="outside")
INEXACT = {"exact": False, "class_right": False}


@pytest.mark.parametrize(
    ("hidden", "result", "row"),
    [
        (
            truth("relative_speed"),
            report("relative_speed"),
            {"exact": True, "class_right": True, "right": True, "false_name": False},
        ),
        # indistinguishable effects are never exact and have a separate measure
        *(
            (
                truth("inertia"),
                report(named, **EQUALS),
                {"exact": False, "right": False, "among_equals": equals}
                | {"class_right": class_right, "false_names": false},
            )
            for named, equals, class_right, false in (
                ("inertia/relative_speed", True, True, ""),
                ("relative_speed/inertia", True, True, ""),
                ("relative_speed/time_gap", False, False, "relative_speed"),
                ("reaction_delay/time_gap", False, True, "reaction_delay"),
            )
        ),
        # classes are those of the catalogue; effects without a class share none
        (truth("inertia"), report("reaction_delay"), {"class_right": True}),
        (truth("speed_zone"), report("speed_period"), {"class_right": False}),
        # unconfirmed effects are hypotheses
        (
            truth("relative_speed"),
            hypothesis("relative_speed"),
            INEXACT | {"right": False, "named": "", "hypotheses": "relative_speed"},
        ),
        (truth("relative_speed"), hypothesis("speed_zone"), {"false_name": False}),
        (NOTHING, hypothesis("speed_zone"), {"right": True, "hypothesis": True}),
        (
            truth("relative_speed"),
            report("relative_speed", "speed_zone"),
            INEXACT | {"false_names": "speed_zone", "false_name": True},
        ),
        # pairs match one to one: an exact name is not matched with another of its class
        (PAIR, report("time_gap"), INEXACT),
        (PAIR, report("time_gap", "asymmetric_response"), {"exact": False, "class_right": True}),
        (PAIR, report("time_gap", "relative_speed"), {"exact": True}),
        # heterogeneous people may be reported if they are heterogeneous
        (NOTHING, report(**NONE), {"right": True}),
        (NOTHING, report("walker_heterogeneity"), {"right": False}),
        (DIFFERENT, report("walker_heterogeneity"), {"right": True}),
        (DIFFERENT, report("walker_heterogeneity", "inertia"), {"right": False}),
        # effects outside of the catalogue are unknown; every name is false
        (OUTSIDE, report(**UNKNOWN), {"right": True}),
        *(
            (
                OUTSIDE,
                report("speed_zone", **verdict),
                {"right": False, "false_names": "speed_zone", "exact": None, "unknown": False},
            )
            for verdict in ({}, EQUALS, UNKNOWN)
        ),
        # without excitation an effect is not testable
        (STILL, report(**NONE), {"right": False}),
        (STILL, report(**NONE, not_testable=["inertia"]), {"right": True}),
        (STILL, report("inertia", not_testable=["inertia"]), {"right": False}),
        (STILL, report("time_gap", not_testable=["inertia"]), {"right": False}),
        # a fault that is reported in a sequence without faults
        (
            NOTHING,
            report(**NONE, data_faults=[FAULT]),
            {"located": None, "blamed": True, "right": False},
        ),
        # screening p-value and clusters
        *(
            (
                DIFFERENT,
                report(
                    **NONE,
                    screen={"p_value": p_value, "effect": effect},
                    clusters={"exploration": 15, "confirmation": 5},
                ),
                {"screen_p": p_value, "screen_false": false, "clusters": 15},
            )
            for p_value, effect, false in (
                (0.04, "inertia", True),
                (0.06, "inertia", False),
                (0.04, "walker_heterogeneity", False),
                (None, None, None),
            )
        ),
        # errors on confirmation sequences
        *(
            (
                truth("relative_speed"),
                report("relative_speed", gap={"before": 10.0, "after": after, "closed": 0.5}),
                {"closed": 0.5, "worse": worse},
            )
            for after, worse in ((6.0, False), (10.1, True))
        ),
    ],
)
def test_scores_of_reports(
    hidden: dict[str, Any], result: dict[str, Any], row: dict[str, Any]
) -> None:
    scored = scoring.score(hidden, result, CLASSES)
    assert {name: scored[name] for name in row} == row


def test_effects_without_classes_match_by_name() -> None:
    row = scoring.score(truth("inertia"), report("reaction_delay"), {})
    assert not row["class_right"]


@pytest.mark.parametrize(
    ("result", "located", "blamed"),
    [
        ({"sequence": "s001", "agents": ["s001v2"], "time": 10.9}, True, False),
        ({"sequence": "other/s001", "agents": [3], "time": 9.2}, True, False),
        ({"sequence": "s001", "agents": ["s001v2"], "time": 11.1}, False, False),
        ({"sequence": "s001", "agents": ["s001v5"], "time": 10.0}, False, False),
        ({"sequence": "s001", "agents": ["s001v2"], "time": None}, False, False),
        ({"sequence": "s002", "agents": ["s002v2"], "time": 10.0}, False, True),
    ],
)
def test_faults_are_located_by_sequence_agent_and_time(
    result: dict[str, Any], located: bool, blamed: bool
) -> None:
    hidden = truth(arm="fault", data_faults=[FAULT])
    row = scoring.score(hidden, report(**NONE, data_faults=[result]), {})
    assert (row["located"], row["blamed"], row["right"]) == (located, blamed, located)
    elsewhere = FAULT | {"sequence": "trajectories/s003"}
    row = scoring.score(hidden, report(**NONE, data_faults=[result, elsewhere, FAULT]), {})
    assert (row["located"], row["blamed"], row["right"]) == (True, True, False)


def test_coefficient_errors_are_relative_to_no_effect() -> None:
    hidden, result = truth("speed_zone"), report("speed_zone")
    result["effects"][0]["coefficients"] = {
        "alpha": {"value": 0.84, "low": 0.79, "high": 0.89},
        "a": {"value": 320.0, "low": 310.0, "high": 330.0},
        "b": {"value": 520.0, "low": 480.0, "high": 560.0},
    }
    alpha, a, b = scoring.coefficient_rows(hidden["effects"], result["effects"])
    assert (alpha["relative"], alpha["of_size"]) == pytest.approx((0.05, 0.2))
    assert [r["covered"] for r in (alpha, a, b)] == [True, False, True]
    assert (a["relative"], a["absolute"]) == (None, 20.0)
    assert scoring.score(hidden, result, {})["overlap"] == pytest.approx(180 / 220)
    result["effects"][0]["coefficients"]["a"]["value"] = 510.0
    assert scoring.score(hidden, result, {})["overlap"] == 0.0
