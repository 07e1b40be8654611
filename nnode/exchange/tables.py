"""A run's results as tidy CSV with one value per row."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from nnode.calibrate.checkpoint import Checkpoint
from nnode.calibrate.evaluate import Metrics
from nnode.files import write_csv
from nnode.model import System


def write_results(
    folder: Path, checkpoint: Checkpoint, model: System, metrics: Metrics, unit: str
) -> list[Path]:
    """``parameters``, ``history``, ``sequences`` and ``horizons``, each ``.csv`` in ``folder``.

    Args:
        folder: folder, created if it is missing.
        checkpoint: gives the history, with one row per epoch and quantity.
        model: the calibrated model.
        metrics: errors of the model on the exported sequences.
        unit: unit of the sequences' costs.
    """
    part = {name: key for key, names in checkpoint.split.items() for name in names}
    tables: dict[str, tuple[list[str], list[tuple[Any, ...]]]] = {
        "parameters": (
            ["parameter", "value", "unit"],
            [(name, float(value), of) for name, (value, of) in model.physical().items()],
        ),
        "history": (
            ["epoch", "quantity", "value"],
            [
                (row.get("epoch"), name, value)
                for row in checkpoint.history
                for name, value in row.items()
                if name != "epoch"
            ],
        ),
        "sequences": (
            ["sequence", "part", "cost", "unit"],
            [(name, part.get(name, ""), cost, unit) for name, cost in metrics.costs.items()],
        ),
        "horizons": (
            ["time_s", "rmse_m", "samples"],
            [(row["t"], row["rmse"], row["n"]) for row in metrics.horizons],
        ),
    }
    return [
        write_csv(folder / f"{name}.csv", pd.DataFrame(rows, columns=columns))
        for name, (columns, rows) in tables.items()
    ]
