"""Tables of scores, from one row per case."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from benchmarks.synthetic_cases.score import EQUALS, ERROR, LEVEL, UNKNOWN

#: Label, arms, column, bound, and whether the bound is a lower one. Values are means of a column,
#: or medians of those in :data:`_MEDIANS`; weak effects are an arm here.
CRITERIA: tuple[tuple[str, str, str, float, bool], ...] = (
    ("one effect: exact name", "single", "exact", 0.92, True),
    ("one effect: right class", "single", "class_right", 0.97, True),
    ("two effects: both named, and nothing else", "pair", "exact", 0.85, True),
    ("indistinguishable: the right one is listed", "single pair", "listed", 0.95, True),
    ("one weak effect: exact name", "weak", "exact", 0.75, True),
    ("one weak effect: any wrong name", "weak", "wrong", 0.10, False),
    ("near misses: exact name", "near_miss", "exact", 0.92, True),
    ("near misses: any wrong name", "near_miss", "wrong", 0.05, False),
    ("outside the catalogue: unknown", "outside", "unknown", 0.85, True),
    ("outside the catalogue: a wrong name", "outside", "wrong", 0.05, False),
    ("no excitation: not testable recognised", "no_excitation", "right", 0.90, True),
    ("faults of the data: located", "fault", "located", 0.95, True),
    ("sequences without faults: blamed", "", "blamed", 0.05, False),
    ("coefficients: median relative error", "single pair", "relative", 0.05, False),
    ("intervals of 95 %: cover", "single pair", "covered", 0.90, True),
    ("zones and periods: median overlap", "single pair", "overlap", 0.7, True),
    ("closure on confirmation sequences, median", "single pair", "closure", 0.95, True),
    ("higher cost on confirmation sequences", "", "worse", 0.02, False),
    ("closure on further sequences, median", "single pair", "fresh_closure", 0.95, True),
    ("higher cost on further sequences", "single pair", "fresh_worse", 0.02, False),
)
_MEDIANS = ("relative", "overlap", "closure", "fresh_closure")
#: A test keeps its level where the one-sided test against it is not rejected at this probability.
REJECTED = 0.025


def share(which: pd.Series) -> str:
    """A proportion with its exact interval of 95 % (Clopper & Pearson 1934)."""
    number, of = int(which.sum()), len(which)
    if not of:
        return "–"
    low, high = binomtest(number, of).proportion_ci()
    return f"{number} of {of} ({100 * number / of:.0f} %, {100 * low:.0f}–{100 * high:.0f} %)"


def frame_of(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """One row per case without lists, with the columns that the tables need."""
    frame = pd.DataFrame(
        [{k: v for k, v in row.items() if not isinstance(v, list | dict)} for row in rows]
    )
    frame["false_names"] = ["+".join(row["false_names"]) for row in rows]
    named = frame["named"].str.split("+").str[0]
    return frame.assign(
        wrong=frame["false_names"] != "",
        hypothesis=frame["leads"] != "",
        blamed=frame["faults_false"] > 0,
        failed=frame["verdict"] == ERROR,
        nothing=frame["named"] == "nothing",
        listed=frame["among_equals"].where(frame["verdict"] == EQUALS),
        located=frame["faults_located"] / frame["faults_hidden"].where(frame["faults_hidden"] > 0),
        first=named.where((named != "nothing") | (frame["verdict"] == "none"), frame["verdict"]),
    )


def coefficients_of(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """One row per estimated coefficient of a hidden effect, with its case's columns."""
    kept = ("key", "domain", "arm", "strength", "noise", "n_sequences")
    found = [{**{k: row[k] for k in kept}, **item} for row in rows for item in row["coefficients"]]
    columns = [*kept, "effect", "coefficient", "true", "value", "low", "high"]
    return pd.DataFrame(found, columns=[*columns, "absolute", "relative", "of_size", "covered"])


def summary(
    frame: pd.DataFrame,
    by: list[str],
    shares: Mapping[str, str],
    medians: Mapping[str, str] = {},
) -> pd.DataFrame:
    """Numbers of cases by group, means of columns in percent, and medians of columns.

    Args:
        shares, medians: columns by the heading that the table gives them.
    """
    columns = [*shares.values(), *medians.values()]
    numbers = frame[columns].astype(float).groupby([frame[name] for name in by], sort=False)
    return pd.DataFrame(
        {
            "cases": numbers.size(),
            **{head: 100 * numbers[column].mean() for head, column in shares.items()},
            **{head: numbers[column].median() for head, column in medians.items()},
        }
    ).reset_index()


