"""Tables of the benchmark of the diagnosis, from one row per case."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

#: What a diagnosis is asked for: label, column of the table of measures, bound, whether at least.
CRITERIA: tuple[tuple[str, str, float, bool], ...] = (
    ("one effect: exact name", "single_exact", 0.92, True),
    ("one effect: right class", "single_class", 0.97, True),
    ("one effect: least of all effects", "single_least", 0.80, True),
    ("two effects: both found", "pair_exact", 0.85, True),
    ("one weak effect: exact name", "weak_exact", 0.75, True),
    ("one weak effect: any wrong name", "weak_wrong", 0.10, False),
    ("nothing hidden: any effect named", "null_false", 0.05, False),
    ("outside the catalogue: unknown", "outside_unknown", 0.85, True),
    ("outside the catalogue: confidently wrong", "outside_wrong", 0.05, False),
    ("no excitation: not testable recognised", "no_excitation_right", 0.90, True),
    ("faults of the data: located", "fault_located", 0.95, True),
    ("coefficients: median relative error", "relative", 0.05, False),
    ("intervals of 95 %: cover", "covered", 0.90, True),
    ("zones and periods: median overlap", "overlap", 0.7, True),
    ("sealed gap closed: median of the truth's share", "closure", 0.95, True),
    ("sealed cost not above the base model's", "not_worse", 0.98, True),
)
#: In crowds coefficients are asked for less sharply.
_CROWD_RELATIVE = 0.10
#: Strengths that are not those of the headline: effects that hardly show, or hide all else.
_OTHER = ("weak", "strong")
#: Normal quantile of intervals of 95 %.
_Z = 1.96


def frame_of(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """One line per case; lists and rows of coefficients are left out."""
    plain = [{k: v for k, v in row.items() if not isinstance(v, list | dict)} for row in rows]
    frame = pd.DataFrame(plain)
    frame["false_names"] = ["+".join(row["false_names"]) for row in rows]
    return frame


def coefficients_of(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """One line per estimated coefficient of a hidden effect, with its case's key."""
    found = [
        {"key": row["key"], "domain": row["domain"], "arm": row["arm"], **item}
        for row in rows
        for item in row["coefficients"]
    ]
    columns = ["key", "domain", "arm", "effect", "coefficient", "true", "value", "low", "high"]
    columns += ["absolute", "relative", "of_size", "covered"]
    return pd.DataFrame(found, columns=columns)


def wilson(share: float, number: int) -> tuple[float, float]:
    """Interval of 95 % of a share, after Wilson (1927)."""
    if number == 0:
        return 0.0, 1.0
    middle = (share + _Z**2 / (2 * number)) / (1 + _Z**2 / number)
    half = _Z / (1 + _Z**2 / number)
    half *= float(np.sqrt(share * (1 - share) / number + _Z**2 / (4 * number**2)))
    return max(0.0, middle - half), min(1.0, middle + half)


def by_arm(frame: pd.DataFrame) -> pd.DataFrame:
    """Cases and shares by domain, arm, variant and strength, in percent."""
    found = []
    for key, part in frame.groupby(["domain", "arm", "variant", "strength"], sort=False):
        low, high = wilson(part["right"].mean(), len(part))
        found.append(
            {
                **dict(zip(("domain", "arm", "variant", "strength"), key, strict=True)),
                "cases": len(part),
                "right": 100 * part["right"].mean(),
                "95 %": f"{100 * low:.0f}–{100 * high:.0f}",
                "any false name": 100 * (part["false_names"] != "").mean(),
                "confidently wrong": 100 * part["confidently_wrong"].mean(),
                "unknown": 100 * part["unknown"].mean(),
                "failed": 100 * (part["failure"] != "").mean(),
            }
        )
    return pd.DataFrame(found)


def by_effect(frame: pd.DataFrame) -> pd.DataFrame:
    """Naming of each hidden effect or pair, in percent."""
    asked = frame[frame["exact"].notna()]
    found = []
    for key, part in asked.groupby(["domain", "arm", "strength", "hidden"], sort=False):
        found.append(
            {
                **dict(zip(("domain", "arm", "strength", "hidden"), key, strict=True)),
                "cases": len(part),
                "exact": 100 * part["exact"].astype(float).mean(),
                "right class": 100 * part["class_right"].astype(float).mean(),
                "any false name": 100 * (part["false_names"] != "").mean(),
                "unknown": 100 * part["unknown"].mean(),
                "nothing named": 100 * (part["named"] == "nothing").mean(),
                "closure (median)": part["closure"].astype(float).median(),
                "s (median)": part["seconds"].median(),
            }
        )
    return pd.DataFrame(found)


def by_coefficient(coefficients: pd.DataFrame) -> pd.DataFrame:
    """Errors and coverage of each coefficient, in percent."""
    found = []
    for key, part in coefficients.groupby(["domain", "effect", "coefficient"], sort=False):
        found.append(
            {
                **dict(zip(("domain", "effect", "coefficient"), key, strict=True)),
                "estimates": len(part),
                "relative error (median)": 100 * part["relative"].astype(float).median(),
                "of its size (median)": 100 * part["of_size"].astype(float).median(),
                "absolute (median)": part["absolute"].median(),
                "covered": 100 * part["covered"].astype(float).mean(),
            }
        )
    return pd.DataFrame(found)


