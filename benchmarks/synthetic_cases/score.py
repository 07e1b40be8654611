"""Scores of a diagnosis: its report against the truth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import numpy as np

#: Verdicts; ``error``: the diagnosis failed.
NAMED, NONE, EQUALS, UNKNOWN, ERROR = "named", "none", "indistinguishable", "unknown", "error"
#: Error probability of each test of a diagnosis.
LEVEL = 0.05
#: Edges of an interval on the road or in time; their error shows in the overlap.
EDGES = {"speed_zone": ("a", "b"), "speed_period": ("a", "b")}
#: Coordinates, of which a relative error means nothing.
PLACES = {"obstacle": ("x_o", "y_o"), "attraction": ("x_o", "y_o"), **EDGES}
#: Values without effect, where these are not 0.
NEUTRAL = {"alpha": 1.0, "phi": 1.0, "lambda_": 1.0}
#: A fault is located within this time, s.
NEAR = 1.0

Content = dict[str, Any]
#: What a report lacks that names nothing.
EMPTY: Content = {
    "effects": [],
    "hypotheses": [],
    "gap": None,
    "screen": {"p_value": None},
    "clusters": {"exploration": None},
    "data_faults": [],
    "not_testable": [],
}


def judged(
    report: Content,
    hidden: Collection[str],
    allowed: Collection[str] = (),
    classes: Mapping[str, str] | None = None,
) -> Content:
    """The verdict of a report, and whether its names are right.

    Args:
        report: content of ``report.json``.
        hidden: effects that should all be named.
        allowed: effects that may be named as well.
        classes: effect to its class of effects that data often cannot distinguish; empty: none.

    Returns:
        * ``verdict``, ``named``, ``hypotheses``, and ``hypothesis``: there is one;
        * ``exact``: the names are the hidden effects, beside allowed ones, and the verdict is
          ``named``, or ``none`` where nothing is hidden;
        * ``among_equals``: the verdict is ``indistinguishable``, and the hidden effects are those
          that are listed, or among their equals;
        * ``class_right``: under these verdicts, names and hidden effects match one to one within
          their classes, or as equals;
        * ``false_names``: names that are neither hidden nor allowed, nor have such an effect among
          their equals; ``false_name``: there is one;
        * ``missing``: hidden effects that are neither named nor among the equals of a name;
        * ``unknown``: the verdict is ``unknown``, and nothing is named.
    """
    classes = classes or {}
    verdict, true = report["verdict"], {*hidden, *allowed}
    equals = {item["name"]: {o["name"] for o in item["alternatives"]} for item in report["effects"]}
    counted = [name for name in equals if name not in allowed or name in hidden]
    false = [name for name in equals if name not in true and not true & equals[name]]
    listed = set(equals).union(*equals.values())

    def same_class(name: str, other: str) -> bool:
        return other in equals[name] or classes.get(name, "") == classes.get(other) != ""

    return {
        "verdict": verdict,
        "named": "+".join(equals),
        "hypotheses": "+".join(item["name"] for item in report["hypotheses"]),
        "hypothesis": bool(report["hypotheses"]),
        "exact": verdict == (NAMED if hidden else NONE) and set(counted) == set(hidden),
        "among_equals": verdict == EQUALS
        and _matched(hidden, counted, lambda name, other: other in equals[name]),
        "class_right": verdict in (NAMED, EQUALS) and _matched(hidden, counted, same_class),
        "false_names": "+".join(false),
        "false_name": bool(false),
        "missing": "+".join(name for name in hidden if name not in listed),
        "unknown": verdict == UNKNOWN and not equals,
    }


def _matched(
    hidden: Collection[str], names: Collection[str], alike: Callable[[str, str], bool]
) -> bool:
    """Whether hidden and named effects match one to one, by name or as ``alike`` says."""
    # exact names first: others must not use them up
    missing = [name for name in hidden if name not in names]
    for name in set(names) - set(hidden):
        match = next((other for other in missing if alike(name, other)), None)
        if match is None:
            return False
        missing.remove(match)
    return not missing


def score(truth: Content, report: Content, classes: Mapping[str, str]) -> Content:
    """The row of a synthetic case, in plain JSON.

    Args:
        truth: content of ``truth.json``.
        report: content of the diagnosis's ``report.json``; it may lack what :data:`EMPTY` has.
        classes: as in :func:`judged`.

    Returns:
        The case (``domain``, ``arm``, ``hidden``, ...), the columns of :func:`judged`, and:

        * ``right``: the right answer of the arm was given. ``exact``, ``among_equals`` and
          ``class_right`` are None where the catalogue does not have what is hidden, or these data
          cannot show it;
        * ``located``: all faults of the data are located; ``blamed``: a sequence without a fault
          is reported;
        * ``overlap``: of the estimated with the true interval of a zone or period;
        * ``before`` and ``after``: errors on confirmation sequences, m²; ``worse``: they
          increased; ``closed``: the share above measurement noise that was removed; ``reached``:
          the share that the truth removes, in simulations of the generator;
        * ``screen_p``; ``screen_false``: an effect that is neither hidden nor a nuisance is
          significant at :data:`LEVEL` in the first screen; None without a p-value;
        * ``clusters``: number of exploration clusters.
    """
    report, case = {**EMPTY, **report}, truth["case"]
    hidden, nuisance = ([e["name"] for e in truth[k]] for k in ("effects", "nuisance"))
    to_name = hidden if case["arm"] in ("single", "pair", "near_miss") else []
    row = judged(report, to_name, nuisance, classes)
    if not to_name:
        row |= dict.fromkeys(("exact", "among_equals", "class_right", "missing"))
    faults = located_faults(truth["data_faults"], report["data_faults"])
    screen, gap = report["screen"], report["gap"]
    significant = screen["p_value"] is not None and screen["p_value"] <= LEVEL
    if case["arm"] == "outside":
        right = row["unknown"]
    elif to_name:
        right = row["exact"]
    elif case["arm"] == "no_excitation":
        right = not row["false_name"] and set(hidden) <= set(report["not_testable"])
    else:
        right = not row["false_name"] and not faults["blamed"] and faults["located"] is not False
    return {
        **{name: case[name] for name in ("domain", "arm", "variant", "strength", "noise")},
        **{name: case[name] for name in ("n_sequences", "seed")},
        "hidden": "+".join(case["effects"]),
        "reached": truth["strength"]["reached"],
        "right": right,
        **row,
        **faults,
        "overlap": overlap(truth["effects"], report["effects"]),
        "before": gap and gap["before"],
        "after": gap and gap["after"],
        # a model to which nothing was added is as good as before, up to rounding
        "worse": gap and gap["after"] > gap["before"] * (1 + 1e-9),
        "closed": gap and gap["closed"],
        "screen_p": screen["p_value"],
        "screen_false": None
        if screen["p_value"] is None
        else significant and screen["effect"] not in {*to_name, *nuisance},
        "clusters": report["clusters"]["exploration"],
    }


def tail(name: str) -> str:
    """A sequence's name without its recording."""
    return name.rsplit("/", 1)[-1]


