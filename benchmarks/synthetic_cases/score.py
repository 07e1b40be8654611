"""Scores of a diagnosis: its report against the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

#: Verdicts; under every other one the effects of a report are names. ``error``: the diagnosis
#: failed.
NAMED, EQUALS, UNKNOWN, ERROR = "named", "indistinguishable", "unknown", "error"
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
#: Closure is not defined where a truth removes a smaller part of the excess.
_LOWEST_SHARE = 0.05

Content = dict[str, Any]


def score(truth: Content, report: Content, classes: Mapping[str, str]) -> Content:
    """One row of the benchmark, in plain JSON.

    Args:
        truth: content of ``truth.json``.
        report: content of the diagnosis's ``report.json``.
        classes: effect to its class of effects that data often cannot distinguish; empty, or left
            out: it has none.

    Returns:
        The case (``domain``, ``arm``, ``hidden``, ...), the report (``verdict``, ``named``, and
        ``leads``, the hypotheses), and:

        * ``exact``: the verdict is ``named``, and the names are exactly the hidden effects, with or
          without the nuisance of the arm; None where the catalogue does not have what is hidden, or
          these data cannot show it;
        * ``among_equals``: the verdict is ``indistinguishable``, and the hidden effects are those
          that are listed, or among their equals; None as above;
        * ``class_right``: under these two verdicts, names and hidden effects match one to one
          within their classes, or as equals;
        * ``false_names``: names that are neither hidden nor a nuisance of the arm; under
          ``indistinguishable`` only those without a hidden effect among their equals;
        * ``unknown``: the verdict is ``unknown``, and nothing is named;
        * ``right``: the right answer of the arm was given;
        * ``faults_hidden``, ``faults_located``, ``faults_false``;
        * ``coefficients``: rows of effect, name, true and estimated value, interval, errors;
        * ``overlap``: of the estimated with the true interval of a zone or period;
        * ``closure``: part of the cost on confirmation sequences that the diagnosis removes,
          relative to the truth; ``worse``: whether this cost increased;
        * ``screen_p``; ``screen_false``: an effect that is neither hidden nor a nuisance is
          significant at :data:`LEVEL` in the first screen; None without a p-value;
        * ``clusters_open``: number of exploration clusters.
    """
    case, verdict = truth["case"], str(report["verdict"])
    hidden = [item["name"] for item in truth["effects"]]
    named = report.get("effects", [])
    names, leads = (_names(items) for items in (named, report.get("leads", ())))
    equals = {item["name"]: _names(item.get("alternatives", ())) for item in named}
    asked = hidden if case["arm"] in ("single", "pair", "near_miss") else []
    true = {*asked, *_names(truth["nuisance"])}
    false = [
        name
        for name in names
        if name not in true and not (verdict == EQUALS and true & set(equals[name]))
    ]

    def matched(alike: Callable[[str, str], bool]) -> bool:
        return _matched(asked, [n for n in names if n not in true or n in asked], alike)

    def akin(name: str, other: str) -> bool:
        return other in equals[name] or (
            bool(classes.get(name)) and classes[name] == classes.get(other)
        )

    measured: dict[str, bool | None] = {
        "exact": verdict == NAMED and matched(lambda n, t: False),
        "among_equals": verdict == EQUALS and matched(lambda n, t: t in equals[n]),
        "class_right": verdict in (NAMED, EQUALS) and matched(akin),
    }
    gap, screen = report.get("gap") or {}, report.get("screen") or {}
    p_value = screen.get("p_value")
    row: Content = {
        "key": truth["key"],
        **{name: case[name] for name in ("domain", "arm", "variant", "strength", "noise")},
        **{name: case[name] for name in ("n_sequences", "seed")},
        "hidden": "+".join(case["effects"]) or "nothing",
        "reached": truth["strength"]["reached"],
        "verdict": verdict,
        "named": "+".join(names) or "nothing",
        "leads": "+".join(leads),
        **(measured if asked else dict.fromkeys(measured)),
        "false_names": false,
        "unknown": verdict == UNKNOWN and not names,
        **located_faults(truth["data_faults"], report.get("data_faults", [])),
        "coefficients": coefficient_rows(truth["effects"], named),
        "overlap": overlap(truth["effects"], named),
        "before": gap.get("before"),
        "after": gap.get("after"),
        # a model to which nothing was added is as good as before, up to rounding
        "worse": bool(gap["after"] > gap["before"] * (1 + 1e-9)) if gap else None,
        "closure": closure(truth, report) if gap else None,
        "screen_p": p_value,
        "screen_false": None
        if p_value is None
        else bool(p_value <= LEVEL and screen["effect"] not in true),
        "clusters_open": (report.get("clusters") or {}).get("open"),
    }
    if case["arm"] == "outside":
        right = row["unknown"]
    elif asked:
        right = row["exact"]
    elif case["arm"] == "no_excitation":
        right = not false and set(hidden) <= set(_names(report.get("not_testable", ())))
    else:
        right = not false and not row["faults_false"]
        right = right and row["faults_located"] == row["faults_hidden"]
    return {**row, "right": bool(right)}


def _names(items: Iterable[Any]) -> list[str]:
    """Names of effects, given as they are or as objects with a name."""
    return [str(item["name"]) if isinstance(item, dict) else str(item) for item in items]


def _matched(asked: list[str], names: list[str], alike: Callable[[str, str], bool]) -> bool:
    """Whether hidden and named effects match one to one, by name or as ``alike`` says."""
    left = list(asked)
    # exact names first: others must not use them up
    for fits in (str.__eq__, alike):
        for name in list(names):
            match = next((truth for truth in left if fits(name, truth)), None)
            if match is not None:
                left.remove(match)
                names = [other for other in names if other != name]
    return not left and not names


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
        for key, true in values.items():
            estimate = estimates.get(key) or {}
            value, low, high = (estimate.get(k) for k in ("value", "low", "high"))
            if value is None:
                continue
            error = abs(value - true)
            sizes = {"relative": abs(true), "of_size": abs(true - NEUTRAL.get(key, 0.0))}
            place = key in PLACES.get(name, ())
            rows.append(
                {
                    "effect": name,
                    "coefficient": key,
                    "true": true,
                    "value": value,
                    "low": low,
                    "high": high,
                    "absolute": error,
                    **{k: error / s if s > 0 and not place else None for k, s in sizes.items()},
                    "covered": None if low is None or high is None else low <= true <= high,
                }
            )
    return rows


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
    """How many hidden faults were located, and how many sequences were reported without a fault.

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
    return {
        "faults_hidden": len(hidden),
        "faults_located": sum(any(located(f, item) for item in reported) for f in hidden),
        "faults_false": len(wrong),
    }


