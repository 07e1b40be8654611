"""Which law comes first, and what is named beside it, where the truth follows another law.

What is right was written down before anything was run. The law that is true comes first. A
diagnosis of the true law names nothing. One of another law may name what the true law has and the
other one lacks, :data:`RIGHT`; every other name is false.
"""

from __future__ import annotations

from typing import Any

from benchmarks.open_world.answers import diagnosed
from benchmarks.synthetic_cases.laws.case import LawCase, measured
from benchmarks.synthetic_cases.laws.motion import FIRST_ORDER, RANGES

#: Effects of a reaction to speeds ahead, and of speeds that do not change at once.
_REACTION = ("relative_speed", "asymmetric_response")
_LATE = ("inertia", "reaction_delay")
#: Names that are right: those in the linearisation of a law of second order about one of first
#: order (speed difference, lag, a gap that grows with the speed ahead, a highest speed), and those
#: between two laws of second order (how strongly, how evenly and how late speeds are answered).
RIGHT = {
    "first": {*_REACTION, *_LATE, "time_gap", "free_flow_speed"},
    "second": {*_REACTION, *_LATE},
}
#: Laws that a diagnosis is asked about, whichever is true.
ASKED = ("lin", "idm")


def allowed(true: str, diagnosed: str) -> set[str]:
    """Names that are right where one law is true and another one diagnosed."""
    if true == diagnosed:
        return set()
    # gaps of lin and log contain the length of the vehicle ahead
    length = {"leader_length"} if (true in FIRST_ORDER) != (diagnosed in FIRST_ORDER) else set()
    return length | RIGHT["first" if diagnosed in FIRST_ORDER else "second"]


def diagnosed_case(law: str, seed: int, asked: str, **size: Any) -> dict[str, Any]:
    """One world, diagnosed with one law; plain JSON.

    Returns:
        The law that came ``first``, by how much the true one is ``behind`` it, and of the law that
        was asked for and of the first one verdict, names, and names that are ``false``.
    """
    table, parameters = measured(LawCase(law, seed, **size))
    report, nearest, seconds = diagnosed(table, "traffic", seed, model=asked)
    ranking = (report["laws_again"] or report["laws"])["ranking"]
    own = next((one for one in ranking if one["name"] == law), None)
    first = ranking[0]["name"]
    row: dict[str, Any] = {
        "law": law,
        "seed": seed,
        "asked": asked,
        "parameters": parameters,
        "first": first,
        "behind": None if own is None else own["behind"],
        "p": None if own is None else own["p_value"],
        "seconds": seconds,
    }
    for who, what, one in (("asked", asked, report), ("nearest", first, nearest or report)):
        names = [effect["name"] for effect in one["effects"]]
        row[f"{who}_verdict"] = one["verdict"]
        row[f"{who}_names"] = names
        row[f"{who}_false"] = [name for name in names if name not in allowed(law, what)]
    return row


def cases(first_seed: int, number: int) -> list[dict[str, Any]]:
    """Arguments of :func:`diagnosed_case`: every law so many times, half of them asked as each."""
    return [
        {"law": law, "seed": first_seed + i, "asked": ASKED[i % len(ASKED)]}
        for law in RANGES
        for i in range(number)
    ]
