"""Car following: laws with and without effects on pairs and platoons with published results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from nnode.data.store import Store
from nnode.errors import ConfigError
from nnode.study.following import fit
from nnode.study.following.candidates import EVERY, REFERENCE
from nnode.study.following.data import PAIRS
from nnode.study.options import FollowingStudyOptions
from nnode.study.runner import Task

TITLE = "Car following: laws, effects, drivers"
SUBTITLE = (
    "Eleven laws of following with and without effects, calibrated by Gauss and Newton's method "
    "on exact tangents: NGSIM I-80 with a published division, OpenACC, TGSIM."
)


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
            f"cv-{one.key}",
            fit.cross_validate,
            {**where, "name": name, "folds": options.folds},
            cost=len(one.effects) + (one.network or 0) + 2.0,
        )
        for name, one in candidates(options).items()
    ]


def candidates(options: FollowingStudyOptions) -> dict[str, Any]:
    """Those that are compared; a quick study takes few."""
    few = (REFERENCE, "helly", "idm + memory")
    return {name: one for name, one in EVERY.items() if not options.quick or name in few}
