"""Forces of a crowd model as contour plots over the relative position.

The sign of a force is explained in :mod:`nnode.plots.interaction`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.model import System
from nnode.model.extend import omitted_effects
from nnode.plots.interaction import (
    Part,
    Vector,
    chosen_part,
    describe,
    evaluate_force,
    force_range,
    interaction,
)
from nnode.plots.style import DIVERGING, FONT, GREY, colour_bar, dress, new_figure, thinned

#: Velocity differences (m/s) of the four contour panels. The paper names (2, 0) as its example
#: and leaves the others open; these are the encounters of two people who walk at 1 m/s.
ENCOUNTERS: dict[Vector, str] = {
    (0.0, 0.0): "same velocity",
    (2.0, 0.0): "head-on along x",
    (0.0, 2.0): "head-on along y",
    (1.0, 1.0): "crossing",
}

HEAD_ON = (2.0, 0.0)

#: Half widths (m) of the contour panels in the paper: short and long ranged forces.
EXTENT = {"short": 0.5, "long": 4.0}
#: Largest number of measured pairs in a figure.
POINTS = 1500
#: An even number keeps the grid off the origin, where a repulsion has no direction.
GRID = 160
#: The colour scale ends at this percentile of |F| if the peak is at least PEAK times as high.
SCALE_PERCENTILE = 98.0
PEAK = 3.0


def force_contours(
    system: System, component: int, *, extent: float | None = None, part: Part | None = None
) -> Figure:
    """Four filled contour plots of one force component over the relative position.

    The panels differ in the relative velocity: (0, 0), (2, 0), (0, 2) and (1, 1) m/s, see
    ``ENCOUNTERS``. All share one symmetric scale; lines are solid where the force is positive
    and dashed where it is negative, and a circle marks contact of two social-force bodies.
    If a narrow peak is much higher than other forces, the scale ends below it, and the title states
    its height.

    Args:
        component: 0 for F_x, 1 for F_y.
        extent: half width of the panels, m; 0.5 for the social force, else 4.
        part: see :func:`evaluate_force`.

    Raises:
        ConfigError: an extent that is not positive, or a model without this force.

    Source: Göttlich & Totzeck, figures (HelbingG1), (HelbingG2), (NN_G1), (NN_G2).
    """
    figure = new_figure(6.4, 6.2)
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    panels = [(ax, dv, component) for ax, dv in zip(axes.flat, ENCOUNTERS, strict=True)]
    _contours(figure, system, panels, extent, part)
    for ax, (dv, what) in zip(axes.flat, ENCOUNTERS.items(), strict=True):
        _label(ax, "" if part == "wall" else f"{what}, ", dv, "w" if part == "wall" else "j")
    return figure


def relative_positions(sequences: Iterable[Sequence]) -> np.ndarray:
    """``(P, 2)`` x_i - x_j (m) of people of one sequence and time, evenly thinned out to at most
    :data:`POINTS` pairs within the widest figure."""
    parts = [np.empty((0, 2))]
    for s in sequences:
        away = s.x[:, :, None] - s.x[:, None]
        parts.append(away[:, ~np.eye(s.n_agents, dtype=bool)].reshape(-1, 2))
    points = np.concatenate(parts)
    points = points[np.abs(points).max(1, initial=0.0) <= max(EXTENT.values())]
    return thinned(points, POINTS)


def head_on_figure(system: System, *, points: np.ndarray | None = None) -> Figure:
    """Both force components for v_i - v_j = (2, 0) m/s, as :func:`force_contours` draws them.

    Args:
        points: ``(P, 2)`` measured relative positions, m, drawn as dots.
    """
    figure = new_figure(7.2, 3.6)
    axes = figure.subplots(1, 2, sharey=True)
    _contours(figure, system, [(axes[c], HEAD_ON, c) for c in (0, 1)], None, None)
    for ax, letter in zip(axes, "xy", strict=True):
        if points is not None:
            limits = ax.get_xlim(), ax.get_ylim()
            ax.scatter(*points.T, s=1.5, color=GREY, alpha=0.35, linewidths=0, gid="measured")
            ax.set(xlim=limits[0], ylim=limits[1])
        _label(ax, f"$F_{letter}$, ", HEAD_ON)
    return figure


def _label(ax: Axes, what: str, dv: Vector, other: str = "j") -> None:
    """Title and labels of a panel; ``other`` is j for a person and w for a wall point."""
    dress(
        ax,
        x=f"$x_i - x_{other}$ (m)",
        y=f"$y_i - y_{other}$ (m)",
        title=f"{what}$v_i - v_{other}$ = ({dv[0]:g}, {dv[1]:g}) m/s",
        grid=False,
    )
    ax.label_outer()


def _contours(
    figure: Figure,
    system: System,
    panels: list[tuple[Axes, Vector, int]],
    extent: float | None,
    part: Part | None,
) -> None:
    """Fill ``panels`` (axes, relative velocity, component) on one symmetric scale."""
    term = interaction(system)
    half = EXTENT[force_range(term)] if extent is None else float(extent)
    if not 0 < half < np.inf:
        raise ConfigError(f"extent must be a positive half width in m, got {extent!r}")
    side = np.linspace(-half, half, GRID)
    dx = np.stack(np.meshgrid(side, side), -1)
    fields = [
        evaluate_force(system, dx, np.broadcast_to(dv, dx.shape), part)[..., c]
        for _, dv, c in panels
    ]
    levels, extend, peak = _levels(np.stack(fields))
    contact = None
    if term.entry == "social_force":
        radius = float(term.r)  # type: ignore[arg-type]
        contact = radius if chosen_part(term, part) == "wall" else 2 * radius
    lines = levels[levels > 0][:: max(1, len(levels) // 8)]
    filled: Any = None
    for (ax, *_), field in zip(panels, fields, strict=True):
        shown = np.ma.masked_invalid(field)
        filled = ax.contourf(side, side, shown, levels, cmap=DIVERGING, extend=extend)
        _lines(ax, side, shown, -lines[::-1], "dashed")
        _lines(ax, side, shown, lines, "solid")
        if contact is not None:
            ax.add_patch(Circle((0, 0), contact, fill=False, color=GREY, linewidth=0.8))
        ax.set_aspect("equal")
    letters = sorted({"xy"[c] for _, _, c in panels})
    name = f"force on i, {' and '.join(f'$F_{letter}$' for letter in letters)} (N)"
    bar = colour_bar(figure, filled, (ax for ax, *_ in panels), name, shrink=0.85)
    middles = (levels[1:] + levels[:-1]) / 2
    # every second colour, among them the neutral one
    bar.set_ticks([float(m) for m in middles[len(middles) // 2 % 2 :: 2]])
    title = describe(term, part)
    left_out = omitted_effects(system)
    if left_out:
        title += f", {left_out}"
    if contact is not None:
        title += f"; circle: contact at {contact:g} m"
    if extend != "neither":
        title += f"; the scale ends below the peak of {peak:.3g} N"
    broken = 1 - float(np.isfinite(fields).mean())
    if broken:
        title += f" ({broken:.0%} of the field is not finite)"
    figure.suptitle(title, fontsize=FONT)


def _lines(
    ax: Axes, side: np.ndarray, field: np.ma.MaskedArray, levels: np.ndarray, style: str
) -> None:
    """Draw contour lines, whose style shows the sign without colours."""
    values = field.compressed()
    met = [level for level in levels if values.size and values.min() < level < values.max()]
    if met:
        ax.contour(side, side, field, met, colors="black", linewidths=0.5, linestyles=style)


def _levels(fields: np.ndarray) -> tuple[np.ndarray, Any, float]:
    """Levels, the open ends of the scale, and the largest absolute value of a field.

    The levels are shifted by half a step from the multiples of the step, so that forces about zero
    have one neutral colour instead of two.
    """
    size = np.abs(fields[np.isfinite(fields)])
    peak = float(size.max()) if size.size else 0.0
    robust = float(np.percentile(size, SCALE_PERCENTILE)) if size.size else 0.0
    limit = robust if 0 < PEAK * robust < peak else peak or 1.0
    ticks = MaxNLocator(nbins=10, steps=[1, 2, 2.5, 5, 10]).tick_values(0, limit)
    step = float(ticks[1] - ticks[0])
    count = int(np.ceil(limit / step - 0.5))
    levels = (np.arange(-count, count + 2) - 0.5) * step
    return levels, "both" if peak > levels[-1] else "neither", peak
