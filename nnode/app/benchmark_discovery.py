"""The diagnosis against hidden truths: ``scripts/benchmark_discovery.py``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf

from nnode.app.benchmark_discovery_page import SUBTITLE, TITLE, blocks_of
from nnode.app.benchmark_discovery_task import diagnose_case, sources, task_of
from nnode.config import DiscoveryBenchmarkOptions
from nnode.errors import ConfigError
from nnode.groundtruth import ARMS, Case
from nnode.groundtruth.arms import cases, hides
from nnode.machine import cores
from nnode.pages.page import write_page
from nnode.study.runner import kept_results, run_tasks

#: Arms that need many cases: they show how often something is named where nothing is hidden.
_NOTHING = "nothing"


def benchmark_discovery(config: DictConfig, folder: Path) -> None:
    """Generate, diagnose and score all cases, write the page, and print where it is.

    The page shows all cases that the folder holds, those of earlier runs of the same code too.

    Raises:
        ConfigError: unknown domains, arms or effects, or no case at all.
        StudyError: tasks failed.
        Interrupted: a signal asked to stop; what is done is kept.
    """
    options = cast(DiscoveryBenchmarkOptions, OmegaConf.to_object(config.benchmark_discovery))
    start = time.monotonic()
    chosen = cases_of(options)
    workers = cores() if options.workers is None else options.workers
    if workers < 1:
        raise ConfigError(f"benchmark_discovery.workers={workers} must be at least 1")
    code = sources()
    run_tasks(
        [task_of(case, case.seed < options.first_seed + options.peer_seeds) for case in chosen],
        folder,
        workers=workers,
        fingerprint=code,
        title="diagnoses",
    )
    rows = kept_results(folder, diagnose_case, code)
    paths = write_page(
        blocks_of(list(rows.values()), time.monotonic() - start, workers),
        folder,
        title=TITLE,
        subtitle=SUBTITLE,
        stem="benchmark",
    )
    for path, what in zip(paths, ("page", "as Markdown"), strict=False):
        print(f"{what}: {path}")
    print(f"tables: {sum(p.suffix == '.csv' for p in paths)} CSV files in {folder}")


def cases_of(options: DiscoveryBenchmarkOptions) -> list[Case]:
    """The cases that the options ask for.

    Raises:
        ConfigError: unknown names, numbers that make no sense, or no case.
    """
    for name in ("seeds", "nothing_seeds"):
        if getattr(options, name) < 1:
            raise ConfigError(f"benchmark_discovery.{name} must be at least 1")
    known = {
        name
        for domain in options.domains
        for arm in ARMS
        for item in hides(domain, arm)
        for name in item.effects
    }
    strange = sorted(set(options.effects or ()) - known)
    if strange:
        raise ConfigError(
            f"benchmark_discovery.effects: {strange[0]} is hidden nowhere, expected some of "
            f"{', '.join(sorted(known))}"
        )
    found = []
    for domain in options.domains:
        for arm in options.arms or list(ARMS):
            number = options.nothing_seeds if arm == _NOTHING else options.seeds
            found += cases(
                domain,
                arm,
                seeds=range(options.first_seed, options.first_seed + number),
                strengths=options.strengths,
                noises=[None] if options.noises is None else options.noises,
                sizes=options.sizes,
                effects=options.effects,
            )
    if not found:
        raise ConfigError("the benchmark has no case: check its domains, arms and effects")
    return found
