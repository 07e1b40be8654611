"""Section 6 of the paper: social force and networks, and what the paper leaves open."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nnode.pages.page import Block
from studies.crowd import tasks
from studies.crowd.data import ALL, GROUP, mean_speed, prepared
from studies.crowd.forces import FAR
from studies.crowd.results import LABELS, PARTS, Crowd
from studies.frame import computed
from studies.options import CrowdStudyOptions
from studies.page import page
from studies.runner import Task
from studies.stores import sequences

TITLE = "Crowd: social force and networks in a two-way corridor"
SUBTITLE = (
    "Section 6 of Göttlich & Totzeck, *Optimal control for interacting particle systems driven "
    "by neural networks*, on the same recording, with the published values."
)

#: Resamples in one task.
CHUNK = 10
#: Relative times of the calibrations.
_COSTS = {"sf": 3.0, "nn": 20.0, "wall": 10.0}


def run(options: CrowdStudyOptions, folder: Path) -> list[Block]:
    """Compute what is missing and make the page.

    Horizons are calibrated one after the other, each from what the shorter one found.

    Raises:
        DataError: recordings that cannot be read, or a horizon longer than anyone is in view.
        StudyError: tasks failed.
    """
    stores = {
        (kind, h): prepared(options, folder, kind, h)
        for h in options.horizons
        for kind in ("main", "others")
    }
    study = Crowd(options, stores)
    for number, horizon in enumerate(options.horizons):
        for what, make in (
            ("calibration", calibrations),
            ("both networks from the one of the walls", from_walls),
            ("intervals, other runs", evaluations),
        ):
            title = f"crowd study, {horizon:g} s: {what}"
            study.add(horizon, computed(make(study, number), folder, options, stores, title))
    dv, dx = np.abs(study.measured.dv[:, 1]), np.abs(study.measured.dx[:, 1])
    return page(
        "crowd",
        study,
        stores.values(),
        labels=LABELS,
        models=[LABELS[kind] for kind in tasks.KINDS],
        parts=PARTS,
        group=GROUP,
        speed=mean_speed(sequences(study.folder("main", options.horizons[0]))),
        far=FAR,
        fast=100 * (dv >= 1.0).mean(),
        wide=dx.max(),
    )


def starts(restarts: int, kind: str, scope: str, first: bool) -> int:
    """Starts of one model at the first horizon; fewer, the best ones, go on to longer ones."""
    if scope == ALL:
        number = restarts if kind != "wall" else max(1, restarts // 2)
        return number if first else max(1, number // 2)
    return max(1, restarts // 4) if first and kind == "nn" else 1


def calibrations(study: Crowd, number: int) -> list[Task]:
    """Model × part that trains × start at horizon ``number``, and what needs no calibration."""
    options, horizon = study.options, study.options.horizons[number]
    where = {"folder": study.folder("main", horizon)}
    every = [Task(f"baselines-{horizon:g}s", tasks.baselines, where)]
    for kind in tasks.KINDS:
        for scope in study.scopes:
            count = starts(options.restarts, kind, scope, number == 0)
            begin: list[tuple[int, list[float] | None]]
            begin = [(options.seed + i, None) for i in range(count)]
            if number:
                before = study.fits(kind, scope, options.horizons[number - 1])
                begin = list(zip(before["seed"], before["row"], strict=True))[:count]
            every += [_fit(study, number, kind, scope, seed, row) for seed, row in begin]
    return every


def from_walls(study: Crowd, number: int) -> list[Task]:
    """Both networks, from the best network of the walls alone and no force between people.

    The walls' network alone is a special case of both networks. A search that begins at it cannot
    end at a higher training cost, which searches from random starts do. These starts are numbered
    after the random ones.
    """
    horizon, seed = study.options.horizons[number], study.options.seed
    return [
        _fit(
            study,
            number,
            "nn",
            scope,
            seed + study.options.restarts + number,
            study.best("wall", scope, horizon)["row"],
        )
        for scope in study.scopes
    ]


def _fit(
    study: Crowd, number: int, kind: str, scope: str, seed: int, start: list[float] | None
) -> Task:
    """The calibration of one model from one start at horizon ``number``."""
    options, horizon = study.options, study.options.horizons[number]
    return Task(
        f"fit-{kind}-{scope}-{horizon:g}s-{seed}",
        tasks.fit,
        {
            "folder": study.folder("main", horizon),
            "folds": options.folds,
            "span": list(study.span),
            "steps": options.steps,
            "kind": kind,
            "scope": scope,
            "seed": seed,
            "start": start,
        },
        cost=_COSTS[kind] * (0.4 if number else 1.0),
    )


def evaluations(study: Crowd, number: int) -> list[Task]:
    """Refits to resampled stretches of time, and costs in other runs."""
    options, horizon = study.options, study.options.horizons[number]
    rows = {kind: study.best(kind, ALL, horizon)["row"] for kind in tasks.KINDS}
    where: dict[str, Any] = {"folder": study.folder("main", horizon), "row": rows["sf"]}
    where |= {"draws": options.bootstrap, "seed": options.seed}
    refits = [
        Task(
            f"resample-{horizon:g}s-{first}",
            tasks.resample,
            where | {"first": first, "last": min(first + CHUNK, options.bootstrap)},
            cost=5.0,
        )
        for first in range(0, options.bootstrap, CHUNK)
    ]
    other = {"folder": study.folder("others", horizon), "rows": rows}
    return [*refits, Task(f"transfer-{horizon:g}s", tasks.transfer, other, cost=8.0)]
