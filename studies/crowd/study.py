"""Section 6 of the paper: social force and networks, and what the paper leaves open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from nnode.errors import ConfigError
from nnode.pages.page import Block
from studies.crowd import conventions, tasks
from studies.crowd.data import ALL, prepare_horizon
from studies.crowd.page import blocks
from studies.crowd.page_conventions import NETWORKS, network_key, to_calibrate
from studies.crowd.results import Crowd
from studies.options import CrowdStudyOptions
from studies.runner import Task, hash_of, run_tasks

TITLE = "Crowd: social force and networks in a two-way corridor"
SUBTITLE = (
    "Section 6 of Göttlich & Totzeck, *Optimal control for interacting particle systems driven "
    "by neural networks*, on the same recording, printed numbers beside ours."
)

#: Resamples in one task.
CHUNK = 10
#: Relative times of the tasks.
_COSTS = {"sf": 3.0, "nn": 20.0, "wall": 10.0, "convention": 8.0}


def run(options: CrowdStudyOptions, folder: Path) -> list[Block]:
    """Compute what is missing and make the page.

    Horizons are calibrated one after the other, each from what the shorter one found.

    Raises:
        ConfigError: an option out of its range.
        DataError: recordings that cannot be read, or a horizon longer than anyone is in view.
        StudyError: tasks failed.
    """
    options = _checked(options)
    stores = {
        (kind, horizon): prepare_horizon(
            options.source,
            options.download or str(folder / "data" / "raw"),
            horizon,
            folder / "data" / f"{kind}-{horizon:g}s",
            others=kind == "others",
        )
        for horizon in options.horizons
        for kind in ("main", "others")
    }
    raw = conventions.recording_file(options.source, options.download or str(folder / "data/raw"))
    study = Crowd(options, stores, raw)
    for number in range(len(options.horizons) + 1):
        assert options.workers is not None
        found = run_tasks(
            _round(study, number),
            folder,
            workers=options.workers,
            fingerprint=hash_of({f"{kind}-{h:g}": s for (kind, h), s in stores.items()}),
            title=f"crowd study, part {number + 1} of {len(options.horizons) + 1}",
        )
        study.found.update(found)
    return blocks(study)


def _checked(options: CrowdStudyOptions) -> CrowdStudyOptions:
    if options.quick:
        options = replace(
            options,
            horizons=options.horizons[:3:2],
            restarts=1,
            folds=2,
            bootstrap=4,
            steps=1,
            cuts=1,
        )
    for name, least in (("restarts", 1), ("folds", 2), ("bootstrap", 2), ("steps", 1), ("cuts", 1)):
        if getattr(options, name) < least:
            raise ConfigError(f"study.{name}={getattr(options, name)} must be at least {least}")
    if not options.horizons or min(options.horizons) <= 0:
        raise ConfigError(f"study.horizons={options.horizons}: expected positive times in s")
    return replace(options, horizons=sorted(set(options.horizons)))


def starts(restarts: int, kind: str, scope: str, first: bool) -> int:
    """Starts of one model at the first horizon; fewer, the best ones, go on to longer ones."""
    if scope == ALL:
        number = restarts if kind != "wall" else max(1, restarts // 2)
        return number if first else max(1, number // 2)
    return max(1, restarts // 4) if first and kind == "nn" else 1


def _round(study: Crowd, number: int) -> list[Task]:
    """Calibrations at horizon ``number``; intervals and other runs at the one before."""
    found: list[Task] = []
    horizons = study.options.horizons
    if number < len(horizons):
        found += [
            task
            for kind in tasks.KINDS
            for scope in study.scopes
            for task in _fits(study, kind, scope, number)
        ]
        found.append(
            Task(
                f"baselines-{horizons[number]:g}s",
                tasks.baselines,
                {"folder": study.folder("main", horizons[number])},
            )
        )
    if number > 0:
        found += _after(study, horizons[number - 1])
    if number < 2:
        found += _networks(study) if number else _scans(study)
    return found


def _scans(study: Crowd) -> list[Task]:
    """Every convention that the paper leaves open."""
    how = {"cuts": study.options.cuts, "seed": study.options.seed}
    return [
        Task(
            conventions.key(one),
            conventions.scan,
            {**conventions.arguments(study.raw, one), **how},
            cost=_COSTS["convention"],
        )
        for one in conventions.EVERY
    ]


def _networks(study: Crowd) -> list[Task]:
    """The networks in the conventions nearest to the printed cost."""
    options = study.options
    return [
        Task(
            network_key(one, model, options.seed + i),
            conventions.network,
            {
                **conventions.arguments(study.raw, one),
                "model": model,
                "seed": options.seed + i,
                "steps": options.steps,
            },
            cost=_COSTS["nn"],
        )
        for one in to_calibrate(study)
        for model in NETWORKS
        for i in range(max(1, options.restarts // 4))
    ]


def _fits(study: Crowd, kind: str, scope: str, number: int) -> list[Task]:
    options, horizon = study.options, study.options.horizons[number]
    count = starts(options.restarts, kind, scope, number == 0)
    begin: list[tuple[int, list[float] | None]]
    if number == 0:
        begin = [(options.seed + i, None) for i in range(count)]
    else:
        before = study.fits(kind, scope, options.horizons[number - 1])
        begin = [(one.seed, one.row) for one in before[:count]]
    where: dict[str, Any] = {
        "kind": kind,
        "folder": study.folder("main", horizon),
        "scope": scope,
        "folds": options.folds,
        "span": list(study.span),
        "steps": options.steps,
    }
    return [
        Task(
            study.key(kind, scope, horizon, seed),
            tasks.fit,
            {**where, "seed": seed, "start": row},
            cost=_COSTS[kind] * (1.0 if number == 0 else 0.4),
        )
        for seed, row in begin
    ]


def _after(study: Crowd, horizon: float) -> list[Task]:
    options = study.options
    rows = {kind: study.fits(kind, ALL, horizon)[0].row for kind in tasks.KINDS}
    found = [
        Task(
            f"resample-{horizon:g}s-{first}",
            tasks.resample,
            {
                "folder": study.folder("main", horizon),
                "row": rows["sf"],
                "draws": options.bootstrap,
                "first": first,
                "last": min(first + CHUNK, options.bootstrap),
                "seed": options.seed,
            },
            cost=5.0,
        )
        for first in range(0, options.bootstrap, CHUNK)
    ]
    rows["nn"] = study.network(ALL, horizon).row
    other = {"folder": study.folder("others", horizon), "rows": rows}
    return [*found, Task(f"transfer-{horizon:g}s", tasks.transfer, other, cost=8.0)]
