"""Laws of people on two-way flows: which of them predicts how people walk in other runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.errors import ConfigError
from nnode.pages.page import Block
from nnode.pages.replay import ReplayBlock
from studies.crowd.figures import horizon_costs
from studies.frame import by_unit, computed, differences, numbers
from studies.options import WalkingStudyOptions
from studies.page import page
from studies.replay import player, scenes, spread
from studies.runner import Task
from studies.walking import tasks
from studies.walking.data import RUNS, prepare_runs, sequences
from studies.walking.laws import DESIRED, LABELS, LAWS, SIMPLE, filled, new_system

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
    download = options.download or str(folder / "data" / "raw")
    parts = []
    for horizon in options.horizons:
        stores = {}
        for kind in RUNS:
            name = f"{kind}-{horizon:g}s"
            where = folder / "data" / name
            stores[name] = prepare_runs(kind, options.source, download, horizon, where)
        folders = [str(store.folder) for store in stores.values()]
        every, title = _tasks(options, horizon, folders), f"walking study, {horizon:g} s"
        found = computed(every, folder, options, stores, title)
        parts.append(found.assign(horizon=horizon))
    study = Walking(options, pd.concat(parts, ignore_index=True))
    figures = {f"walking_{desired}": study.figure(desired) for desired in DESIRED}
    return page(
        "walking", study.tables(), {**figures, "replay": study.replay(folders)}, desired=DESIRED
    )


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


@dataclass
class Walking:
    """Options, and a row of results per task."""

    options: WalkingStudyOptions
    found: Any

    def errors(self, desired: str) -> pd.DataFrame:
        """A row per law, horizon (s) and held-out run: ``people``, and mean squared distances (m²)
        over a sequence, ``mean``, and at its ``end``."""
        rows = []
        for one in self.found.to_dict("records"):
            if one["task"] == "fit":
                laws = {one["law"]: one["errors"]} if one["desired"] == desired else {}
            else:
                laws = {name: one[name] for name in SIMPLE} if desired == DESIRED[0] else {}
            rows += [
                {"law": LABELS[law], "horizon": one["horizon"], "run": run, **errors}
                for law, runs in laws.items()
                for run, errors in runs.items()
                if errors["people"]
            ]
        return pd.DataFrame(rows)

    def costs(self, desired: str, horizon: float, what: str = "mean") -> pd.DataFrame:
        """A row per person of every run, a column per law: m²."""
        errors = self.errors(desired)
        table: Any = errors[errors["horizon"] == horizon].pivot(index="run", columns="law")
        table = table.loc[table.index.repeat(table["people"].iloc[:, 0])][what]
        order = [label for label in LABELS.values() if label in table]
        return by_unit({law: table[law] for law in order}, table.index)

    def tables(self) -> dict[str, pd.DataFrame]:
        """By their names in the template."""
        found = {"walking_parameters": self._parameters()}
        for desired in DESIRED:
            for name, what in (("", "mean"), ("_end", "end")):
                found[f"walking_{desired}{name}"] = pd.DataFrame(
                    {f"{h:g} s": self.costs(desired, h, what).mean() for h in self.options.horizons}
                ).rename_axis(None)
            found[f"walking_{desired}_differences"] = self.differences(desired)
        return found

    def differences(self, desired: str) -> Any:
        """Of every model from no interaction, by horizon; runs are what is resampled."""
        parts = {}
        for h in self.options.horizons:
            costs, alone = self.costs(desired, h), LABELS["alone"]
            pairs = [(str(law), alone) for law in costs if law != alone]
            parts[h] = differences(costs, pairs, self.options.seed).droplevel("second")
        found: Any = pd.concat(parts, names=["horizon (s)", "model"]).drop(columns="better")
        return found.reset_index("horizon (s)").sort_index(
            kind="stable", key=lambda laws: [list(LABELS.values()).index(law) for law in laws]
        )

    def figure(self, desired: str) -> Any:
        """Errors relative to those without interaction, by horizon."""
        horizons, laws = self.options.horizons, [LABELS[law] for law in LAWS]
        mean = self.tables()[f"walking_{desired}"].loc[laws]
        away = self.differences(desired).set_index("horizon (s)", append=True)
        low, high = (
            away[end].unstack().reindex(laws).set_axis(mean.columns, axis=1) + mean.iloc[0]
            for end in ("low", "high")
        )
        return horizon_costs(horizons, mean, low, high)

    def _parameters(self) -> pd.DataFrame:
        rows = [
            [
                LABELS[one["law"]],
                *(one["desired"], one["horizon"], ", ".join(one["held"])),
                *(name, value, one["train"]),
            ]
            for one in self.found[self.found["task"] == "fit"].to_dict("records")
            for name, _, value in numbers(one["row"])
        ]
        names = ["model", "wish", "horizon (s)", "held out", "parameter", "value"]
        return pd.DataFrame(rows, columns=[*names, "training error (m²)"]).set_index("model")

    def replay(self, folders: list[str]) -> ReplayBlock:
        """The runs of the first group at the longest horizon, beside laws that did not see them."""
        horizon, desired = self.options.horizons[-1], DESIRED[0]
        held = groups(self.options.folds)[0]
        seen = [s for folder in folders for s in sequences(folder) if s.recording in held]
        complete = [s for s in seen if s.preferred is not None and np.isfinite(s.preferred).all()]
        mean = self.costs(desired, horizon).mean()
        best = min(list(LAWS)[1:], key=lambda law: mean[LABELS[law]])
        fits = self.found.set_index("key")
        systems = {
            LABELS[law]: filled(
                new_system(law, desired), fits.loc[f"{law}-{desired}-{horizon:g}s-0", "row"]
            )
            for law in ("alone", best)
        }
        what = (
            f"Sequences of {horizon:g} s of held-out runs, as measured and as simulated by "
            f"{' and '.join(systems)}; desired velocity: *{desired}*."
        )
        return player("replay", scenes(spread(complete, FEW), systems), what, len(seen))
