"""Sequences of the same truth that a diagnosis did not have: do the named effects predict them?"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import torch

from benchmarks.synthetic_cases.score import closure
from nnode.app.python.report import Report
from nnode.data.options import Faults
from nnode.data.readers.table import TableOptions
from nnode.discover.inputs import read_inputs
from nnode.discover.judge.model_comparison import ModelComparison, windows_of
from nnode.model.effects import CATALOGUE, IndividualEffect
from nnode.model.extend import without
from nnode.model.system import System


def kept_back(table: Path, number: int) -> pd.DataFrame:
    """Take the last sequences out of a table; returns them."""
    whole = pd.read_csv(table)
    names = list(dict.fromkeys(whole["sequence"]))[-number:] if number else []
    back = whole["sequence"].isin(names)
    if number:
        whole[~back].to_csv(table, index=False)
    return whole[back]


def on_fresh(
    fresh: pd.DataFrame, report: Report, truth: dict[str, Any], domain: str, walls: Path | None
) -> dict[str, Any]:
    """The base model and the extended model on further sequences.

    Returns:
        ``fresh_before`` and ``fresh_after``, mean square errors of positions of both, m²;
        ``fresh_worse``; ``fresh_closure``, relative to the truth. None where nothing was named, or
        an effect with a number per agent, because these agents are new.
    """
    nothing = dict.fromkeys(("fresh_before", "fresh_after", "fresh_worse", "fresh_closure"))
    names = [effect.name for effect in report.diagnosis.effects]
    if not names or any(issubclass(CATALOGUE.effects[name], IndividualEffect) for name in names):
        return nothing
    with TemporaryDirectory(prefix="nnode-fresh-") as folder:
        path = Path(folder) / "fresh.csv"
        fresh.to_csv(path, index=False)
        data = TableOptions(
            domain=domain,
            path=str(path),
            walls=None if walls is None else str(walls),
            name="table",
            faults=Faults.drop,
        )
        sequences = read_inputs(data, Path(folder)).sequences
    base = _base(report, names)
    comparison = ModelComparison(windows_of(base, sequences), base)
    before = float(np.nanmean(comparison.squares(base)))
    after = float(np.nanmean(comparison.squares(report.model)))
    gap = {"before": before, "after": after, "noise_floor": comparison.floor}
    split = {"sealed": [one.name for one in sequences]}
    return {
        "fresh_before": before,
        "fresh_after": after,
        "fresh_worse": after > before,
        "fresh_closure": closure(truth, {**report.plain(), "gap": gap, "split": split}),
    }


def _base(report: Report, names: list[str]) -> System:
    """The base model as it was calibrated without what was named."""
    found = without(report.model, *names)
    with torch.no_grad():
        for term in found.terms:
            for name, parameter in term.named_parameters():
                known = report.diagnosis.base.get(f"{term.name}.{name}")
                if known is not None:
                    parameter.fill_(known["before"])
    return found
