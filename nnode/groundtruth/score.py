"""How good a diagnosis is: its report against the sealed truth."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from nnode.groundtruth.measure import Measures, closure, coefficient_rows, located_faults, overlap

#: Effects that data often cannot tell apart: naming one for another is the right class.
KIN: tuple[frozenset[str], ...] = (
    frozenset({"reaction_delay", "inertia"}),
    frozenset({"relative_speed", "asymmetric_response", "time_gap"}),
    frozenset({"speed_zone", "speed_period"}),
    frozenset({"vehicle_class", "driver_heterogeneity", "leader_length"}),
    frozenset({"pair_repulsion", "field_of_view", "anticipation"}),
    frozenset({"side_preference", "evasive_rotation"}),
    frozenset({"alignment", "sliding_friction"}),
    frozenset({"obstacle", "attraction"}),
    frozenset({"preferred_speed", "density_slowdown"}),
)


def kin(one: str, other: str) -> bool:
    """Whether two effects are the same or of one class."""
    return one == other or any(one in group and other in group for group in KIN)


def score(truth: dict[str, Any], report: dict[str, Any]) -> dict[str, Any]:
    """One row of the benchmark, in plain JSON.

    Args:
        truth: content of ``truth.json``.
        report: content of the diagnosis's ``report.json``.

    Returns:
        What was asked (``domain``, ``arm``, ``hidden``, ...), what was said (``verdict``,
        ``named``), and:

        * ``exact``: exactly the hidden effects were named; None where the catalogue has none of
          what is hidden, or where these data cannot show it;
        * ``class_right``: each hidden effect was named, or one of its class, or it was named as
          an alternative, and nothing else was named;
        * ``false_names``: effects named that are neither hidden nor, where people or drivers
          differ, heterogeneity;
        * ``confidently_wrong``: such a name under the verdict ``named``;
        * ``right``: what the arm asks for;
        * ``faults_hidden``, ``faults_located``, ``faults_false``;
        * ``coefficients``: rows of effect, name, true and estimated value, interval, errors;
        * ``overlap``: of the estimated with the true interval of a zone or period;
        * ``closure``: share of what the truth closes of the sealed gap; ``worse``: whether the
          cost on the sealed sequences rose.
    """
    case = truth["case"]
    hidden = [item["name"] for item in truth["effects"]]
    nuisance = {item["name"] for item in truth["nuisance"]}
    named = [item["name"] for item in report.get("effects", [])]
    alternatives = {
        item["name"]: set(_names(item.get("alternatives", ()))) for item in report["effects"]
    }
    asked = hidden if case["arm"] in ("single", "pair", "near_miss") else []
    false = [name for name in named if name not in asked and name not in nuisance]
    faults = located_faults(truth["data_faults"], report.get("data_faults", []))
    verdict = str(report["verdict"])
    row: dict[str, Any] = {
        "key": truth["key"],
        **{name: case[name] for name in ("domain", "arm", "variant", "strength", "noise")},
        **{name: case[name] for name in ("n_sequences", "seed")},
        "hidden": "+".join(case["effects"]) or "nothing",
        "reached": truth["strength"]["reached"],
        "verdict": verdict,
        "named": "+".join(named) or "nothing",
        "exact": sorted(n for n in named if n not in nuisance or n in asked) == sorted(asked)
        if asked
        else None,
        "class_right": _class_right(asked, named, alternatives, nuisance) if asked else None,
        "found": sum(name in named for name in asked),
        "false_names": false,
        "confidently_wrong": bool(false) and verdict == "named",
        "unknown": verdict == "unknown",
        **faults,
        "coefficients": coefficient_rows(truth["effects"], report["effects"]),
        "overlap": overlap(truth["effects"], report["effects"]),
        **_gap(truth, report),
    }
    row["right"] = _right(case, row, hidden, named, report)
    return row


def _names(items: Iterable[Any]) -> list[str]:
    """Names of effects, given as they are or as objects with a name."""
    return [str(item["name"]) if isinstance(item, dict) else str(item) for item in items]


def _class_right(
    asked: list[str], named: list[str], alternatives: dict[str, set[str]], nuisance: set[str]
) -> bool:
    """Whether hidden and named effects can be matched one to one within their classes."""
    left = list(asked)
    # exact names first: they must not be used up by their kin
    for fits in (str.__eq__, lambda name, truth: kin(name, truth) or truth in alternatives[name]):
        for name in list(named):
            match = next((truth for truth in left if fits(name, truth)), None)
            if match is not None:
                left.remove(match)
                named = [other for other in named if other != name]
    return not left and not set(named) - nuisance


def _right(
    case: dict[str, Any],
    row: dict[str, Any],
    hidden: list[str],
    named: list[str],
    report: dict[str, Any],
) -> bool:
    """What the arm asks for."""
    arm = case["arm"]
    if arm == "outside":
        return bool(row["unknown"])
    if arm == "no_excitation":
        known = set(_names(report.get("not_testable", ())))
        return all(name in known for name in hidden) and not set(named) & set(hidden)
    if arm == "fault":
        return bool(row["faults_located"] == row["faults_hidden"])
    if row["exact"] is None:
        return not row["false_names"]
    return bool(row["exact"])


def _gap(truth: dict[str, Any], report: dict[str, Any]) -> Measures:
    gap = report.get("gap") or {}
    before, after = gap.get("before"), gap.get("after")
    if before is None or after is None:
        return {"before": before, "after": after, "worse": None, "closure": None}
    return {
        "before": before,
        "after": after,
        # a model to which nothing was added is as good as before, to rounding
        "worse": bool(after > before * (1 + 1e-9)),
        "closure": closure(truth, report),
    }
