"""The diagnosis against hidden truths: ``scripts/benchmark_discovery.py``."""

from __future__ import annotations

import time
from importlib.util import find_spec
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery.page import SUBTITLE, TITLE, blocks_of
from benchmarks.discovery.task import diagnose_case, sources, task_of
from benchmarks.synthetic_cases import ARMS, Case
from benchmarks.synthetic_cases.arms import cases, first_seed, hides
from nnode.errors import ConfigError
from nnode.machine import cores
from nnode.pages.page import write_page
from studies.cluster import on_cluster
from studies.runner import kept_results, run_tasks

#: The arm that needs many cases: it shows how often something is named where nothing is hidden.
_NOTHING = "nothing"


def benchmark_discovery(config: DictConfig, folder: Path) -> None:
    """Generate, diagnose and score all cases, write the page, and print where it is.

    The page shows all cases of the same origin of seeds (a commit, or none) that the folder holds,
    those of earlier runs of the same code too.

    Raises:
        ConfigError: unknown domains, arms, variants or effects, no hash of a commit, no case, or
            the peers' packages are not installed.
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
    last_of_peers = _first(options) + options.peer_seeds
    if any(case.seed < last_of_peers for case in chosen):
        _need_peers(options.peer_seeds)
    with on_cluster(options.cluster):
        run_tasks(
            [
                task_of(
                    case,
                    case.seed < last_of_peers,
                    options.seeds_of,
                    options.structure,
                    options.fresh,
                )
                for case in chosen
            ],
            folder,
            workers=workers,
            fingerprint=code,
            title="diagnoses",
        )
    rows = [
        row
        for row in kept_results(folder, diagnose_case, code).values()
        if row["seeds_of"] == options.seeds_of
    ]
    paths = write_page(
        blocks_of(rows, time.monotonic() - start, workers, code),
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
    items = [item for domain in options.domains for arm in ARMS for item in hides(domain, arm)]
    known = {
        "effects": {name for item in items for name in item.effects},
        "variants": {item.variant for item in items},
    }
    for name, words in known.items():
        strange = sorted(set(getattr(options, name) or ()) - words)
        if strange:
            raise ConfigError(
                f"benchmark_discovery.{name}: {strange[0]} is hidden nowhere, expected some of "
                f"{', '.join(sorted(words))}"
            )
    first, found = _first(options), []
    for domain in options.domains:
        for arm in options.arms or list(ARMS):
            number = options.nothing_seeds if arm == _NOTHING else options.seeds
            found += cases(
                domain,
                arm,
                seeds=range(first, first + number),
                strengths=options.strengths,
                noises=[None] if options.noises is None else options.noises,
                sizes=options.sizes,
                effects=options.effects,
                variants=options.variants,
            )
    if not found:
        raise ConfigError("the benchmark has no case: check its domains, arms, variants, effects")
    return found


def _need_peers(seeds: int) -> None:
    """Said before the first diagnosis, not after it."""
    missing = [name for name in ("pysindy", "sklearn") if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"benchmark_discovery.peer_seeds={seeds} needs {' and '.join(missing)}: install "
            "pysindy and scikit-learn (the extra bench), or give 0 for no peers"
        )


def _first(options: DiscoveryBenchmarkOptions) -> int:
    """The first seed.

    Raises:
        ConfigError: given by hand beside a commit, or no full hash.
    """
    if options.seeds_of is None:
        return options.first_seed
    if options.first_seed:
        raise ConfigError(
            f"benchmark_discovery.first_seed={options.first_seed} beside seeds_of: expected one of "
            "them, as a commit tells where its seeds begin"
        )
    return first_seed(options.seeds_of)
