"""Car following: laws with and without effects on pairs and platoons with published results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from nnode.data.store import Store
from nnode.errors import ConfigError
from nnode.pages.page import Block
from studies.following import fit, inference, leaders, platoons
from studies.following.candidates import EVERY, REFERENCE, Candidate, key
from studies.following.data import LEADERS, PAIRS, PLATOONS, stores
from studies.following.page import blocks
from studies.following.results import Study
from studies.options import FollowingStudyOptions, StudyOptions
from studies.runner import Task, hash_of, run_tasks

TITLE = "Car following: laws, effects, drivers"
SUBTITLE = (
    "Laws of following with and without effects, calibrated by Gauss and Newton's method "
    "on exact tangents: NGSIM I-80 with a published division, OpenACC, TGSIM."
)


def run(options: StudyOptions, folder: Path) -> list[Block]:
    """Compute what is missing and make the page.

    A law is chosen by cross-validation over the training pairs; only then are test pairs read.

    Raises:
        ConfigError: an option out of its range, or no folder with the recordings.
        DataError: recordings that cannot be read.
        StudyError: tasks failed.
    """
    assert isinstance(options, FollowingStudyOptions)
    options = checked(options)
    found = stores(options, folder)
    assert options.workers is not None
    how: dict[str, Any] = {"workers": options.workers, "fingerprint": hash_of(found)}
    first = training(options, found)
    results = run_tasks(first, folder, title="cross-validation", **how)
    study = Study(options, found, results)
    results |= run_tasks(after(study), folder, title="test, precision, platoons", **how)
    return blocks(study)


def checked(options: FollowingStudyOptions) -> FollowingStudyOptions:
    """Options of a quick study, or as they are.

    Raises:
        ConfigError: an option out of its range.
    """
    if options.quick:
        options = replace(options, restarts=1, folds=2)
    for name, least in (("restarts", 1), ("folds", 2)):
        if getattr(options, name) < least:
            raise ConfigError(f"study.{name}={getattr(options, name)} must be at least {least}")
    return options


def training(options: FollowingStudyOptions, found: Mapping[str, Store]) -> list[Task]:
    """What chooses a law: nothing here sees a test pair."""
    where = {"folder": str(found[PAIRS].folder), "restarts": options.restarts, "seed": options.seed}
    return [
        Task(
            f"cv-{key(name)}",
            fit.cross_validate,
            {**where, "name": name, "folds": options.folds},
            cost=len(one.effects) + (one.network or 0) + 2.0,
        )
        for name, one in candidates(options).items()
    ]


def after(study: Study) -> list[Task]:
    """All that follows the choice of a law."""
    options = study.options
    pairs, platoons_, leaders_ = (
        str(study.stores[name].folder) for name in (PAIRS, PLATOONS, LEADERS)
    )
    search = {"restarts": options.restarts, "seed": options.seed}
    rows = {name: study.one("cv", name)["row"] for name in study.names}
    known = list(dict.fromkeys((REFERENCE, study.best)))
    tasks = [
        Task("reproduced-pairs", fit.reproduced, {"folder": pairs}),
        Task("reproduced-platoon", platoons.reproduced, {"folder": platoons_}),
        Task("floor", fit.floor, {"folder": pairs, "name": REFERENCE, **search}, cost=6.0),
        Task(
            "halves",
            inference.halves,
            {
                "folder": pairs,
                "name": REFERENCE,
                "row": rows[REFERENCE],
                "folds": options.folds,
                **search,
            },
            cost=8.0,
        ),
        Task("leaders", leaders.by_leader, {"folder": leaders_, "name": REFERENCE, **search}, 6.0),
        Task("runs", platoons.every_run, {"folder": platoons_, "name": REFERENCE, **search}, 8.0),
    ]
    for name in study.names:
        where = {"folder": pairs, "name": name}
        tasks.append(Task(f"test-{key(name)}", fit.tested, {**where, "row": rows[name]}))
    for name in known:
        where = {"folder": pairs, "name": name}
        tasks.append(Task(f"objectives-{key(name)}", fit.objectives, {**where, **search}, cost=6.0))
        own = {**where, "row": rows[name]}
        tasks.append(Task(f"precision-{key(name)}", inference.precision, own, cost=4.0))
    for name in platoon_candidates(options):
        where = {"folder": platoons_, "name": name}
        tasks.append(Task(f"platoon-{key(name)}", platoons.compare, {**where, **search}, cost=5.0))
    return tasks


def platoon_candidates(options: FollowingStudyOptions) -> list[str]:
    """Laws that are tried on commercial cars; a quick study takes few."""
    few = ("idm", "helly")
    return [name for name in platoons.CANDIDATES if not options.quick or name in few]


def candidates(options: FollowingStudyOptions) -> dict[str, Candidate]:
    """Those that are compared; a quick study takes few."""
    few = (REFERENCE, "helly", "idm + memory")
    return {name: one for name, one in EVERY.items() if not options.quick or name in few}
