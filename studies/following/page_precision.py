"""How sure parameters are: objectives, intervals, profiles, drivers who differ."""

from __future__ import annotations

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import paired
from nnode.pages.page import Block, FigureBlock, Heading, TableBlock, Text
from studies.following import figures as plots
from studies.following.candidates import REFERENCE, key
from studies.following.fit import OBJECTIVES
from studies.following.results import Study

#: Units of parameters, by name.
UNITS = {
    "v0": "m/s",
    "T": "s",
    "s0": "m",
    "a": "m/s²",
    "b": "m/s²",
    "b_1": "m/s²",
    "kappa": "1/s",
    "lam": "1/s",
    "s_c": "m",
    "w": "m",
    "c_s": "1/s²",
    "c_v": "1/s",
    "d": "m",
    "tau_m": "s",
    "tau_v": "s",
}
#: A correlation from here on is strong.
STRONG = 0.9


def precision_blocks(study: Study) -> list[Block]:
    """Sections on precision and on drivers."""
    found: list[Block] = [Heading("Which objective"), *_objectives(study)]
    found.append(Heading("How sure the parameters are"))
    known = [n for n in (REFERENCE, study.best) if f"precision-{key(n)}" in study.found]
    for name in dict.fromkeys(known):
        found += _precision(study, name)
    return [*found, *_drivers(study)]


def _objectives(study: Study) -> list[Block]:
    blocks: list[Block] = [
        Text(
            "Whichever objective is minimised on the training pairs, all are reported; the least "
            "of a column is in bold, and it has to stand on the diagonal."
        )
    ]
    for name in dict.fromkeys((REFERENCE, study.best)):
        one = study.one("objectives", name)
        table = pd.DataFrame({o: one[o]["reached"] for o in OBJECTIVES}).T
        table.index.name = "minimised"
        numbers = pd.DataFrame({o: one[o]["parameters"] for o in OBJECTIVES}).T
        weights = [c for c in numbers.columns if c.startswith("n") and c[1:2].isdigit()]
        numbers = (
            numbers.drop(columns=weights)[list(numbers.columns[:8])]
            if not weights
            else (numbers.drop(columns=weights))
        )
        both = pd.concat([table, numbers], axis=1)
        both["at a limit"] = [", ".join(one[o]["limits"]) for o in OBJECTIVES]
        both.index.name = "minimised"
        bold = pd.DataFrame(False, index=both.index, columns=both.columns)
        for column in OBJECTIVES:
            bold.loc[str(both[column].astype(float).idxmin()), column] = True
        blocks.append(
            TableBlock(
                f"objectives_{key(name)}",
                both,
                f"*{name}*: all objectives on the training pairs, and the parameters, by what was "
                "minimised. Gap: RMSE (m), then mean squares of the gap (m²), its relative error, "
                "its logarithm, and the speed (m²/s²).",
                bold=bold,
                digits={c: 3 for c in both.columns if c in OBJECTIVES},
            )
        )
    return blocks