def closure(truth: Content, report: Content) -> float | None:
    """The removed part of the cost on confirmation sequences, relative to that of the truth.

    In traffic both are compared on the report's own scale. A crowd's costs depend on the estimated
    initial states: models are simulated again with the reported coefficients, or, where this is
    impossible, shares of each one's own excess are compared. None without an effect, or where the
    truth removes next to nothing on these sequences.
    """
    sealed = {tail(name) for name in (report.get("split") or {}).get("sealed", ())}
    cost = truth["cost"]
    if cost is None or truth["case"]["arm"] == "no_excitation":
        return None
    places = [i for i, name in enumerate(cost["oracle"]) if tail(name) in sealed]
    if not places:
        return None
    base, best = (
        sum(list(cost[name].values())[i] for i in places) / len(places)
        for name in ("base", "oracle")
    )
    before, after = report["gap"]["before"], report["gap"]["after"]
    if truth["case"]["domain"] == "traffic":
        return _of_possible(before, after, best, cost["floor"])
    # imported here: compiled code is loaded for crowds alone
    from benchmarks.synthetic_cases.crowd.closure import crowd_costs

    costs = crowd_costs(truth, report, places)
    if costs is not None:
        return _of_possible(*costs, cost["floor"])
    possible = (base - best) / max(base - cost["floor"], 1e-300)
    excess = before - (report["gap"].get("noise_floor") or 0.0)
    if possible < _LOWEST_SHARE or excess <= 0:
        return None
    return float((before - after) / excess / possible)


def _of_possible(before: float, after: float, best: float, floor: float) -> float | None:
    """The removed part of what can be removed."""
    possible = before - best
    if possible <= max(_LOWEST_SHARE * (before - floor), 0.0):
        return None
    return (before - after) / possible
