"""Time of a gradient against the size of the problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.speed.growth import draw_growth
from nnode.plots.style import FONT, GREY, SMALL_FONT, curve_style, dress, new_figure

#: Engines in the order of the legend: words, index of the style, and whether markers are hollow,
#: which tells two arrangements of one engine apart.
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
}


@dataclass(frozen=True)
class _Panel:
    """Problems that differ in one number.

    Attributes:
        shapes: names of the benchmark's shapes.
        key: the number by which they differ.
        x: label of the axis.
        agents: what moves.
    """

    shapes: tuple[str, ...]
    key: str
    x: str
    agents: str


_PANELS = (
    _Panel(("steps",), "steps", "Euler steps", "cars"),
    _Panel(("people", "scale"), "agents", "people", "people"),
)


def performance_figure(results: dict[str, Any]) -> Figure | None:
    """Time of one gradient against the number of steps and against the number of people; time and
    memory of a diagnosis against the number of sequences.

    Points are medians, bars reach from the fastest to the slowest repeat, both axes are
    logarithmic. The thin grey line is proportional to the number on the horizontal axis.

    Args:
        results: the content of ``benchmark.json``, see :func:`benchmarks.speed.run.benchmark`.

    Returns:
        One panel for every number that differs between at least two problems; None without any.
    """
    panels = []
    for panel in _PANELS:
        rows = [row for row in results["problems"] if row["shape"] in panel.shapes]
        if len({row[panel.key] for row in rows}) > 1:
            panels.append((panel, sorted(rows, key=lambda row: row[panel.key])))
    grown = [row for row in results["problems"] if row["shape"] == "diagnosis"]
    number = len(panels) + (len(grown) > 1)
    if not number:
        return None
    figure = new_figure(3.4 * number + 2.3 * bool(panels), 3.7)
    shown: set[str] = set()
    for i, (panel, rows) in enumerate(panels):
        shown |= _draw(figure.add_subplot(1, number, i + 1), panel, rows)
    if len(grown) > 1:
        draw_growth(figure.add_subplot(1, number, number), grown)
    names = [name for name in LOOKS if name in shown] + sorted(shown - set(LOOKS))
    handles = [Line2D([], [], label=_label(name), **_style(name)) for name in names]
    handles.append(Line2D([], [], color=GREY, linewidth=0.7, label="slope 1"))
    if panels:
        figure.legend(
            handles=handles,
            loc="outside right center",
            fontsize=SMALL_FONT,
            frameon=False,
            handlelength=3.2,
        )
    machine = results["machine"]
    figure.suptitle(f"{machine['processor']}, {results['dtype']}", fontsize=FONT)
    return figure


def _label(name: str) -> str:
    return LOOKS[name][0] if name in LOOKS else name


def _style(name: str) -> dict[str, Any]:
    _, index, hollow = LOOKS.get(name, ("", 5, False))
    look = curve_style(index)
    return {
        **look,
        "markerfacecolor": "none" if hollow else look["color"],
        "markersize": 7.0 if hollow else 4.5,  # a ring around the other one
        "linewidth": 1.2,
    }


def _draw(ax: Axes, panel: _Panel, rows: list[dict[str, Any]]) -> set[str]:
    """One panel; the engines in it."""
    engines = dict.fromkeys(name for row in rows for name in row["engines"])
    lowest = []
    for name in engines:
        solved = [row for row in rows if name in row["engines"]]
        x = [row[panel.key] for row in solved]
        times = [row["engines"][name] for row in solved]
        y = [time["median"] for time in times]
        below = [time["median"] - time["min"] for time in times]
        above = [time["max"] - time["median"] for time in times]
        look = _style(name)
        ax.plot(x, y, gid=name, **look)
        ax.errorbar(x, y, (below, above), fmt="none", ecolor=look["color"], elinewidth=0.8)
        lowest.append(min(t / n for t, n in zip(y, x, strict=True)))
    ax.set(xscale="log", yscale="log")
    ends = [rows[0][panel.key], rows[-1][panel.key]]
    # below all points, so that slopes can be compared without hiding any
    line = [0.5 * min(lowest) * n for n in ends]
    ax.plot(ends, line, color=GREY, linewidth=0.7, gid="slope 1", zorder=1)
    first = rows[0]
    fixed = [f"{first['sequences']} sequence" + ("s" if first["sequences"] > 1 else "")]
    if panel.key != "agents":
        fixed.append(f"{first['agents']} {panel.agents}")
    if panel.key != "steps":
        fixed.append(f"{first['steps']} steps")
    dress(
        ax,
        x=panel.x,
        y="time of one gradient (s)",
        title=f"{first['model']}: {', '.join(fixed)}",
    )
    return set(engines)
