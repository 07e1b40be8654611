"""The page's part on sequences that were not seen in calibration."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import holm, paired
from nnode.pages.page import Block, Heading, TableBlock, Text
from studies.traffic.results import LAWS, NETWORKS, Study, cell


def heldout_blocks(study: Study) -> list[Block]:
    """Costs on sequences that took no part in calibration, and which differences are sure."""
    contestants = ["no_interaction", "constant_velocity", *LAWS]
    contestants += [m + s for m in NETWORKS for s in ("-box", "")]
    rows = {}
    for policy in ("keep", "drop"):
        for name in contestants:
            values, _ = study.heldout(name, policy)
            rows[(policy, name)] = {
                "mean": values.mean(),
                "median": np.median(values),
                "90 % quantile": np.quantile(values, 0.9),
                "sequences": len(values),
            }
    table = pd.DataFrame(rows).T.rename_axis(["faults", "model"])
    wild = [
        m
        for m in NETWORKS
        if cell(table, ("keep", m), "mean") > 2 * cell(table, ("keep", "lin"), "mean")
    ]
    tame = [m for m in contestants if m not in wild]
    best = table.loc["keep"].loc[tame, "mean"].idxmin()
    text = f"With faults kept, the least mean held-out cost is {best}'s. " + (
        f"Free weights do not generalise: {', '.join(wild)} fit their training sequences best "
        "and fail on others by more than a factor of two in the mean, while the box keeps "
        "them near the laws."
        if wild
        else "Free weights stay within a factor of two of Lin on unseen sequences."
    )
    return [
        Heading("Sequences not seen in calibration"),
        Text(text),
        TableBlock(
            "heldout",
            table,
            f"Held-out cost (m² s) by sequence, {study.options.folds}-fold cross-validation by "
            "groups within each recording; all recordings pooled.",
            digits={"sequences": 0},
        ),
        _significance(study),
    ]


def _significance(study: Study) -> TableBlock:
    models = [*LAWS, *(m + "-box" for m in NETWORKS), "no_interaction"]
    results = {}
    for first, second in combinations(models, 2):
        a, group = study.heldout(first)
        b, _ = study.heldout(second)
        results[f"{first} − {second}"] = paired(a, b, group, study.options.seed)
    corrected = holm({name: one.p for name, one in results.items()})
    table = pd.DataFrame(
        {
            name: {
                "difference": one.difference,
                "95 % low": one.low,
                "95 % high": one.high,
                "first is better (%)": 100 * one.better,
                "p": one.p,
                "p, Holm": corrected[name],
            }
            for name, one in results.items()
        }
    ).T
    table.index.name = "pair"
    sure = [name for name in table.index if cell(table, name, "p, Holm") < 0.05]
    return TableBlock(
        "significance",
        table,
        "Differences of held-out costs (m² s) between models, paired by sequence; p from random "
        "signs of whole groups, corrected by Holm for the number of pairs. Below 0.05: "
        f"{'; '.join(sure) or 'none'}.",
        digits={"p": 4, "p, Holm": 4, "first is better (%)": 0},
        bold=pd.DataFrame({c: table["p, Holm"] < 0.05 if c == "p, Holm" else False for c in table}),
    )