def _coefficients(
    hidden: list[Content], named: list[Content]
) -> Iterable[tuple[str, dict[str, float], Content]]:
    """Effects that are hidden and named, with true values and estimates."""
    estimates = {item["name"]: item["coefficients"] for item in named}
    for effect in hidden:
        if effect["name"] in estimates:
            true = {key: value["value"] for key, value in effect["coefficients"].items()}
            yield effect["name"], true, estimates[effect["name"]]


def coefficient_rows(hidden: list[Content], named: list[Content]) -> list[Content]:
    """One row per coefficient of each hidden effect that was named.

    ``relative`` is the error relative to the true value, ``of_size`` relative to its distance from
    the value without effect, ``absolute`` in the coefficient's unit; ``covered``: the interval
    holds the true value. Both relative errors are None for places and edges.
    """
    rows = []
    for name, values, estimates in _coefficients(hidden, named):
        for key in (key for key in values if key in estimates):
            true, estimate = values[key], estimates[key]
            error = abs(estimate["value"] - true)
            sizes = {"relative": abs(true), "of_size": abs(true - NEUTRAL.get(key, 0.0))}
            place = key in PLACES.get(name, ())
            rows.append(
                {
                    "effect": name,
                    "coefficient": key,
                    "true": true,
                    "value": estimate["value"],
                    "low": estimate["low"],
                    "high": estimate["high"],
                    "absolute": error,
                    **{k: error / s if s > 0 and not place else None for k, s in sizes.items()},
                    "covered": covers(estimate["low"], estimate["high"], true),
                }
            )
    return rows


def covers(low: float | None, high: float | None, value: float) -> bool | None:
    """Whether an interval contains a value; None without an interval."""
    ends = np.array([low, high], dtype=float)
    return bool(ends[0] <= value <= ends[1]) if np.isfinite(ends).all() else None


def overlap(hidden: list[Content], named: list[Content]) -> float | None:
    """Intersection over union of a true and an estimated zone or period; the worst of several.

    None where none is hidden, or none of those was named with its edges.
    """
    found = []
    for name, true, estimates in _coefficients(hidden, named):
        edges = EDGES.get(name, ())
        if edges and set(edges) <= set(estimates):
            (a, b), (c, d) = [true[k] for k in edges], [estimates[k]["value"] for k in edges]
            shared = max(0.0, min(b, d) - max(a, c))
            found.append(shared / max(max(b, d) - min(a, c), 1e-12))
    return min(found) if found else None


def located_faults(hidden: list[Content], reported: list[Content]) -> Content:
    """Whether all hidden faults were located (None without one), and a sound sequence blamed.

    Located: the sequence, at least one of the agents, and the time to within 1 s. Agents may be
    given by name or by their number in the sequence.
    """

    def located(fault: Content, item: Content) -> bool:
        who = {str(agent) for agent in (*fault["agents"], *fault["places"])}
        return (
            tail(item["sequence"]) == tail(fault["sequence"])
            and bool(who & set(map(str, item["agents"])))
            and item["time"] is not None
            and abs(item["time"] - fault["time"]) <= NEAR
        )

    wrong = {tail(f["sequence"]) for f in reported} - {tail(f["sequence"]) for f in hidden}
    every = all(any(located(fault, item) for item in reported) for fault in hidden)
    return {"located": every if hidden else None, "blamed": bool(wrong)}