def headline(frame: pd.DataFrame) -> pd.DataFrame:
    """The cases with the most frequent noise and number of sequences; weak effects are an arm."""
    if frame.empty:
        return frame
    noise, number = frame[["noise", "n_sequences"]].value_counts().index[0]
    frame = frame[(frame["noise"] == noise) & (frame["n_sequences"] == number)]
    weak = (frame["arm"] == "single") & (frame["strength"] == "weak")
    shown = weak | ~frame["strength"].isin(["weak", "strong"])
    return frame.assign(arm=frame["arm"].mask(weak, "weak"))[shown]


def criteria(frame: pd.DataFrame, coefficients: pd.DataFrame) -> pd.DataFrame:
    """What is required and what was reached, by domain; arms that were not run are left out."""
    found: list[dict[str, Any]] = []

    def add(measure: str, cases: int, reached: float, bound: float, at_least: bool) -> None:
        found.append(
            {
                "domain": domain,
                "measure": measure,
                "required": f"{'≥' if at_least else '≤'} {bound:g}",
                "reached": reached,
                "cases": cases,
                "met": bool(reached >= bound if at_least else reached <= bound),
            }
        )

    for domain, part in frame.groupby("domain", sort=False):
        cases, numbers = headline(part), headline(coefficients[coefficients["domain"] == domain])
        for label, arms, column, bound, at_least in CRITERIA:
            source = numbers if column in numbers else cases
            if column in source:
                chosen = source[source["arm"].isin(arms.split())] if arms else source
                values = chosen[column].dropna().astype(float)
                value = values.median() if column in _MEDIANS else values.mean()
                if len(values):
                    add(label, len(values), float(value), bound, at_least)
        gates = level(part)
        if len(gates):
            gates = gates.loc[gates.groupby("variant", sort=False)["cases"].idxmax()]
        for row in gates.to_dict("records"):
            for gate, number in (("first screen", "screened"), ("final names", "cases")):
                if row[number]:
                    measure = f"nothing hidden, {row['variant']}: p of {gate} above 5 %"
                    add(measure, row[number], row[f"{gate}, p"], REJECTED, True)
    return pd.DataFrame(found)


def nothing_hidden(frame: pd.DataFrame) -> pd.DataFrame:
    """The cases with nothing hidden whose diagnosis ended."""
    return frame[(frame["arm"] == "nothing") & (frame["verdict"] != ERROR)]


def level(frame: pd.DataFrame) -> pd.DataFrame:
    """Rejections by the first screen and names, by kind of nothing hidden.

    Heterogeneity is no rejection and no name where agents do differ. Cases without a p-value of the
    screen, because clusters were too few, are not screened.
    """
    found = []
    keys = ["domain", "variant", "noise", "n_sequences"]
    for key, part in nothing_hidden(frame).groupby(keys, sort=False):
        screened, names = part["screen_false"].dropna().astype(bool), part["false_names"] != ""
        found.append(
            {
                **dict(zip(("domain", "variant", "noise, m", "runs"), key, strict=True)),
                "clusters (median)": part["clusters_open"].astype(float).median(),
                "cases": len(part),
                "screened": len(screened),
                "first screen": int(screened.sum()),
                "first screen, p": above(screened),
                "final names": int(names.sum()),
                "final names, p": above(names),
                "hypotheses": int((part["leads"] != "").sum()),
                "unknown": int((part["verdict"] == UNKNOWN).sum()),
                "not testable": int((part["verdict"] == "not_testable").sum()),
            }
        )
    return pd.DataFrame(found)


def above(rejected: pd.Series) -> float:
    """The probability of so many rejections or more at :data:`LEVEL`; NaN without a case."""
    if rejected.empty:
        return float("nan")
    test = binomtest(int(rejected.sum()), len(rejected), LEVEL, alternative="greater")
    return float(test.pvalue)


def screens(frame: pd.DataFrame, domain: str) -> dict[str, np.ndarray]:
    """The first screen's p-values in their order, by kind of nothing hidden."""
    part = nothing_hidden(frame)
    part = part[(part["domain"] == domain) & part["screen_p"].notna()]
    return {
        str(name): np.sort(values.to_numpy(dtype=float))
        for name, values in part.groupby("variant", sort=False)["screen_p"]
    }


def by_method(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """The diagnosis and the baselines on the same cases.

    Cases that hide heterogeneity are left out: the baselines have no columns for it.
    """
    frame = pd.DataFrame(
        [
            {"domain": row["domain"], "method": method, **scored}
            for row in rows
            if row["baselines"]
            and "heterogeneity" not in row["hidden"]
            and row["variant"] != "heterogeneous"
            for method, scored in {"diagnosis": row, **row["baselines"]}.items()
        ]
    )
    if frame.empty:
        return frame
    idle = (frame["named"] != "nothing").where(frame["exact"].isna())
    shares = {"exact": "exact", "right class": "class_right", "worse than the base": "worse"}
    return summary(
        frame.assign(idle=idle),
        ["domain", "method"],
        {**shares, "named without a hidden effect": "idle"},
        {"closure (median)": "closure"},
    )
