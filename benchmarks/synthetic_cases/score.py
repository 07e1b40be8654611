"""How good a diagnosis is: its report against the sealed truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from benchmarks.synthetic_cases.measure import (
    Measures,
    closure,
    coefficient_rows,
    located_faults,
    overlap,
)

#: Verdicts; under every other one the effects of a report are names.
NAMED, EQUALS, UNKNOWN = "named", "indistinguishable", "unknown"
#: Error probability that each gate of a diagnosis states.
LEVEL = 0.05


def score(
    truth: dict[str, Any], report: dict[str, Any], classes: Mapping[str, str]
) -> dict[str, Any]:
    """One row of the benchmark, in plain JSON.

    Args:
        truth: content of ``truth.json``.
        report: content of the diagnosis's ``report.json``.
        classes: effect to the class of those that data often cannot tell from it, as the
            catalogue that was searched states them; empty, or left out: of none.

    Returns:
        What was asked (``domain``, ``arm``, ``hidden``, ...), what was said (``verdict``,
        ``named``; ``leads`` were found and not confirmed, which are no names), and:

        * ``exact``: the verdict is ``named``, and the names are exactly the hidden effects, beside
          the nuisance where the arm has one; None where the catalogue has none of what is hidden,
          or where these data cannot show it;
        * ``among_equals``: the verdict is ``indistinguishable``, and the hidden effects are those
          that are listed, or among their equals; None as above;
        * ``lead_exact``: the same as ``exact`` for the leads, if nothing is named;
        * ``class_right``: under these two verdicts, names and hidden effects match one to one
          within their classes, or as equals;
        * ``found``: so many of the hidden effects are named;
        * ``false_names``: names that are neither hidden nor a nuisance of the arm; one of equals
          is not where a hidden effect is listed beside it;
        * ``unknown``: the verdict is ``unknown``, and nothing is named;
        * ``right``: what the arm asks for;
        * ``faults_hidden``, ``faults_located``, ``faults_false``;
        * ``coefficients``: rows of effect, name, true and estimated value, interval, errors;
        * ``overlap``: of the estimated with the true interval of a zone or period;
        * ``closure``: share of what the truth closes of the sealed gap; ``worse``: whether the
          cost on the sealed sequences rose by what was named;
        * ``screen_p``, ``screen_effect``, ``screen_false`` (:data:`LEVEL` was passed by an effect
          that is neither hidden nor a nuisance; None without a p-value), ``floor``;
          ``clusters_open``, ``clusters_sealed``; ``confirmed``, ``confirmation_p``.
    """
    case, verdict = truth["case"], str(report["verdict"])
    hidden = [item["name"] for item in truth["effects"]]
    nuisance = {item["name"] for item in truth["nuisance"]}
    named = report.get("effects", [])
    names, leads = ([item["name"] for item in found] for found in (named, report.get("leads", [])))
    equals = {item["name"]: set(_names(item.get("alternatives", ()))) for item in named}
    asked = hidden if case["arm"] in ("single", "pair", "near_miss") else []
    false = [
        name
        for name in names
        if name not in {*asked, *nuisance}
        and not (verdict == EQUALS and equals[name] & {*asked, *nuisance})
    ]

    def exactly(found: list[str]) -> bool:
        return sorted(n for n in found if n not in nuisance or n in asked) == sorted(asked)

    def matched(alike: Any) -> bool:
        return _matched(asked, [n for n in names if n not in nuisance or n in asked], alike)

    def akin(name: str, other: str) -> bool:
        return bool(classes.get(name)) and classes[name] == classes.get(other)

    measured: dict[str, bool | None] = {
        "exact": verdict == NAMED and exactly(names),
        "among_equals": verdict == EQUALS and matched(lambda n, t: t in equals[n]),
        "lead_exact": not names and exactly(leads),
        "class_right": verdict in (NAMED, EQUALS)
        and matched(lambda n, t: t in equals[n] or akin(n, t)),
    }
    row: dict[str, Any] = {
        "key": truth["key"],
        **{name: case[name] for name in ("domain", "arm", "variant", "strength", "noise")},
        **{name: case[name] for name in ("n_sequences", "seed")},
        "hidden": "+".join(case["effects"]) or "nothing",
        "reached": truth["strength"]["reached"],
        "verdict": verdict,
        "named": "+".join(names) or "nothing",
        "leads": "+".join(leads),
        **(measured if asked else dict.fromkeys(measured)),
        "found": sum(name in names for name in asked),
        "false_names": false,
        "unknown": verdict == UNKNOWN and not names,
        **located_faults(truth["data_faults"], report.get("data_faults", [])),
        "coefficients": coefficient_rows(truth["effects"], named),
        "overlap": overlap(truth["effects"], named),
        **_gap(truth, report),
        **_level(report, {*asked, *nuisance}),
    }
    row["right"] = _right(case["arm"], row, hidden, set(_names(report.get("not_testable", ()))))
    return row


def _names(items: Iterable[Any]) -> list[str]:
    """Names of effects, given as they are or as objects with a name."""
    return [str(item["name"]) if isinstance(item, dict) else str(item) for item in items]


def _matched(asked: list[str], names: list[str], alike: Any) -> bool:
    """Whether hidden and named effects match one to one, by name or as ``alike`` says."""
    left = list(asked)
    # exact names first: they must not be used up by others
    for fits in (str.__eq__, alike):
        for name in list(names):
            match = next((truth for truth in left if fits(name, truth)), None)
            if match is not None:
                left.remove(match)
                names = [other for other in names if other != name]
    return not left and not names


def _right(arm: str, row: dict[str, Any], hidden: list[str], not_testable: set[str]) -> bool:
    """What the arm asks for."""
    if arm == "outside":
        return bool(row["unknown"])
    if row["exact"] is not None:
        return bool(row["exact"])
    if row["false_names"]:
        return False
    if arm == "no_excitation":
        return set(hidden) <= not_testable
    return bool(row["faults_located"] == row["faults_hidden"] and not row["faults_false"])


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


def _level(report: dict[str, Any], true: set[str]) -> Measures:
    """What was tested, by how many clusters, and whether chance passed the first screen."""
    screen, clusters = report.get("screen") or {}, report.get("clusters") or {}
    confirmation = report.get("confirmation") or {}
    p_value, effect = screen.get("p_value"), screen.get("effect")
    return {
        "screen_p": p_value,
        "screen_effect": effect,
        "screen_false": None if p_value is None else bool(p_value <= LEVEL and effect not in true),
        "floor": screen.get("floor"),
        "clusters_open": clusters.get("open"),
        "clusters_sealed": clusters.get("sealed"),
        "confirmed": confirmation.get("confirmed"),
        "confirmation_p": confirmation.get("p_value"),
    }