def confusion(frame: pd.DataFrame, domain: str) -> pd.DataFrame:
    """Shares of what was named first (columns) where one effect was hidden (rows).

    Nothing hidden is a row as well; a verdict of unknown without a name is a column.
    """
    part = headline(frame[frame["domain"] == domain])
    part = part[part["arm"].isin(["single", "nothing", "outside"]) & ~part["strength"].isin(_OTHER)]
    first = part["named"].str.split("+").str[0]
    first = first.where(~((first == "nothing") & part["unknown"]), "unknown")
    hidden = part["hidden"].where(part["arm"] != "outside", "(" + part["hidden"] + ")")
    table = pd.crosstab(hidden, first, normalize="index")
    rows = list(dict.fromkeys(hidden))
    columns = [name for name in rows if name in table.columns]
    columns += [name for name in table.columns if name not in columns]
    return table.loc[rows, columns]


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
    frame = frame[~frame["strength"].isin(_OTHER)]
    asked = frame[frame["arm"].isin(["single", "pair"])]
    coefficients = coefficients[coefficients["key"].isin(asked["key"])]
    arm = dict(list(frame.groupby("arm")))
    empty = frame.iloc[:0]

    def share(values: pd.Series) -> tuple[float, int]:
        known = values.dropna().astype(float)
        return float(known.mean()), len(known)

    single, pair = arm.get("single", empty), arm.get("pair", empty)
    outside, fault = arm.get("outside", empty), arm.get("fault", empty)
    by_name = single.groupby("hidden")["exact"].apply(lambda part: part.astype(float).mean())
    hidden = float(fault["faults_hidden"].sum())
    relative = coefficients["relative"].dropna().astype(float)
    closure = asked["closure"].dropna().astype(float)
    overlap = asked["overlap"].dropna().astype(float)
    return {
        "single_exact": share(single["exact"]),
        "single_class": share(single["class_right"]),
        "single_least": (float(by_name.min()), len(single)),
        "pair_exact": share(pair["found"] == 2),
        "weak_exact": share(weak["exact"]),
        "weak_wrong": share(weak["false_names"] != ""),
        "null_false": share(arm.get("nothing", empty)["false_names"] != ""),
        "outside_unknown": share(outside["unknown"]),
        "outside_wrong": share(outside["confidently_wrong"]),
        "no_excitation_right": share(arm.get("no_excitation", empty)["right"]),
        "fault_located": (
            float(fault["faults_located"].sum()) / hidden if hidden else float("nan"),
            int(hidden),
        ),
        "relative": (float(relative.median()), len(relative)),
        "covered": share(coefficients["covered"]),
        "overlap": (float(overlap.median()), len(overlap)),
        "closure": (float(closure.median()), len(closure)),
        "not_worse": share(1.0 - frame["worse"].dropna().astype(float)),
    }


def criteria(frame: pd.DataFrame, coefficients: pd.DataFrame) -> pd.DataFrame:
    """What was asked for and what was reached, by domain; arms that were not run are left out."""
    found = []
    for domain, part in frame.groupby("domain", sort=False):
        values = measures(headline(part), coefficients)
        for label, name, bound, at_least in CRITERIA:
            if domain == "crowd" and name == "relative":
                bound = _CROWD_RELATIVE
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
    return pd.DataFrame(found)


def over_noise_and_size(frame: pd.DataFrame, domain: str) -> pd.DataFrame:
    """Share of exact names by measurement noise (rows) and number of sequences (columns)."""
    part = frame[(frame["domain"] == domain) & (frame["arm"] == "single")]
    part = part.assign(exact=part["exact"].astype(float))
    return part.pivot_table(index="noise", columns="n_sequences", values="exact", aggfunc="mean")


def by_method(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """The diagnosis beside its peers on the same cases, by domain; empty where there are none.

    Cases that hide heterogeneity are left out: it is not among the peers' columns.
    """
    lines = []
    for row in rows:
        if (
            not row["peers"]
            or "heterogeneity" in row["hidden"]
            or row["variant"] == "heterogeneous"
        ):
            continue
        for method, scored in {"diagnosis": row, **row["peers"]}.items():
            lines.append({"domain": row["domain"], "arm": row["arm"], "method": method, **scored})
    frame = pd.DataFrame(lines)
    if frame.empty:
        return frame
    found = []
    for (domain, method), part in frame.groupby(["domain", "method"], sort=False):
        asked, idle = part[part["exact"].notna()], part[part["arm"] == "nothing"]
        closure = asked["closure"].astype(float)
        found.append(
            {
                "domain": domain,
                "method": method,
                "cases": len(part),
                "exact": 100 * asked["exact"].astype(float).mean(),
                "right class": 100 * asked["class_right"].astype(float).mean(),
                "named where nothing is hidden": 100 * (idle["named"] != "nothing").mean(),
                "closure (median)": closure.median(),
                "worse than the base": 100 * asked["worse"].astype(float).mean(),
            }
        )
    return pd.DataFrame(found)
