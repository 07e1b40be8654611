"""Measures of a diagnosis: errors of coefficients, overlaps, located faults, gaps closed."""

from __future__ import annotations

from typing import Any

Measures = dict[str, Any]

#: Edges of an interval on the road or in time; their error shows in the overlap.
EDGES = {"speed_zone": ("a", "b"), "speed_period": ("a", "b")}
#: Coordinates; a relative error means nothing for them.
PLACES = {"obstacle": ("x_o", "y_o"), "attraction": ("x_o", "y_o")}
#: Values that mean no effect, where these are not 0.
NEUTRAL = {"alpha": 1.0, "phi": 1.0, "lambda_": 1.0}
#: A fault is located within this time, s.
NEAR = 1.0
#: Where a truth removes less of the excess on the sealed sequences, shares of it mean nothing.
_LEAST_SHARE = 0.05


def tail(name: str) -> str:
    """A sequence's name without its recording."""
    return name.rsplit("/", 1)[-1]


def coefficient_rows(
    hidden: list[dict[str, Any]], named: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """One row per coefficient of each hidden effect that was named.

    ``relative`` is the error over the true value, ``of_size`` over its distance from the value
    that means no effect, ``absolute`` in the coefficient's unit; ``covered`` tells whether the
    interval holds the truth. Both shares are None for places and edges.
    """
    rows = []
    for effect in hidden:
        name = effect["name"]
        found = next((item for item in named if item["name"] == name), None)
        for key, true in effect["coefficients"].items():
            got = None if found is None else found["coefficients"].get(key)
            if got is None or got["value"] is None:
                continue
            value, low, high = got["value"], got.get("low"), got.get("high")
            place = key in (*EDGES.get(name, ()), *PLACES.get(name, ()))
            error = abs(value - true["value"])
            size = abs(true["value"] - NEUTRAL.get(key, 0.0))
            known = low is not None and high is not None
            rows.append(
                {
                    "effect": name,
                    "coefficient": key,
                    "true": true["value"],
                    "value": value,
                    "low": low,
                    "high": high,
                    "absolute": error,
                    "relative": None if place else _share(error, abs(true["value"])),
                    "of_size": None if place else _share(error, size),
                    "covered": low <= true["value"] <= high if known else None,
                }
            )
    return rows


def _share(error: float, of: float) -> float | None:
    return error / of if of > 0 else None


def overlap(hidden: list[dict[str, Any]], named: list[dict[str, Any]]) -> float | None:
    """Intersection over union of a true and an estimated zone or period; the worst of several.

    None where none is hidden, or none of those was named with its edges.
    """
    found = []
    for effect in hidden:
        name = effect["name"]
        got = next((item for item in named if item["name"] == name), None)
        if name not in EDGES or got is None:
            continue
        if not all(key in got["coefficients"] for key in EDGES[name]):
            continue
        a, b = (effect["coefficients"][key]["value"] for key in EDGES[name])
        c, d = (got["coefficients"][key]["value"] for key in EDGES[name])
        shared = max(0.0, min(b, d) - max(a, c))
        found.append(shared / max(max(b, d) - min(a, c), 1e-12))
    return min(found) if found else None


def located_faults(hidden: list[dict[str, Any]], reported: list[dict[str, Any]]) -> Measures:
    """How many hidden faults were located, and how many sequences were blamed without reason.

    Located: the sequence, at least one of the agents, and the time to within 1 s. Agents may be
    given by name or by their number in the sequence.
    """
    located = 0
    for fault in hidden:
        who = {*map(str, fault["agents"]), *map(str, fault["places"])}
        located += any(
            tail(item["sequence"]) == tail(fault["sequence"])
            and bool(who & set(map(str, item["agents"])))
            and item["time"] is not None
            and abs(item["time"] - fault["time"]) <= NEAR
            for item in reported
        )
    wrong = {tail(item["sequence"]) for item in reported}
    wrong -= {tail(item["sequence"]) for item in hidden}
    return {
        "faults_hidden": len(hidden),
        "faults_located": located,
        "faults_false": len(wrong),
    }


def closure(truth: dict[str, Any], report: dict[str, Any]) -> float | None:
    """What a diagnosis removes of the cost on the sealed sequences over what the truth removes.

    In traffic both are compared on the report's own scale. A crowd's costs depend on how the
    states are found in which people start: models are simulated again with the reported
    coefficients, or, where that cannot be, shares of each one's own excess are compared. None
    without an effect, or where the truth removes next to nothing on these sequences.
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
    gap = report["gap"]
    before, after, floor = gap["before"], gap["after"], gap.get("noise_floor") or 0.0
    if truth["case"]["domain"] == "traffic":
        return _of_possible(before, after, best, cost["floor"])
    # imported here: compiled code is loaded for crowds alone
    from benchmarks.synthetic_cases.crowd.closure import crowd_costs

    own = crowd_costs(truth, report, places)
    if own is not None:
        return _of_possible(*own, cost["floor"])
    possible = (base - best) / max(base - cost["floor"], 1e-300)
    if possible < _LEAST_SHARE or before <= floor:
        return None
    return float((before - after) / (before - floor) / possible)


def _of_possible(before: float, after: float, best: float, floor: float) -> float | None:
    """Share that is removed of what can be."""
    possible = before - best
    if possible <= max(_LEAST_SHARE * (before - floor), 0.0):
        return None
    return (before - after) / possible
