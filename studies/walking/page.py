"""The page of the walking study. Every claim in its text is computed from the results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nnode.calibrate.resampling import Paired, paired
from nnode.pages.page import Block, FigureBlock, Heading, TableBlock, Text
from studies.crowd.figures import horizon_costs
from studies.options import WalkingStudyOptions
from studies.walking.laws import DESIRED, LABELS, LAWS, SIMPLE

#: Of a test.
LEVEL = 0.05
#: What the wish is called.
WISHES = {
    "direction": "the direction of the stream and the speed of the second before",
    "last": "the place where each was measured last, and the speed of the second before",
}


@dataclass
class Walking:
    """Results by task."""

    options: WalkingStudyOptions
    found: dict[str, dict[str, Any]]

    def errors(self, model: str, desired: str, horizon: float) -> dict[str, dict[str, float]]:
        """People and mean squared distances (m²), by held-out run."""
        every: dict[str, dict[str, float]] = {}
        for i in range(self.options.folds):
            if model in SIMPLE:
                every |= self.found[f"simple-{horizon:g}s-{i}"][model]
            else:
                every |= self.found[f"{model}-{desired}-{horizon:g}s-{i}"]["errors"]
        return {run: one for run, one in every.items() if one["people"]}

    def error(self, model: str, desired: str, horizon: float, what: str = "mean") -> float:
        """Mean over people of all runs, m²."""
        found = self.errors(model, desired, horizon).values()
        return float(
            np.average([one[what] for one in found], weights=[one["people"] for one in found])
        )

    def against(self, model: str, other: str, desired: str, horizon: float) -> Paired:
        """A comparison of two models on the same people; runs are what is drawn."""
        one, two = (self.errors(m, desired, horizon) for m in (model, other))
        number = [int(one[run]["people"]) for run in one]
        first, second = (np.repeat([e[run]["mean"] for run in one], number) for e in (one, two))
        return paired(first, second, np.repeat(np.arange(len(one)), number), self.options.seed)


def blocks(study: Walking) -> list[Block]:
    """The page in its order."""
    found: list[Block] = [Heading("What comes out"), Text(_summary(study))]
    for desired in DESIRED:
        found += _wish(study, desired)
    every = _parameters(study)
    return [
        *found,
        Heading("Limits"),
        Text(
            "Only people who are tracked through a whole sequence are in it: the longer it is, the "
            "fewer and the slower they are, and whoever comes or leaves pushes nobody. Of the "
            "wish *last*, the end of what is predicted is known. Walls push nobody. Intervals "
            "draw whole runs, of which there are "
            f"{len(study.errors('alone', 'direction', study.options.horizons[0]))}, and tests "
            "change the signs of whole runs: no p is smaller than two of that many signs allow."
        ),
        TableBlock(
            "walking_parameters",
            every.head(8),
            "Every calibration; the first rows are shown, the CSV holds all of them.",
            digits=3,
            full=every,
        ),
    ]


def _models(desired: str) -> list[str]:
    return ["alone", *(SIMPLE if desired == "direction" else ()), *list(LAWS)[1:]]


def _wish(study: Walking, desired: str) -> list[Block]:
    horizons, models = study.options.horizons, _models(desired)
    columns = [f"{h:g} s" for h in horizons]
    index = [LABELS[m] for m in models]
    mean = pd.DataFrame(
        [[study.error(m, desired, h) for h in horizons] for m in models], index, columns
    )
    end = pd.DataFrame(
        [[study.error(m, desired, h, "end") for h in horizons] for m in models], index, columns
    )
    rows = []
    for model in models[1:]:
        for h in horizons:
            one = study.against(model, "alone", desired, h)
            rows.append((LABELS[model], h, one.difference, one.low, one.high, one.p))
    names = ["model", "horizon (s)", "difference", "low", "high", "p"]
    table = pd.DataFrame(rows, columns=names).set_index("model")
    free = [study.error("alone", desired, h) for h in horizons]
    ends = np.array([row[3:5] for row in rows]).reshape(len(models) - 1, len(horizons), 2)
    ends = np.concatenate([np.full((1, len(horizons), 2), np.nan), ends + np.array(free)[:, None]])
    low, high = (pd.DataFrame(ends[..., k], index, columns) for k in range(2))
    return [
        Heading(f"Where people want to go: {desired}"),
        Text(f"Everybody knows {WISHES[desired]}."),
        TableBlock(
            f"walking_{desired}",
            mean,
            "Mean squared distance (m²) between predicted and measured places of people in runs "
            "that were held out, over all samples of a sequence, by its length.",
            bold=mean.eq(mean.min()),
            digits=3,
        ),
        TableBlock(
            f"walking_{desired}_end",
            end,
            "The same at the end of the sequences (m²).",
            bold=end.eq(end.min()),
            digits=3,
        ),
        TableBlock(
            f"walking_{desired}_differences",
            table,
            "Difference (m²) from no interaction: below 0 the law predicts better. 95 % intervals "
            "over runs; p from random signs of whole runs, not corrected for the number of rows.",
            digits={"horizon (s)": 0, "difference": 4, "low": 4, "high": 4, "p": 3},
        ),
        FigureBlock(
            f"walking_{desired}",
            _figure(horizons, mean, low, high),
            "Mean squared distance relative to that without interaction, with 95 % intervals of "
            "the difference over runs.",
            alt="Relative error by horizon, one line per law",
        ),
    ]


def _figure(
    horizons: list[float], mean: pd.DataFrame, low: pd.DataFrame, high: pd.DataFrame
) -> Figure:
    shown = [LABELS[law] for law in LAWS]
    return horizon_costs(horizons, mean.loc[shown], low.loc[shown], high.loc[shown])


def _summary(study: Walking) -> str:
    lines = []
    for desired in DESIRED:
        for h in study.options.horizons:
            models = list(LAWS)[1:]
            best = min(models, key=lambda m: study.error(m, desired, h))
            one = study.against(best, "alone", desired, h)
            base = study.error("alone", desired, h)
            told = one.p < LEVEL and not one.low <= 0 <= one.high
            said = ("better" if one.high < 0 else "worse") + " than that"
            lines.append(
                f"- *{desired}*, {h:g} s: {base:.4f} m² without interaction; the best law, "
                f"{LABELS[best]}, {f'is {said}' if told else 'cannot be told from that'} "
                f"({one.difference:+.4f} m², 95 % {one.low:+.4f} to {one.high:+.4f}, "
                f"p = {one.p:.3f}; chosen on the same runs)."
            )
    return "\n".join(lines)


def _parameters(study: Walking) -> pd.DataFrame:
    rows = []
    for law in LAWS:
        for desired in DESIRED:
            for h in study.options.horizons:
                for i in range(study.options.folds):
                    one = study.found[f"{law}-{desired}-{h:g}s-{i}"]
                    rows += [
                        (LABELS[law], desired, h, i, name, value, one["train"])
                        for name, value in one["row"].items()
                    ]
    names = ["model", "wish", "horizon (s)", "fold", "parameter", "value", "training error (m²)"]
    return pd.DataFrame(rows, columns=names).set_index("model")
