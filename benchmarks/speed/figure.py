"""Time against the size of the problem."""

from __future__ import annotations

from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nnode.plots.style import FONT, GREY, SMALL_FONT, curve_style, dress, new_figure

#: Curves in the order of the legend: words, index of the style, and whether markers are hollow,
#: which distinguishes two arrangements of one engine.
LOOKS: dict[str, tuple[str, int, bool]] = {
    "odeint_adjoint": ("torchdiffeq, adjoint", 6, False),
    "odeint": ("torchdiffeq, discrete gradient", 4, False),
    "loop": ("loop of PyTorch operations", 3, False),
    "diffrax": ("diffrax", 2, False),
    "diffrax_batch_last": ("diffrax, batch innermost", 2, True),
    "scan": ("JAX lax.scan", 1, False),
    "scan_batch_last": ("JAX lax.scan, batch innermost", 1, True),
    "fused_1": ("fused, 1 thread", 0, False),
    "fused_2": ("fused, 2 threads", 0, True),
    "diagnosis": ("time of a diagnosis", 0, False),
}
#: Shapes of a panel, the number by which they differ, and the label of the axis.
_PANELS = (
    (("steps",), "steps", "Euler steps"),
    (("people", "scale"), "agents", "people"),
    (("diagnosis",), "sequences", "sequences"),
)
#: Columns of the results that are drawn.
_COLUMNS = (
    "shape",
    "model",
    "engine",
    "sequences",
    "agents",
    "steps",
    "median",
    "min",
    "max",
)


def performance_figure(results: dict[str, Any]) -> Figure | None:
    """Time of one gradient against the number of steps and of people, and of a diagnosis against
    the number of sequences.

    Points are medians, bars reach from the fastest to the slowest repeat, both axes are
    logarithmic. The thin grey line is proportional to the number on the horizontal axis.

    Args:
        results: the content of ``benchmark.json``, see :func:`benchmarks.speed.run.benchmark`.

    Returns:
        One panel for every number that differs between at least two problems; None without any.
    """
    rows = pd.DataFrame(results["rows"], columns=list(_COLUMNS))
    rows = rows[rows["engine"].isin(LOOKS)]
    panels = [(rows[rows["shape"].isin(shapes)], key, label) for shapes, key, label in _PANELS]
    panels = [(part, key, label) for part, key, label in panels if part[key].nunique() > 1]
    if not panels:
        return None
    figure = new_figure(3.4 * len(panels) + 2.3, 3.7)
    curves: dict[str, Any] = {}
    for i, (part, key, label) in enumerate(panels):
        curves |= _draw(figure.add_subplot(1, len(panels), i + 1), part, key, label)
    names = [name for name in LOOKS if name in curves]
    figure.legend(
        [*(curves[name] for name in names), curves["slope 1"]],
        [*(LOOKS[name][0] for name in names), "slope 1"],
        loc="outside right center",
        fontsize=SMALL_FONT,
        frameon=False,
        handlelength=3.2,
    )
    machine = results["machine"]
    figure.suptitle(f"{machine['processor']}, {results['dtype']}", fontsize=FONT)
    return figure


def _draw(ax: Axes, rows: pd.DataFrame, key: str, label: str) -> dict[str, Any]:
    """One panel; its curves by name."""
    curves: dict[str, Any] = {}
    for name, part in rows.sort_values(key).groupby("engine"):
        _, index, hollow = LOOKS[str(name)]
        look = curve_style(index)
        # a hollow marker is a ring around the full one
        look |= {"markerfacecolor": "none" if hollow else look["color"], "linewidth": 1.2}
        look |= {"markersize": 7.0 if hollow else 4.5, "elinewidth": 0.8}
        bars = [part["median"] - part["min"], part["max"] - part["median"]]
        curves[str(name)] = ax.errorbar(part[key], part["median"], bars, **look)
    ax.set(xscale="log", yscale="log")
    # below all points, so that slopes can be compared without hiding any
    ends = rows[key].agg(["min", "max"])
    below = 0.5 * (rows["median"] / rows[key]).min() * ends
    (curves["slope 1"],) = ax.plot(ends, below, color=GREY, linewidth=0.7, zorder=1)
    first = rows.iloc[0]
    fixed = [
        f"{first[name]:g} {name}"
        for name in ("sequences", "agents", "steps")
        if name != key and pd.notna(first[name])
    ]
    dress(ax, x=label, y="time (s)", title=f"{first['model']}: {', '.join(fixed)}")
    return curves
