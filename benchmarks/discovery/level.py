"""How often chance passes the gates of the diagnosis where nothing is hidden."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from benchmarks.discovery.task import ERROR
from benchmarks.synthetic_cases.score import LEVEL, UNKNOWN

#: A gate keeps its level where the one-sided test against it is not rejected at this probability.
REJECTED = 0.025
_GROUP = ["domain", "variant", "noise", "n_sequences"]


def nothing_hidden(frame: pd.DataFrame) -> pd.DataFrame:
    """The cases of the arms with nothing hidden whose diagnosis ended."""
    return frame[(frame["arm"] == "nothing") & (frame["verdict"] != ERROR)]


def level(frame: pd.DataFrame) -> pd.DataFrame:
    """Rejections by the first screen and final names, by domain and kind of nothing.

    Heterogeneity is no rejection and no name where agents do differ. Both p-values are those of
    the one-sided binomial test against :data:`LEVEL`. Cases in which the screen had no p-value,
    as clusters were too few, are none of its own.
    """
    found = []
    for key, part in nothing_hidden(frame).groupby(_GROUP, sort=False):
        screened = part["screen_false"].dropna().astype(bool)
        names = part["false_names"] != ""
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


def criteria(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of the table of what was asked for: each gate of each kind of nothing, at the noise and
    the number of runs that most of its cases have."""
    table = level(frame)
    if len(table):
        most = table.groupby(["domain", "variant"], sort=False)["cases"].idxmax()
        table = table.loc[most]
    return [
        {
            "domain": row["domain"],
            "measure": f"nothing hidden, {row['variant']}: p of {gate} above 5 %",
            "asked for": f"≥ {REJECTED:.3f}",
            "reached": row[f"{gate}, p"],
            "cases": row[cases],
            "met": bool(row[f"{gate}, p"] >= REJECTED),
        }
        for row in table.to_dict("records")
        for gate, cases in (("first screen", "screened"), ("final names", "cases"))
        if row[cases]
    ]


def above(rejected: pd.Series) -> float:
    """The probability of so many rejections or more at :data:`LEVEL`; NaN without a case."""
    if rejected.empty:
        return float("nan")
    test = binomtest(int(rejected.sum()), len(rejected), LEVEL, alternative="greater")
    return float(test.pvalue)


def screens(frame: pd.DataFrame, domain: str) -> dict[str, np.ndarray]:
    """The first screen's p-values in their order, by kind of nothing, where there are any."""
    part = nothing_hidden(frame)
    part = part[(part["domain"] == domain) & part["screen_p"].notna()]
    return {
        str(name): np.sort(values.to_numpy(dtype=float))
        for name, values in part.groupby("variant", sort=False)["screen_p"]
    }
