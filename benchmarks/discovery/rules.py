"""The effect of halving and doubling each threshold of the diagnosis on names and false names.

Of a threshold near 1 the distance to 1 is halved and doubled.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery import synthetic
from benchmarks.synthetic_cases.score import UNKNOWN
from nnode.discover import thresholds
from nnode.pages.page import Block, Heading, TableBlock


def settings() -> Iterator[tuple[str, dict[str, float]]]:
    """Names of changes with the thresholds that they change; no change comes first."""
    yield "as they are", {}
    for threshold, default in vars(thresholds).items():
        if not threshold.isupper():
            continue
        for word, factor in (("halved", 0.5), ("doubled", 2.0)):
            near_one = 0.5 < default < 1
            value = 1 - factor * (1 - default) if near_one else factor * default
            # a share of 1 is no share: the distance to 1 is halved instead
            value = value if threshold == "PRIOR" or value < 1 else (1 + default) / 2
            yield f"{threshold} {word}", {threshold: value}


def cases(kind: str, options: DiscoveryBenchmarkOptions, first: int) -> dict[str, Any]:
    """Every case of the synthetic benchmark under every change."""
    every = synthetic.cases(kind, options, first)
    return {
        f"{key}-{change.replace(' ', '-')}": {**arguments, "change": change, "changed": values}
        for change, values in settings()
        for key, arguments in every.items()
    }


def evaluate(change: str, **arguments: Any) -> dict[str, Any]:
    """The score of a case under changed thresholds."""
    return {**synthetic.evaluate(**arguments), "changed": change}


def blocks(rows: list[dict[str, Any]]) -> list[Block]:
    """Counts by change."""
    frame = pd.DataFrame(rows)
    frame = frame.assign(
        wrong=frame["false_names"].map(bool), unknown=frame["verdict"] == UNKNOWN, cases=1
    )
    columns = ["cases", "exact", "among_equals", "wrong", "unknown"]
    counts = frame.groupby(["changed", "arm"], sort=False)[columns].sum()
    caption = "Cases by change of one threshold."
    return [Heading("Thresholds"), TableBlock("rules", counts, caption)]
