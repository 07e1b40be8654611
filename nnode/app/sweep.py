"""One table over all runs of a sweep."""

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

RESULT = "result.json"

_failed: list[Path] = []


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON so that the file is never half there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(json.dumps(content, indent=2, ensure_ascii=False, allow_nan=True) + "\n")
    os.replace(temporary, path)


def record_failure(folder: Path, error: str) -> None:
    """Note in a run's result that it failed; the other runs of the sweep go on."""
    _failed.append(folder)
    write_json(folder / RESULT, {"error": error})


def failures() -> list[Path]:
    """Folders of the runs of this process that failed."""
    return list(_failed)


class SweepTable(Callback):
    """After a multi-run: gathers every run's result into ``sweep.csv`` and prints it."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
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
