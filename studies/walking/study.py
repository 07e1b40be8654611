"""Laws of people on two-way flows: which of them predicts how people walk in other runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.pages.page import Block
from nnode.pages.replay import Scene
from nnode.plots.style import thinned
from studies.figures import horizon_costs
from studies.frame import by_number, by_unit, computed, differences
from studies.options import WalkingStudyOptions
from studies.page import page
from studies.pooled import filled
from studies.replay import scenes
from studies.runner import Task
from studies.walking import tasks
from studies.walking.tasks import (
    DESIRED,
    LABELS,
    LAWS,
    RUNS,
    Result,
    measured_before,
    new_system,
    prepare_runs,
)

TITLE = "Walking: pedestrian laws in two-way flows"
SUBTITLE = (
    "Common pedestrian laws, calibrated on some runs and tested on others. Desired directions are "
    "measured before the prediction, or taken from its end."
)
#: Relative times of the calibrations.
_COSTS = {"alone": 1.0, "exponential": 4.0, "esf": 9.0, "ttc": 9.0, "gcfm": 5.0, "cfsm": 10.0}
#: Sequences in the player.
FEW = 10


def groups(folds: int) -> list[list[str]]:
    """Runs that are held out together, dealt out in turn."""
    every = [run for kind in RUNS for run in RUNS[kind]]
    return [every[i::folds] for i in range(folds)]


def run(options: WalkingStudyOptions, folder: Path) -> list[Block]:
    """Compute what is missing and make the page.

    Raises:
        ConfigError: an option out of its range.
        DataError: recordings that cannot be read, or a horizon longer than anyone is in view.
        StudyError: tasks failed.
    """
    if options.folds > sum(map(len, RUNS.values())):
        raise ConfigError(f"study.folds={options.folds}: expected 2 to 7 groups of runs")
    parts = []
    for horizon in options.horizons:
        stores = {
            f"{kind}-{horizon:g}s": prepare_runs(options, folder, kind, horizon) for kind in RUNS
        }
        folders = [str(store.folder) for store in stores.values()]
        every, title = _tasks(options, horizon, folders), f"walking study, {horizon:g} s"
        results = computed(every, folder, options, stores, title)
        parts.append(results.assign(horizon=horizon))
    return page("walking", Walking(options, pd.concat(parts), folders), desired=DESIRED)


def _tasks(options: WalkingStudyOptions, horizon: float, folders: list[str]) -> list[Task]:
    every = []
    for i, held in enumerate(groups(options.folds)):
        where = {"folders": folders, "held": held}
        every.append(Task(f"simple-{horizon:g}s-{i}", tasks.baselines, where))
        every += [
            Task(
                f"{law}-{desired}-{horizon:g}s-{i}",
                tasks.fit,
                {"law": law, "desired": desired, **where},
                cost=_COSTS[law],
            )
            for law in LAWS
            for desired in DESIRED
        ]
    return every


def errors_by_run(errors: Iterable[Result], labels: Mapping[str, str]) -> pd.DataFrame:
    """A row per law and held-out run in which somebody is predicted.

    Args:
        errors: of the tasks, by law and run, see :func:`studies.walking.tasks.fit`.
        labels: of the laws.

    Returns:
        ``law``, ``run``, ``people``, and their mean errors.
    """
    return pd.DataFrame(
        [
            {"law": labels[law], "run": run, **means}
            for by_law in errors
            for law, runs in by_law.items()
            for run, means in runs.items()
            if means["people"]
        ]
    )


@dataclass
class Walking:
    """Options, a row of results per task, and the folders of the longest horizon."""

    options: WalkingStudyOptions
    results: Any
    folders: list[str]

    def costs(self, desired: str, horizon: float, what: str = "mean") -> pd.DataFrame:
        """A row per person of every run, a column per law: m²."""
        simple = "or task == 'baselines'" if desired == DESIRED[0] else ""
        chosen = self.results.query(f"horizon == @horizon and (desired == @desired {simple})")
        table: Any = errors_by_run(chosen["errors"], LABELS).pivot(index="run", columns="law")
        table = table.loc[table.index.repeat(table["people"].iloc[:, 0])][what]
        order = [label for label in LABELS.values() if label in table]
        return by_unit(table[order], table.index)

    def means(self, desired: str, what: str = "mean") -> pd.DataFrame:
        """Mean cost (m²) by law and horizon."""
        horizons = self.options.horizons
        by_horizon = {f"{h:g} s": self.costs(desired, h, what).mean() for h in horizons}
        return pd.DataFrame(by_horizon).rename_axis(None)

    def paired_differences(self, desired: str) -> Any:
        """Of every model from no interaction, by horizon; runs are what is resampled."""
        parts, alone = {}, LABELS["alone"]
        for h in self.options.horizons:
            costs = self.costs(desired, h)
            pairs = [(str(law), alone) for law in costs if law != alone]
            parts[h] = differences(costs, pairs, self.options.seed).droplevel("second")
        stacked: Any = pd.concat(parts, names=["horizon (s)", "model"]).drop(columns="better")
        return stacked.reset_index("horizon (s)").sort_index(
            kind="stable", key=lambda laws: laws.map(list(LABELS.values()).index)
        )

    def draw(self, desired: str) -> Figure:
        """Errors relative to those without interaction, by horizon."""
        horizons, laws = self.options.horizons, [LABELS[law] for law in LAWS]
        mean = self.means(desired).loc[laws].set_axis(horizons, axis=1)
        away = self.paired_differences(desired).set_index("horizon (s)", append=True)
        low, high = (
            away[end].unstack().reindex(laws)[horizons] + mean.iloc[0] for end in ("low", "high")
        )
        return horizon_costs(mean, low, high)

    def parameters(self) -> pd.DataFrame:
        fits = self.results.query("task == 'fit'")
        table = pd.DataFrame(
            {
                "model": fits["law"].map(LABELS),
                "wish": fits["desired"],
                "horizon (s)": fits["horizon"],
                "held out": fits["held"].map(", ".join),
                "row": fits["row"],
                "training error (m²)": fits["train"],
            }
        )
        table = by_number(table, "row").drop(columns="index").set_index("model")
        table["training error (m²)"] = table.pop("training error (m²)")  # the last column
        return table

    @property
    def tested(self) -> list[Sequence]:
        """The sequences of the first group of runs at the longest horizon."""
        held = groups(self.options.folds)[0]
        every = [s for folder in self.folders for s in measured_before(folder)]
        return [s for s in every if s.recording in held]

    def scenes(self, desired: str) -> list[Scene]:
        """Sequences of the player, simulated by laws that were calibrated on the other groups."""
        horizon, rows = self.options.horizons[-1], self.results["row"]
        complete = [s for s in self.tested if np.isfinite(np.array(s.preferred)).all()]
        mean = self.costs(desired, horizon).mean()
        best = min(list(LAWS)[1:], key=lambda law: mean[LABELS[law]])
        systems = {
            LABELS[law]: filled(new_system(law, desired), rows[f"{law}-{desired}-{horizon:g}s-0"])
            for law in ("alone", best)
        }
        return scenes(thinned(complete, FEW), systems)
