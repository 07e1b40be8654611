"""Car following: laws with and without effects on pairs and platoons with published results."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from nnode.data.store import Store
from nnode.pages.page import Block
from studies.following import printed, tasks
from studies.following.data import LEADERS, PAIRS, PLATOONS, stores
from studies.following.results import EVEN, SWING, Study
from studies.following.tasks import DECAY, EVERY, OBJECTIVES, ON_TRACK, REFERENCE, key
from studies.frame import computed
from studies.options import FollowingStudyOptions
from studies.page import page
from studies.runner import Task

TITLE = "Car following: laws, effects, drivers"
SUBTITLE = (
    "Car-following laws with and without effects, calibrated by the Gauss–Newton method with exact "
    "derivatives on NGSIM I-80 (published split), OpenACC and TGSIM."
)
#: Candidates and laws on platoons of a quick study.
FEW = (REFERENCE, "helly", "idm + memory")


def run(options: FollowingStudyOptions, folder: Path) -> list[Block]:
    """Compute what is missing and make the page.

    A law is chosen by cross-validation over the training pairs; only then are test pairs read.

    Raises:
        ConfigError: no folder with the recordings.
        DataError: recordings that cannot be read.
        StudyError: tasks failed.
    """
    prepared = stores(options, folder)

    def run_all(tasks: list[Task], title: str) -> pd.DataFrame:
        return computed(tasks, folder, options, prepared, title)

    study = Study(options, prepared, run_all(training(options, prepared), "cross-validation"))
    results = run_all(after(study), "test, precision, platoons")
    study.results = pd.concat([study.results, results])
    return blocks(study)


def blocks(study: Study) -> list[Block]:
    """The page."""
    return page(
        "following",
        study,
        study.stores.values(),
        reference=REFERENCE,
        key=key,
        decay=DECAY,
        left=[name for name in EVERY if name not in study.order],
        objectives=list(OBJECTIVES),
        even=EVEN,
        swing=SWING,
        run=printed.platoon,
    )


def training(options: FollowingStudyOptions, prepared: Mapping[str, Store]) -> list[Task]:
    """What chooses a law: nothing here depends on a test pair."""
    where = {"folder": str(prepared[PAIRS].folder), "folds": options.folds}
    where |= {"restarts": options.restarts, "seed": options.seed}
    return [
        Task(
            f"cv-{key(name)}",
            tasks.cross_validate,
            where | {"name": name},
            cost=len(law.effects) + (law.network or 0) + 2.0,
        )
        for name, law in EVERY.items()
        if not options.quick or name in FEW
    ]


def after(study: Study) -> list[Task]:
    """All that follows the choice of a law."""
    options = study.options
    pairs, track, road = (
        {"folder": str(study.stores[name].folder)} for name in (PAIRS, PLATOONS, LEADERS)
    )
    search = {"restarts": options.restarts, "seed": options.seed}
    idm = {"name": REFERENCE, **search}
    rows = study.calibrated["row"]
    folds = {"row": rows[REFERENCE], "folds": options.folds}
    every = [
        Task("reproduced-pairs", tasks.reproduced_pairs, pairs),
        Task("reproduced-platoon", tasks.reproduced_platoon, track),
        Task("floor", tasks.floor, pairs | idm, cost=6.0),
        Task("halves", tasks.halves, pairs | idm | folds, cost=8.0),
        Task("leaders", tasks.by_leader, road | idm, cost=6.0),
        Task("runs", tasks.every_run, track | idm, cost=8.0),
    ]
    for name, row in rows.items():
        fitted = pairs | {"name": name, "row": row}
        every.append(Task(f"test-{key(name)}", tasks.tested, fitted))
        if name in study.chosen:
            where = pairs | {"name": name} | search
            every.append(Task(f"objectives-{key(name)}", tasks.objectives, where, cost=6.0))
            every.append(Task(f"precision-{key(name)}", tasks.precision, fitted, cost=4.0))
    for name in ON_TRACK:
        if not options.quick or name in FEW:
            where = track | {"name": name} | search
            every.append(Task(f"platoon-{key(name)}", tasks.compare, where, cost=5.0))
    return every
