"""Time against the size of the problem."""

from __future__ import annotations

from typing import Any

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
    "wall_s": ("time of a diagnosis", 0, False),
    "peak_memory_MB": ("peak memory (GB)", 1, False),
}
#: Shapes of a panel, the number by which they differ, and the label of the axis.
_PANELS = (
    (("steps",), "steps", "Euler steps"),
    (("people", "scale"), "agents", "people"),
    (("diagnosis",), "sequences", "sequences"),
)


def performance_figure(results: dict[str, Any]) -> Figure | None:
    """Time of one gradient against the number of steps and of people; time and memory of a
    diagnosis against the number of sequences.

    Points are medians, bars reach from the fastest to the slowest repeat, both axes are
    logarithmic. The thin grey line is proportional to the number on the horizontal axis.

    Args:
        results: the content of ``benchmark.json``, see :func:`benchmarks.speed.run.benchmark`.

    Returns:
        One panel for every number that differs between at least two problems; None without any.
    """
    panels = []
    for shapes, key, label in _PANELS:
        rows = sorted(
            (row for row in results["problems"] if row["shape"] in shapes), key=lambda row: row[key]
        )
        if len({row[key] for row in rows}) > 1:
            panels.append((key, label, rows))
    if not panels:
        return None
    figure = new_figure(3.4 * len(panels) + 2.3, 3.7)
    curves: dict[str, Any] = {}
    for i, (key, label, rows) in enumerate(panels):
        ax = figure.add_subplot(1, len(panels), i + 1)
        _draw(ax, key, label, rows)
        curves |= {str(curve.get_gid()): curve for curve in ax.lines}
    names = [name for name in (*LOOKS, "slope 1") if name in curves]
    figure.legend(
        [curves[name] for name in names],
        [LOOKS[name][0] if name in LOOKS else name for name in names],
        loc="outside right center",
        fontsize=SMALL_FONT,
        frameon=False,
        handlelength=3.2,
    )
    machine = results["machine"]
    figure.suptitle(f"{machine['processor']}, {results['dtype']}", fontsize=FONT)
    return figure


def _times(row: dict[str, Any]) -> dict[str, tuple[float, float, float]]:
    """Smallest value, median and largest value by curve."""
    if "engines" in row:
        return {name: (t["min"], t["median"], t["max"]) for name, t in row["engines"].items()}
    return {key: (row[key] * s,) * 3 for key, s in (("wall_s", 1.0), ("peak_memory_MB", 1e-3))}


def _draw(ax: Axes, key: str, label: str, rows: list[dict[str, Any]]) -> None:
    """One panel."""
    times = [_times(row) for row in rows]
    lowest = []
    for name in dict.fromkeys(name for each in times for name in each):
        x = [row[key] for row, each in zip(rows, times, strict=True) if name in each]
        low, y, high = zip(*(each[name] for each in times if name in each), strict=True)
        _, index, hollow = LOOKS.get(name, ("", 5, False))
        look = curve_style(index)
        colour = look["color"]
        # a hollow marker is a ring around the full one
        look |= {"markerfacecolor": "none" if hollow else colour, "linewidth": 1.2}
        look |= {"markersize": 7.0 if hollow else 4.5}
        ax.plot(x, y, gid=name, **look)
        bars = [[b - a for a, b in zip(*pair, strict=True)] for pair in ((low, y), (y, high))]
        ax.errorbar(x, y, bars, fmt="none", ecolor=colour, elinewidth=0.8)
        lowest.append(min(t / n for t, n in zip(y, x, strict=True)))
    ax.set(xscale="log", yscale="log")
    ends = [rows[0][key], rows[-1][key]]
    # below all points, so that slopes can be compared without hiding any
    line = [0.5 * min(lowest) * n for n in ends]
    ax.plot(ends, line, color=GREY, linewidth=0.7, gid="slope 1", zorder=1)
    first = rows[0]
    fixed = [f"{first[name]} {name}" for name in ("sequences", "agents", "steps") if name in first]
    fixed = [text for text in fixed if not text.endswith(key)]
    dress(ax, x=label, y="time (s)", title=f"{first.get('model', 'lin')}: {', '.join(fixed)}")