def _precision(study: Study, name: str) -> list[Block]:
    one = study.one("precision", name)
    names = one["names"]
    own = study.one("cv", name)
    row, half = np.array(one["row"]), np.array(one["half"])
    correlation = pd.DataFrame(one["correlation"], index=names, columns=names)
    table = pd.DataFrame(
        {
            "value": row,
            "from": row - half,
            "to": row + half,
            "unit": [UNITS.get(n, "1") for n in names],
            "at a limit": [n in own["limits"] for n in names],
            **{f"r({n})": correlation[n].to_numpy() for n in names},
        },
        index=pd.Index(names, name="parameter"),
    )
    shown = table if len(names) <= 8 else table.drop(columns=[f"r({n})" for n in names])
    matrix = np.array(one["correlation"], dtype=float)
    away = matrix[np.triu_indices(len(names), 1)]
    pairs = [
        f"{names[i]} and {names[j]} ({matrix[i, j]:+.2f})"
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(matrix[i, j]) > STRONG
    ]
    open_ = [n for n in names if not _closed(one["profiles"][n], own["parameters"][n])]
    strongest = float(np.abs(away).max()) if away.size else 0.0
    text = (
        f"*{name}*: intervals from how gradients differ between clusters (CR2). "
        + (f"Strongly correlated: {', '.join(pairs)}. " if pairs else "")
        + (f"The strongest correlation is {strongest:.2f}. " if not pairs else "")
        + (
            "Weakly identified, as the error's rise is within what clusters vary on a side of the "
            f"profile: {', '.join(open_)}."
            if open_
            else "Every profile closes on both sides."
        )
    )
    units = {n: UNITS.get(n, "1") for n in names}
    blocks: list[Block] = [
        Text(text),
        TableBlock(
            f"precision_{key(name)}",
            shown,
            f"Parameters of *{name}* from all training pairs, with 95 % intervals from "
            f"{study.clusters.max() + 1} clusters"
            + (", and their correlations." if len(names) <= 8 else "."),
            full=table,
        ),
    ]
    if len(names) <= 8:
        profiles = {
            n: {k: np.array(v) for k, v in one["profiles"][n].items()}
            | {"best": np.array(own["parameters"][n])}
            for n in names
        }
        blocks.append(
            FigureBlock(
                f"profiles_{key(name)}",
                plots.profiles(profiles, units),
                f"*{name}*: the rise of the mean error where one parameter is held and all others "
                "are calibrated again; band: 95 %, clusters resampled; broken line: the best.",
                f"Profiles of the parameters of {name}.",
            )
        )
    return blocks


def _closed(profile: dict[str, list[float]], best: float) -> bool:
    """Whether the error rises beyond doubt on both sides within the profile's range."""
    values, low = np.array(profile["values"]), np.array(profile["low"])
    return bool((low[values < best] > 0).any() and (low[values > best] > 0).any())


def _drivers(study: Study) -> list[Block]:
    one = study.found["halves"]
    group = np.array(one["clusters"])
    costs = {name: np.array(one[name]) for name in ("pooled", "alone", "shrunk")}
    rows = {}
    for name, values in costs.items():
        away = paired(values, costs["pooled"], group, study.options.seed)
        rows[name] = {
            "second half (m)": values.mean(),
            "median (m)": np.median(values),
            "minus pooled": away.difference,
            "from": away.low,
            "to": away.high,
            "better": away.better,
        }
    table = pd.DataFrame(rows).T
    table.index.name = "calibrated"
    centre, spread = np.array(one["centre"]), np.array(one["spread"])
    lasting = pd.DataFrame(
        {
            "pooled": centre,
            "spread of single pairs": one["between"],
            "spread that lasts": spread,
            "unit": [UNITS.get(n, "1") for n in one["names"]],
        },
        index=pd.Index(one["names"], name="parameter"),
    )
    limits = study.found["floor"]["limits"]
    touched = sum(bool(found) for found in limits)
    text = (
        "Calibrated on the first half of every training pair and judged on the second: "
        f"{REFERENCE} with one set of numbers for all, with numbers of each pair's own, "
        "and with those drawn towards the common ones. What lasts of a driver is the "
        "covariance of its numbers in both halves (method of moments); deviations in "
        "units of that spread are penalised, by a factor that each fold takes from the others "
        f"({', '.join(f'{x:g}' for x in sorted(set(one['strengths'])))} m). "
        f"Alone over its whole length, {touched} of {len(limits)} pairs end with a parameter at a "
        "limit."
    )
    return [
        Heading("Drivers who differ"),
        Text(text),
        TableBlock(
            "drivers",
            table,
            "Error of the gap on the second half of the training pairs, started from the measured "
            "state there; differences to the pooled calibration with 95 % intervals, clusters "
            "resampled.",
        ),
        TableBlock(
            "spread",
            lasting,
            "Standard deviations between pairs: of numbers calibrated on the first half alone, and "
            "of what both halves have in common.",
        ),
    ]
