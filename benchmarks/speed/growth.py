"""How a diagnosis grows with the number of sequences: the shape ``diagnosis`` of the benchmark."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from rich.console import Console
from rich.table import Table

from benchmarks.speed.diagnosis import diagnosis_of, platoons
from nnode.plots.style import GREY, curve_style, dress

#: Vehicles of each platoon, and how long it is seen, s.
VEHICLES, SECONDS = 8, 30.0


def diagnosed(sequences: int) -> dict[str, Any]:
    """A diagnosis of so many platoons in a process of its own with one thread.

    Returns:
        A row of the results: wall time and CPU time, s, peak memory, MB, verdict and effects.
    """
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "platoons.npz"
        time, x = platoons(sequences, vehicles=VEHICLES, seconds=SECONDS)
        np.savez(data, time=time, x=x)
        found = diagnosis_of(data)
    return {"shape": "diagnosis", "sequences": sequences, "agents": VEHICLES, **found}


def print_growth(rows: list[dict[str, Any]]) -> None:
    """Times and memory, and both relative to the size before."""
    if not rows:
        return
    table = Table(title=f"diagnosis of platoons, {VEHICLES} vehicles, {SECONDS:g} s")
    for head in ("sequences", "wall (s)", "CPU (s)", "memory (MB)", "time, memory grow by", "says"):
        table.add_column(head, justify="right")
    before: dict[str, Any] | None = None
    for row in rows:
        grown = (
            ""
            if before is None
            else " and ".join(
                f"{row[key] / before[key]:.2g}" for key in ("wall_s", "peak_memory_MB")
            )
            + f" (sequences {row['sequences'] / before['sequences']:.2g})"
        )
        table.add_row(
            f"{row['sequences']:,}",
            f"{row['wall_s']:.1f}",
            f"{row['cpu_s']:.1f}",
            f"{row['peak_memory_MB']:,.0f}",
            grown,
            f"{row['verdict']}: {', '.join(row['effects'])}",
        )
        before = row
    Console(width=120).print(table)


def draw_growth(ax: Axes, rows: list[dict[str, Any]]) -> None:
    """Wall time and memory against the number of sequences, both axes logarithmic, with lines
    through the first size that are proportional to it."""
    number = [row["sequences"] for row in rows]
    for i, (key, scale, label) in enumerate(
        (("wall_s", 1.0, "time (s)"), ("peak_memory_MB", 1e-3, "peak memory (GB)"))
    ):
        values = [scale * row[key] for row in rows]
        ax.plot(number, values, label=label, gid=key, **{**curve_style(i), "markersize": 4.5})
        line = [values[0] * n / number[0] for n in number]
        ax.plot(number, line, color=GREY, linewidth=0.7, label="slope 1" if i else None, zorder=1)
    ax.set(xscale="log", yscale="log")
    dress(ax, x="sequences", y="", title=f"diagnosis: {VEHICLES} cars, {SECONDS:g} s, one thread")
    ax.legend(frameon=False, fontsize="small")
