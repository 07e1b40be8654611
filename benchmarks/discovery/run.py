"""Cases with a known truth, diagnosed or calibrated: ``scripts/benchmark_discovery.py``.

A kind of cases is a module with ``cases``, the arguments of the cases that the options ask for, and
``evaluate``, the rows of one case. Rows go to a CSV file, and one table counts their answers.
"""

from __future__ import annotations

import hashlib
import time
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import pandas as pd
from omegaconf import DictConfig, OmegaConf

import nnode
from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery.verdicts import verdicts
from benchmarks.synthetic_cases.case import first_seed
from nnode.errors import ConfigError
from nnode.machine import cores, how_made
from nnode.pages.page import Block, Heading, Provenance, TableBlock, write_page
from studies.runner import Task, kept_results, run_tasks

#: Modules of this folder by the kinds of cases.
KINDS = {
    "synthetic": "synthetic",
    "rules": "synthetic",
    "advice": "advice",
    "laws": "worlds",
    "sumo": "worlds",
    "jupedsim": "worlds",
    "recovery": "recovery",
}
#: Tables of rows, and the columns by which their answers are counted.
TABLES = {
    "synthetic": (
        "domain",
        "arm",
        "variant",
        "strength",
        "noise",
        "n_sequences",
        "method",
        "thresholds",
    ),
    "coefficients": ("domain", "effect", "coefficient"),
    "worlds": ("program", "diagnosed"),
    "advice": ("data",),
    "recovery": ("simulated by", "law here"),
}
#: Folders on which a result depends: it is computed again when they have changed.
_FOLDERS = (
    "benchmarks/discovery",
    "benchmarks/programs",
    "benchmarks/synthetic_cases",
    *(f"nnode/{name}" for name in ("app", "calibrate", "data", "diagnosis", "model")),
    *(f"nnode/{name}" for name in ("population", "simulation")),
)
_PACKAGES = ("torch", "numba", "numpy", "scipy", "scikit-learn", "pysindy")


def module_of(kind: str) -> Any:
    """The module of a kind.

    Its ``cases(kind, options, first)`` are arguments by the case's unique key, where ``first`` is
    the first seed; ``evaluate(**arguments)`` are rows of one case by table of :data:`TABLES`.

    Raises:
        ConfigError: an unknown kind.
    """
    if kind not in KINDS:
        raise ConfigError(f"benchmark_discovery.kinds: expected some of {', '.join(KINDS)}")
    return import_module(f"benchmarks.discovery.{KINDS[kind]}")


def benchmark_discovery(config: DictConfig, folder: Path) -> None:
    """Compute all cases, write the page, and print where it is.

    The page shows all cases of the same origin of seeds (a commit, or none) that the folder holds,
    those of earlier runs of the same code too.

    Raises:
        ConfigError: unknown names, an invalid hash of a commit, no case, or packages are missing.
        StudyError: tasks failed.
        Interrupted: a signal asked to stop; finished cases are kept.
    """
    options = cast(DiscoveryBenchmarkOptions, OmegaConf.to_object(config.benchmark_discovery))
    start, code = time.monotonic(), sources()
    first = options.first_seed if options.seeds_of is None else first_seed(options.seeds_of)
    if options.seeds_of is not None and options.first_seed:
        raise ConfigError(
            f"benchmark_discovery.first_seed={options.first_seed} beside seeds_of: expected one of "
            "them, because the seeds follow from the commit"
        )
    workers = cores() if options.workers is None else options.workers
    if min(options.seeds, options.nothing_seeds, workers) < 1:
        raise ConfigError("seeds, nothing_seeds and workers must be at least 1")
    tasks = [
        Task(key, evaluate, {"kind": kind, "seeds_of": options.seeds_of, "arguments": arguments})
        for kind in options.kinds
        for key, arguments in module_of(kind).cases(kind, options, first).items()
    ]
    if not tasks:
        raise ConfigError("the benchmark has no case: check its domains, arms, variants, effects")
    run_tasks(
        tasks,
        folder,
        workers=workers,
        fingerprint=code,
        cluster=options.cluster,
        title="cases",
    )
    tables_of = {
        key: case["tables"]
        for key, case in kept_results(folder, evaluate, code).items()
        if case["seeds_of"] == options.seeds_of
    }
    blocks: list[Block] = []
    for name, by in TABLES.items():
        rows = pd.DataFrame(
            [
                {"key": key, **row}
                for key, tables in tables_of.items()
                for row in tables.get(name, ())
            ]
        )
        if len(rows):
            counted = verdicts(rows, by)
            caption = "Shares with exact intervals of 95 %. The file holds one line per row."
            blocks += [Heading(name), TableBlock(name, counted, caption, full=rows)]
    origin = "development: rules may have changed after these cases were seen"
    if options.seeds_of is not None:
        origin = f"from the hash of the commit that froze the rules, {options.seeds_of}"
    seconds = time.monotonic() - start
    facts = {
        "Cases": f"{len(tables_of)}, {origin}",
        "Code": f"digest {code}",
        "Time": f"{seconds:.0f} s in this run with {workers} worker process(es)",
        **how_made(_PACKAGES),
    }
    page, *_ = paths = write_page(
        [*blocks, Provenance(facts)],
        folder,
        title="The diagnosis on cases with a known truth",
        stem="benchmark",
    )
    print(f"page: {page}")
    print(f"tables: {sum(p.suffix == '.csv' for p in paths)} CSV files in {folder}")


def evaluate(kind: str, seeds_of: str | None, arguments: dict[str, Any]) -> dict[str, Any]:
    """The rows of one case of a kind, by table."""
    return {"seeds_of": seeds_of, "tables": module_of(kind).evaluate(**arguments)}


def sources() -> str:
    """A digest of all code that takes part: kept results of other code do not hold."""
    # the package may be installed elsewhere, the benchmarks never are
    root = {"nnode": Path(nnode.__file__).parents[1], "benchmarks": Path(__file__).parents[2]}
    digest = hashlib.sha256()
    for folder in _FOLDERS:
        top = root[folder.partition("/")[0]]
        paths = [*(top / folder).rglob("*.py"), *(top / folder).rglob("*.yaml")]
        for path in sorted(paths):
            digest.update(path.relative_to(top).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
