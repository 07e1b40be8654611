"""Tables of the benchmark of the diagnosis, from one row per case."""

from __future__ import annotations

from typing import Any

import pandas as pd
from scipy.stats import binomtest

from benchmarks.discovery.criteria import OTHER, headline
from benchmarks.synthetic_cases.score import UNKNOWN


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


def interval(right: pd.Series) -> str:
    """Interval of 95 % of a share, after Clopper and Pearson (1934), in percent."""
    limits = binomtest(int(right.sum()), len(right)).proportion_ci()
    return f"{100 * limits.low:.0f}–{100 * limits.high:.0f}"


def by_arm(frame: pd.DataFrame) -> pd.DataFrame:
    """Cases and shares by domain, arm, variant and strength, in percent."""
    found = []
    for key, part in frame.groupby(["domain", "arm", "variant", "strength"], sort=False):
        found.append(
            {
                **dict(zip(("domain", "arm", "variant", "strength"), key, strict=True)),
                "cases": len(part),
                "right": 100 * part["right"].mean(),
                "95 %": interval(part["right"]),
                "any false name": 100 * (part["false_names"] != "").mean(),
                "hypotheses": 100 * (part["leads"] != "").mean(),
                "unknown": 100 * part["unknown"].mean(),
                "false faults": 100 * (part["faults_false"] > 0).mean(),
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
                "among equals": 100 * part["among_equals"].astype(float).mean(),
                "right class": 100 * part["class_right"].astype(float).mean(),
                "hypothesis, exact": 100 * part["lead_exact"].astype(float).mean(),
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

    Nothing hidden is a row as well; verdicts of unknown and unconfirmed without a name are columns.
    """
    part = headline(frame[frame["domain"] == domain])
    part = part[part["arm"].isin(["single", "nothing", "outside"]) & ~part["strength"].isin(OTHER)]
    first = part["named"].str.split("+").str[0]
    first = first.where((first != "nothing") | ~(part["verdict"] != UNKNOWN), part["verdict"])
    hidden = part["hidden"].where(part["arm"] != "outside", "(" + part["hidden"] + ")")
    table = pd.crosstab(hidden, first, normalize="index")
    rows = list(dict.fromkeys(hidden))
    columns = [name for name in rows if name in table.columns]
    columns += [name for name in table.columns if name not in columns]
    return table.loc[rows, columns]


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
