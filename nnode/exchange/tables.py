"""A run's results as tidy CSV with one value per row."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from nnode.calibrate.checkpoint import Checkpoint
from nnode.calibrate.evaluate import Metrics
from nnode.files import csv_text, write_text
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
    parameters = [
        {"parameter": name, "value": float(value), "unit": of}
        for name, (value, of) in model.physical().items()
    ]
    history = [
        {"epoch": row.get("epoch"), "quantity": name, "value": value}
        for row in checkpoint.history
        for name, value in row.items()
        if name != "epoch"
    ]
    part = {name: key for key, names in checkpoint.split.items() for name in names}
    sequences = [
        {"sequence": name, "part": part.get(name, ""), "cost": cost, "unit": unit}
        for name, cost in metrics.costs.items()
    ]
    horizons = [
        {"time_s": row["t"], "rmse_m": row["rmse"], "samples": row["n"]} for row in metrics.horizons
    ]
    tables: dict[str, tuple[list[dict[str, Any]], list[str]]] = {
        "parameters": (parameters, ["parameter", "value", "unit"]),
        "history": (history, ["epoch", "quantity", "value"]),
        "sequences": (sequences, ["sequence", "part", "cost", "unit"]),
        "horizons": (horizons, ["time_s", "rmse_m", "samples"]),
    }
    return [
        write_csv(folder / f"{name}.csv", pd.DataFrame(rows, columns=columns))
        for name, (rows, columns) in tables.items()
    ]


def write_csv(path: Path, table: pd.DataFrame) -> Path:
    """Write a table, with full precision and without row numbers."""
    return write_text(path, csv_text(table))
