"""The table of verdicts: shares of right and false answers, with their limits."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
from scipy.stats import binomtest

#: Columns of numbers whose medians are in the table.
MEDIANS = ("closed", "overlap", "relative", "of_size", "seconds")


def verdicts(rows: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """A line per group: the number of rows, the share of every column of yes and no, and medians.

    Rows without an answer in a column do not count for its share.
    """
    groups = rows.groupby(list(by), sort=False, dropna=False)
    columns = {"cases": groups.size()}
    for name in rows.columns.difference(list(by), sort=False):
        values = rows[name].dropna()
        if len(values) and values.map(lambda value: isinstance(value, bool)).all():
            columns[name] = groups[name].agg(share)
        elif len(values) and name in MEDIANS:
            columns[f"{name} (median)"] = groups[name].median()
    return pd.DataFrame(columns).reset_index()


def share(answers: pd.Series) -> str:
    """A proportion with its exact interval of 95 % (Clopper & Pearson 1934)."""
    answers = answers.dropna()
    if not len(answers):
        return "–"
    number, of = int(answers.sum()), len(answers)
    low, high = binomtest(number, of).proportion_ci()
    return f"{number} of {of} ({100 * number / of:.0f} %, {100 * low:.0f}–{100 * high:.0f} %)"
