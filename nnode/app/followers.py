"""Errors of every follower in lanes, by pair and by driver."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from nnode.calibrate.evaluate import Simulate
from nnode.data.clusters import Index
from nnode.data.sequence import Batch
from nnode.errors import printable
from nnode.files import write_csv
from nnode.plots import traffic
from nnode.plots.style import save

#: Number of printed rows of a table, those with the largest errors.
SHOWN = 10
#: Columns of both tables, with their units.
COLUMNS = {
    "spacing_rmse": "spacing RMSE (m)",
    "spacing_bias": "spacing bias (m)",
    "speed_rmse": "speed RMSE (m/s)",
    "speed_bias": "speed bias (m/s)",
    "final_error": "final error (m)",
}


@torch.no_grad()
def follower_errors(simulate: Simulate, batches: Iterable[Batch], index: Index) -> pd.DataFrame:
    """One row per sequence and follower, over all samples after the first.

    A spacing error is the error of the distance between simulated vehicles, or to a measured
    leader. Biases are simulated minus measured. Speeds of models of first order are forward
    differences, as for data without speeds.

    Args:
        simulate: the model.
        batches: batches of lanes.
        index: index of the sequences, see :func:`nnode.data.clusters.index_of`.

    Returns:
        Columns ``sequence``, ``recording`` (or the site of several), ``driver`` (the identifier,
        or else the sequence and the index in it), ``samples`` and :data:`COLUMNS`.
    """
    entries = {entry["name"]: entry for entry in index}
    rows = []
    for batch in batches:
        trajectory = simulate(batch)
        error = (trajectory.x - batch.x)[..., 0]
        if trajectory.v is None:
            speed, measured = (_slopes(x[..., 0], batch.dt) for x in (trajectory.x, batch.x))
        else:
            speed, measured = trajectory.v[..., 0], batch.v[..., 0]
        speed_error = speed - measured
        for b, name in enumerate(batch.names):
            entry = entries[name]
            for n in range(int(batch.agent[b].sum()) - 1):
                valid = batch.valid[:, b, n].numpy(force=True)
                k = np.flatnonzero(valid)[1:]
                gap = (error[:, b, n + 1] - error[:, b, n]).numpy(force=True)[k]
                speed_error_at = speed_error[:, b, n].numpy(force=True)[k]
                rows.append(
                    {
                        "sequence": name,
                        "recording": entry.get("site") or entry["recording"],
                        "driver": entry["agents"][n] if entry["agents"] else f"{name} {n}",
                        "samples": len(k),
                        "spacing_rmse": float(np.sqrt((gap**2).mean())),
                        "spacing_bias": float(gap.mean()),
                        "speed_rmse": float(np.sqrt((speed_error_at**2).mean())),
                        "speed_bias": float(speed_error_at.mean()),
                        "final_error": float(abs(error[k[-1], b, n])),
                    }
                )
    return pd.DataFrame(rows)


def _slopes(x: torch.Tensor, dt: float) -> torch.Tensor:
    step = x.diff(dim=0) / dt
    return torch.cat([step, step[-1:]])


def by_driver(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per driver, pooled over all samples of the driver's sequences."""
    squares, biases = ["spacing_rmse", "speed_rmse"], ["spacing_bias", "speed_bias"]
    pooled = rows[["recording", "driver", "samples", "final_error"]].assign(sequences=1)
    pooled[squares] = (rows[squares] ** 2).mul(rows["samples"], axis=0)
    pooled[biases] = rows[biases].mul(rows["samples"], axis=0)
    sums = pooled.groupby(["recording", "driver"], sort=False).sum()
    sums[squares] = np.sqrt(sums[squares].div(sums["samples"], axis=0))
    sums[biases] = sums[biases].div(sums["samples"], axis=0)
    sums["final_error"] /= sums["sequences"]
    return sums.reset_index()


def write_followers(rows: pd.DataFrame, folder: Path) -> None:
    """Print the largest errors, and write ``pairs.csv``, ``drivers.csv`` and ``pairs.png``."""
    drivers = by_driver(rows)
    heads_of = {"pairs": ("sequence", "driver"), "drivers": ("recording", "driver", "sequences")}
    for (name, heads), table in zip(heads_of.items(), (rows, drivers), strict=True):
        write_csv(folder / f"{name}.csv", table)
        _print(name, table.nlargest(SHOWN, "spacing_rmse"), heads, len(table))
    print(f"plot: {save(traffic.follower_errors(rows), folder / 'pairs.png')}")


def _print(name: str, table: pd.DataFrame, heads: tuple[str, ...], number: int) -> None:
    shown = f"the {len(table)} largest spacing errors of {number}; all in {name}.csv"
    print(f"{name}: {shown}" if number > len(table) else name)
    names = table[[*heads]].map(lambda cell: printable(str(cell)))
    errors = table[[*COLUMNS]].rename(columns=COLUMNS)
    print(names.join(errors).to_string(index=False, float_format="{:.3g}".format))
