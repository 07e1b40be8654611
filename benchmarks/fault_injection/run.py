"""Misuse, on purpose: ``scripts/fault_injection.py``.

Runs are killed, disks are full, two runs share a folder, files are malformed. What the toolkit
promises then is in ``docs/reliability.md``; here it is tried.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf

from benchmarks.config import FaultInjectionConfig
from benchmarks.fault_injection import disk, fuzz, kills
from benchmarks.fault_injection import folder as one_folder
from benchmarks.fault_injection.campaign import check_names
from benchmarks.fault_injection.report import REPORT, Row, keep, show
from nnode.errors import ConfigError, StudyError
from nnode.machine import how_made
from nnode.program import configuration


def fault_injection(config: DictConfig, folder: Path) -> None:
    """Run the campaigns, print one table, and keep it in ``folder/report.json``.

    A campaign that is run again replaces its rows in the report; the others stay.

    Raises:
        ConfigError: unknown campaigns, or numbers that make no sense.
        StudyError: something was lost; the table tells what.
    """
    options = cast(FaultInjectionConfig, OmegaConf.to_object(config))
    root = configuration().parent
    campaigns: dict[str, Callable[[], list[Row]]] = {
        "kills": lambda: kills.kills(root, folder, options.kills, options.seed, options.jobs),
        "disk": lambda: disk.disk(root, folder, options.jobs),
        "folder": lambda: one_folder.folder(root, folder, options.jobs, options.repeats),
        "fuzz": lambda: fuzz.fuzz(folder, options.inputs, options.seed, options.targets),
    }
    check_names("campaigns", options.campaigns, campaigns)
    if min(options.kills, options.inputs, options.repeats) < 1:
        raise ConfigError("kills, inputs and repeats must be at least 1")
    if not hasattr(os, "fork"):
        raise ConfigError("this script needs a system that can fork processes, such as Linux")
    rows: list[Row] = []
    for name in options.campaigns:
        start = time.monotonic()
        found = campaigns[name]()
        rows = keep(folder, name, found, how_made(("torch", "numpy", "pandas", "pyarrow")))
        lost = sum(len(row.losses) for row in found)
        print(
            f"{name}: {sum(row.tried for row in found)} tried, {lost} lost, "
            f"{time.monotonic() - start:.0f} s",
            flush=True,
        )
    show(rows)
    print(f"report: {folder / REPORT}")
    if any(row.losses for row in rows):
        raise StudyError(f"something was lost; {folder / REPORT} tells what")
