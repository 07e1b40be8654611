"""What a diagnosis is asked for, and what it reached."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.discovery import level
from benchmarks.synthetic_cases.score import EQUALS

#: Label, name of the measure, bound, whether at least. A near miss is asked for what one effect
#: is; a list of equals is one of rivals that 5 % told apart, and holds the right one as often.
CRITERIA: tuple[tuple[str, str, float, bool], ...] = (
    ("one effect: exact name", "single_exact", 0.92, True),
    ("one effect: right class", "single_class", 0.97, True),
    ("one effect: least of all effects", "single_least", 0.80, True),
    ("two effects: both named, and nothing else", "pair_exact", 0.85, True),
    ("indistinguishable: the right one is listed", "among_equals", 0.95, True),
    ("one weak effect: exact name", "weak_exact", 0.75, True),
    ("one weak effect: any wrong name", "weak_wrong", 0.10, False),
    ("near misses: exact name", "near_exact", 0.92, True),
    ("near misses: any wrong name", "near_wrong", 0.05, False),
    ("outside the catalogue: unknown", "outside_unknown", 0.85, True),
    ("outside the catalogue: a wrong name", "outside_wrong", 0.05, False),
    ("no excitation: not testable recognised", "no_excitation_right", 0.90, True),
    ("faults of the data: located", "fault_located", 0.95, True),
    ("sound sequences: none is blamed", "not_blamed", 0.95, True),
    ("coefficients: median relative error", "relative", 0.05, False),
    ("intervals of 95 %: cover", "covered", 0.90, True),
    ("zones and periods: median overlap", "overlap", 0.7, True),
    ("sealed gap closed: median of the truth's share", "closure", 0.95, True),
    ("sealed cost not above the base model's", "not_worse", 0.98, True),
    ("fresh sequences' gap closed: median of the truth's share", "fresh_closure", 0.95, True),
    ("fresh sequences' cost not above the base model's", "fresh_not_worse", 0.98, True),
)
#: Strengths that are not those of the headline: effects that hardly show, or hide all else.
OTHER = ("weak", "strong")


def headline(frame: pd.DataFrame) -> pd.DataFrame:
    """The cases with the noise and the number of sequences that most have."""
    if frame.empty:
        return frame
    noise, number = frame[["noise", "n_sequences"]].value_counts().index[0]
    return frame[(frame["noise"] == noise) & (frame["n_sequences"] == number)]


def measures(frame: pd.DataFrame, coefficients: pd.DataFrame) -> dict[str, tuple[float, int]]:
    """The measures that :data:`CRITERIA` bounds, each with the number of cases behind it.

    Coefficients and closure are those of one or two effects of the catalogue as it has them, not
    of near misses.
    """
    weak = frame[(frame["arm"] == "single") & (frame["strength"] == "weak")]
    frame = frame[~frame["strength"].isin(OTHER)]
    asked = frame[frame["arm"].isin(["single", "pair"])]
    coefficients = coefficients[coefficients["key"].isin(asked["key"])]
    arm = dict(list(frame.groupby("arm")))
    empty = frame.iloc[:0]

    def share(values: pd.Series) -> tuple[float, int]:
        known = values.dropna().astype(float)
        return float(known.mean()), len(known)

    single, pair = arm.get("single", empty), arm.get("pair", empty)
    near = arm.get("near_miss", empty)
    outside, fault = arm.get("outside", empty), arm.get("fault", empty)
    by_name = single.groupby("hidden")["exact"].apply(lambda part: part.astype(float).mean())
    hidden = float(fault["faults_hidden"].sum())
    relative = coefficients["relative"].dropna().astype(float)
    closure = asked["closure"].dropna().astype(float)
    overlap = asked["overlap"].dropna().astype(float)
    later = asked.reindex(columns=["fresh_closure", "fresh_worse"]).astype(float)
    return {
        "single_exact": share(single["exact"]),
        "single_class": share(single["class_right"]),
        "single_least": (float(by_name.min()), len(single)),
        "pair_exact": share(pair["exact"]),
        "among_equals": share(asked.loc[asked["verdict"] == EQUALS, "among_equals"]),
        "weak_exact": share(weak["exact"]),
        "weak_wrong": share(weak["false_names"] != ""),
        "near_exact": share(near["exact"]),
        "near_wrong": share(near["false_names"] != ""),
        "outside_unknown": share(outside["unknown"]),
        "outside_wrong": share(outside["false_names"] != ""),
        "no_excitation_right": share(arm.get("no_excitation", empty)["right"]),
        "fault_located": (
            float(fault["faults_located"].sum()) / hidden if hidden else float("nan"),
            int(hidden),
        ),
        "not_blamed": share(frame["faults_false"] == 0),
        "relative": (float(relative.median()), len(relative)),
        "covered": share(coefficients["covered"]),
        "overlap": (float(overlap.median()), len(overlap)),
        "closure": (float(closure.median()), len(closure)),
        "not_worse": share(1.0 - frame["worse"].dropna().astype(float)),
        "fresh_closure": (
            float(later["fresh_closure"].median()),
            int(later["fresh_closure"].count()),
        ),
        "fresh_not_worse": share(1.0 - later["fresh_worse"].dropna()),
    }


def criteria(frame: pd.DataFrame, coefficients: pd.DataFrame) -> pd.DataFrame:
    """What was asked for and what was reached, by domain; arms that were not run are left out."""
    found: list[dict[str, Any]] = []
    for domain, part in frame.groupby("domain", sort=False):
        values = measures(headline(part), coefficients)
        for label, name, bound, at_least in CRITERIA:
            value, number = values[name]
            if number == 0 or np.isnan(value):
                continue
            found.append(
                {
                    "domain": domain,
                    "measure": label,
                    "asked for": f"{'≥' if at_least else '≤'} {bound:.2f}",
                    "reached": value,
                    "cases": number,
                    "met": bool(value >= bound if at_least else value <= bound),
                }
            )
        found += level.criteria(part)
    return pd.DataFrame(found)
