"""Misuse, on purpose: ``scripts/fault_injection.py``.

Runs are killed, disks are full, two runs share a folder, files are malformed. What the toolkit
promises then is in ``docs/reliability.md``; here it is tried.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar, cast

import pandas as pd
from omegaconf import DictConfig, OmegaConf

from benchmarks.config import FaultInjectionConfig
from benchmarks.fault_injection.disk import full_disks
from benchmarks.fault_injection.folder import shared_folders
from benchmarks.fault_injection.fuzz import fuzz
from benchmarks.fault_injection.jobs import Job, jobs
from benchmarks.fault_injection.kills import kills
from benchmarks.fault_injection.row import Row
from benchmarks.fault_injection.targets import Target, targets
from nnode.errors import ConfigError, StudyError
from nnode.files import write_json
from nnode.machine import how_made

REPORT = "report.json"
Tested = TypeVar("Tested", Job, Target)


def fault_injection(config: DictConfig, folder: Path) -> None:
    """Run the campaigns, print one table, and keep it in ``folder/report.json``.

    A campaign that is run again replaces its rows in the report; the others stay. What a campaign
    writes is removed where nothing was lost.

    Raises:
        ConfigError: unknown campaigns, jobs or targets, or numbers that make no sense.
        StudyError: something was lost; the table says what.
    """
    options = cast(FaultInjectionConfig, OmegaConf.to_object(config))

    campaigns = _campaigns(options)
    _check_names("campaigns", options.campaigns, campaigns)
    if min(options.kills, options.inputs, options.repeats) < 1:
        raise ConfigError("kills, inputs and repeats must be at least 1")
    if not hasattr(os, "fork"):
        raise ConfigError("this script needs a system that can fork processes, such as Linux")
    for name in options.campaigns:
        scratch = folder / name
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir(parents=True)
        rows = []
        for row in campaigns[name](scratch):
            rows.append({"campaign": name, **asdict(row)})
            print(f"{name}, {row.what}: {row.tried} tried, {len(row.losses)} lost", flush=True)
        if not any(row["losses"] for row in rows):
            shutil.rmtree(scratch)
        report = _keep(folder / REPORT, name, rows)
    table = pd.DataFrame(report["rows"])
    print(table.assign(losses=table["losses"].str.len()).to_string(index=False))
    for row in report["rows"]:
        for loss in row["losses"]:
            print(f"LOSS {row['campaign']}, {row['what']}: {loss}")
    print(f"report: {folder / REPORT}")
    if report["losses"]:
        raise StudyError(f"something was lost; {folder / REPORT} says what")


def _campaigns(
    options: FaultInjectionConfig,
) -> dict[str, Callable[[Path], Iterator[Row]]]:
    def chosen_jobs(scratch: Path) -> list[Job]:
        return _chosen("jobs", options.jobs, jobs(scratch / "raw"))

    def fuzzed(scratch: Path) -> Iterator[Row]:
        some = _chosen("targets", options.targets, targets(scratch))
        return fuzz(some, scratch, options.inputs, options.seed)

    return {
        "kills": lambda scratch: kills(chosen_jobs(scratch), scratch, options.kills, options.seed),
        "disk": lambda scratch: full_disks(chosen_jobs(scratch), scratch),
        "folder": lambda scratch: shared_folders(chosen_jobs(scratch), scratch, options.repeats),
        "fuzz": fuzzed,
    }


def _keep(path: Path, campaign: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Put a campaign's rows into the report, in the place of its earlier ones; the report."""
    earlier = json.loads(path.read_text(encoding="utf-8"))["rows"] if path.exists() else []
    every = [row for row in earlier if row["campaign"] != campaign] + rows
    report = {
        "rows": every,
        "tried": pd.DataFrame(every).groupby("campaign")["tried"].sum().to_dict(),
        "losses": sum(len(row["losses"]) for row in every),
        "made": {
            "when": time.strftime("%Y-%m-%d %H:%M:%S"),
            **how_made(("torch", "numpy", "pandas", "pyarrow", "hypothesis")),
        },
    }
    write_json(path, report)
    return report


def _chosen(option: str, names: list[str] | None, every: list[Tested]) -> list[Tested]:
    """The jobs or targets of some names; None takes all."""
    by_name = {each.name: each for each in every}
    _check_names(option, names or (), by_name)
    return [by_name[name] for name in names or by_name]


def _check_names(option: str, names: Collection[str], expected: Collection[str]) -> None:
    """Refuse names that there are not.

    Raises:
        ConfigError: with the names that there are.
    """
    strange = sorted(set(names) - set(expected))
    if strange:
        raise ConfigError(
            f"{option}: {strange[0]} is unknown, expected some of {', '.join(expected)}"
        )
