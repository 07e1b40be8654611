"""Laws of people on two-way flows: which of them predicts how people walk in other runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nnode.errors import ConfigError
from nnode.pages.page import Block, Heading
from studies.options import WalkingStudyOptions
from studies.replay import player, scenes, spread
from studies.runner import Task, hash_of, run_tasks
from studies.walking import tasks
from studies.walking.data import RUNS, prepare_runs, sequences
from studies.walking.laws import DESIRED, LABELS, LAWS, filled, new_system
from studies.walking.page import Walking, blocks

TITLE = "Walking: laws of people on two-way flows"
SUBTITLE = (
    "Laws that the field uses, calibrated on some runs and tested on others, where people want to "
    "go measured before what is predicted, or told from its end."
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
    options = _checked(options)
    assert options.workers is not None
    found: dict[str, dict[str, Any]] = {}
    for horizon in options.horizons:
        stores = {
            f"{kind}-{horizon:g}s": prepare_runs(
                kind,
                options.source,
                options.download or str(folder / "data" / "raw"),
                horizon,
                folder / "data" / f"{kind}-{horizon:g}s",
            )
            for kind in RUNS
        }
        found |= run_tasks(
            _tasks(options, horizon, [str(store.folder) for store in stores.values()]),
            folder,
            workers=options.workers,
            fingerprint=hash_of(stores),
            title=f"walking study, {horizon:g} s",
        )
    study = Walking(options, found)
    return [*blocks(study), *_replay(study, [str(store.folder) for store in stores.values()])]


def _replay(study: Walking, folders: list[str]) -> list[Block]:
    """The runs of the first group at the longest horizon, beside laws that did not see them."""
    horizon, desired = study.options.horizons[-1], DESIRED[0]
    held = groups(study.options.folds)[0]
    seen = [s for folder in folders for s in sequences(folder) if s.recording in held]
    known = [s for s in seen if s.preferred is not None and np.isfinite(s.preferred).all()]
    if not known:
        return []
    best = min(list(LAWS)[1:], key=lambda law: study.error(law, desired, horizon))
    systems = {}
    for law in ("alone", best):
        row = study.found[f"{law}-{desired}-{horizon:g}s-0"]["row"]
        systems[LABELS[law]] = filled(new_system(law, desired), row)
    what = (
        f"Some sequences of {horizon:g} s of runs that were held out, in which everybody was "
        f"measured before, beside {' and '.join(systems)}; where people want to go: *{desired}*."
    )
    return [
        Heading("Replay"),
        player("replay", scenes(spread(known, FEW), systems), what, len(seen)),
    ]


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


def _checked(options: WalkingStudyOptions) -> WalkingStudyOptions:
    if options.quick:
        options = replace(options, horizons=options.horizons[:1], folds=2)
    if not 2 <= options.folds <= sum(map(len, RUNS.values())):
        raise ConfigError(f"study.folds={options.folds}: expected 2 to 7 groups of runs")
    if not options.horizons or min(options.horizons) <= 0:
        raise ConfigError(f"study.horizons={options.horizons}: expected positive times in s")
    return replace(options, horizons=sorted(set(options.horizons)))
