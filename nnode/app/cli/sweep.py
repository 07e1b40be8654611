"""What the runs of a sweep came to: one table over all, and which ones failed.

Runs may be other processes, on other machines: only the files that they write tell.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from nnode.calibrate.distributed import World
from nnode.files import write_json

RESULT = "result.json"

#: The sweep of this process: its folder, and the results that lay there before.
_sweep: dict[Path, dict[Path, int]] = {}


def record_failure(folder: Path, error: str) -> None:
    """Note in a run's result that it failed; the other runs of the sweep go on."""
    write_json(folder / RESULT, {"error": error})


def _results(folder: Path) -> dict[Path, int]:
    """Result files of the runs in a folder, with the time of their last change."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob(RESULT)}


def failures() -> list[Path]:
    """Folders of the runs of this process's sweep that failed, wherever they ran."""
    return [
        path.parent
        for folder, before in _sweep.items()
        for path, changed in sorted(_results(folder).items())
        if before.get(path) != changed and "error" in json.loads(path.read_text())
    ]


class SweepFailures(Callback):
    """Remembers where a multi-run writes, for :func:`failures`."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        _sweep[folder] = _results(folder)


class SweepTable(SweepFailures):
    """After a multi-run: gathers every run's result into ``sweep.csv`` and prints it."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        if not World().first:
            return
        folder = Path(config.hydra.sweep.dir)
        rows = []
        for job in sorted(folder.iterdir(), key=lambda p: (len(p.name), p.name)):
            if (job / RESULT).is_file():
                result = json.loads((job / RESULT).read_text())
                rows.append({"run": job.name, **result.pop("summary", result)})
        if not rows:
            return
        table = pd.DataFrame(rows)
        table.to_csv(folder / "sweep.csv", index=False)
        shown = Table(title=f"{len(rows)} runs")
        for column in table.columns:
            shown.add_column(str(column))
        for row in table.itertuples(index=False):
            shown.add_row(*(f"{v:.5g}" if isinstance(v, float) else str(v) for v in row))
        Console(width=None if os.isatty(1) else 160).print(shown)
        print(f"table: {folder / 'sweep.csv'}")
