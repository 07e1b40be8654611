"""Residual maps: deviations of the model from the data, before and after effects were added."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nnode.diagnosis.report.deviation import Deviation
from nnode.plots.style import DIVERGING, SEQUENTIAL, colour_bar, dress, new_figure

#: Smallest and largest number of cells along a side of a coloured map, with about PER_CELL values
#: in each.
CELLS, PER_CELL = (12, 48), 3
#: Largest height of a map of a plane, inches.
TALL = 6.5
#: A mean of fewer values is not shown in maps of arrows.
MIN_VALUES = 3
#: The scale of colours and arrows ends at this percentile of the map before.
PERCENTILE = 97.0
#: Shade of cells without data, darker than the neutral colour of the scale.
EMPTY = "#D4D4D4"


def time_space_maps(maps: Mapping[str, Deviation]) -> Figure:
    """Time-space diagrams of a lane, coloured by measured minus simulated speed.

    Args:
        maps: title to deviation, one panel each; the first one sets the scale.
    """
    first = next(iter(maps.values()))
    cells = _number(first)
    edges = (_edges(first.time, cells), _edges(first.position[:, 0], cells))
    return _coloured(
        {name: (d.time, d.position[:, 0], d.value[:, 0]) for name, d in maps.items()},
        edges,
        ("clock time (s)", "position along the lane (m)"),
    )


def approach_maps(maps: Mapping[str, Deviation]) -> Figure:
    """Measured minus simulated speed by the gap and by how fast the vehicle ahead draws away."""
    first = next(iter(maps.values()))
    # extreme values would leave few cells for most of the data
    cells = min(_number(first), 24)
    edges = tuple(
        _edges(np.clip(c, *np.nanpercentile(c, [1, 99])) if np.isfinite(c).any() else c, cells)
        for c in first.neighbour.T
    )
    return _coloured(
        {name: (*d.neighbour.T, d.value[:, 0]) for name, d in maps.items()},
        (edges[0], edges[1]),
        ("gap (m)", "speed of the vehicle ahead minus own (m/s)"),
    )


def plane_maps(maps: Mapping[str, Deviation], walls: np.ndarray | None) -> Figure:
    """Mean measured minus simulated acceleration by place, as arrows, with the walls.

    Args:
        maps: title to deviation, one panel each; the first one sets the scale.
        walls: ``(W, 4)`` segments x1, y1, x2, y2, m.
    """
    first = next(iter(maps.values()))
    panels = {name: (d.position, d.value) for name, d in maps.items()}
    return _arrows(panels, first.position, ("x (m)", "y (m)"), walls=walls)


def neighbour_maps(maps: Mapping[str, Deviation]) -> Figure:
    """Mean deviation of acceleration by where the nearest person is, seen in one's own way."""
    near = {name: np.abs(d.neighbour).max(1, initial=0) <= 3 for name, d in maps.items()}
    panels = {
        name: (d.neighbour[near[name]], d.walking_frame[near[name]]) for name, d in maps.items()
    }
    places = next(iter(panels.values()))[0]
    labels = ("nearest person ahead (m)", "nearest person on the left (m)")
    return _arrows(panels, places, labels, person=True)


def draw_walls(ax: Axes, walls: np.ndarray | None) -> None:
    """Walls as thick lines."""
    for x1, y1, x2, y2 in [] if walls is None else walls:
        ax.plot([x1, x2], [y1, y2], color="black", linewidth=2, solid_capstyle="butt", zorder=1)


def _number(map_: Deviation) -> int:
    return int(np.clip(np.sqrt(len(map_.time) / PER_CELL), *CELLS))


def _edges(values: np.ndarray, cells: int) -> np.ndarray:
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    return np.linspace(low, high if high > low else low + 1.0, cells + 1)


def _cells(
    x: np.ndarray, y: np.ndarray, value: np.ndarray, edges: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Mean value and number of values in every cell ``(x, y)``; NaN where there is none."""
    real = np.isfinite(x) & np.isfinite(y) & np.isfinite(value)
    bins = [edges[0], edges[1]]
    number, *_ = np.histogram2d(x[real], y[real], bins)
    total, *_ = np.histogram2d(x[real], y[real], bins, weights=value[real])
    with np.errstate(invalid="ignore", divide="ignore"):
        return total / number, number


def _limit(fields: list[np.ndarray]) -> float:
    sizes = np.abs(fields[0][np.isfinite(fields[0])])
    return float(np.percentile(sizes, PERCENTILE)) if sizes.any() else 1.0


def _coloured(
    panels: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    edges: tuple[np.ndarray, np.ndarray],
    labels: tuple[str, str],
) -> Figure:
    figure = new_figure(4.7 * len(panels) + 0.6, 3.9)
    axes = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    means = [_cells(*columns, edges)[0] for columns in panels.values()]
    limit = _limit(means)
    mesh: Any = None
    for ax, (name, (_, _, value)), mean in zip(axes, panels.items(), means, strict=True):
        ax.set_facecolor(EMPTY)
        mesh = ax.pcolormesh(
            *edges,
            np.ma.masked_invalid(mean.T),
            cmap=DIVERGING,
            vmin=-limit,
            vmax=limit,
            rasterized=True,
        )
        title = f"{name}: {_rms(value):.2g} m/s rms"
        dress(ax, x=labels[0], y=labels[1], title=title, grid=False)
        ax.label_outer()
    colour_bar(figure, mesh, axes, "measured − simulated speed (m/s)", extend="both")
    return figure


def _arrows(
    panels: Mapping[str, tuple[np.ndarray, np.ndarray]],
    places: np.ndarray,
    labels: tuple[str, str],
    *,
    walls: np.ndarray | None = None,
    person: bool = False,
) -> Figure:
    finite = places[np.isfinite(places).all(1)]
    finite = finite if len(finite) else np.array([[-1.0, -1.0], [1.0, 1.0]])
    low, high = np.percentile(finite, [0.5, 99.5], axis=0)
    size = max(float((high - low).max()), 1e-6)
    # squares of about a step's length, at most 24 along the longer side
    side = max(size / 24, 0.4)
    edges = tuple(np.arange(a - side / 2, b + side, side) for a, b in zip(low, high, strict=True))
    ends = np.vstack([[low, high], np.empty((0, 2)) if walls is None else walls.reshape(-1, 2)])
    across, along = np.ptp(ends, axis=0)
    wide = across > 1.6 * along
    rows, columns = (len(panels), 1) if wide else (1, len(panels))
    ratio = float(np.clip(along / max(across, 1e-6), 0.25, 1.6))
    width = min(8.0 / columns if columns > 1 else 7.2, TALL / ratio)
    figure = new_figure(width * columns + 1.0, (0.92 * width * ratio + 0.5) * rows + 0.3)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    fields = []
    for place, value in panels.values():
        (u, number), (v, _) = (
            _cells(place[:, 0], place[:, 1], value[:, i], (edges[0], edges[1])) for i in (0, 1)
        )
        many = number >= MIN_VALUES
        fields.append((np.where(many, u, np.nan), np.where(many, v, np.nan)))
    limit = _limit([np.hypot(u, v) for u, v in fields])
    middle = np.meshgrid(*((e[1:] + e[:-1]) / 2 for e in edges), indexing="ij")
    drawn: Any = None
    for ax, (name, (_, value)), (u, v) in zip(axes, panels.items(), fields, strict=True):
        draw_walls(ax, walls)
        length = np.hypot(u, v)
        short = np.minimum(1, limit / np.maximum(length, 1e-12)) * side / limit
        drawn = ax.quiver(
            *middle,
            u * short,
            v * short,
            length,
            cmap=SEQUENTIAL,
            clim=(0, limit),
            angles="xy",
            scale_units="xy",
            scale=1,
            pivot="mid",
            width=0.004,
            zorder=3,
        )
        if person:
            ax.plot(0, 0, marker=(3, 0, -90), color="black", markersize=11)
        ax.set_aspect("equal")
        rms = _rms(np.linalg.norm(value, axis=1))
        dress(ax, x=labels[0], y=labels[1], title=f"{name}: {rms:.2g} m/s² rms")
        ax.label_outer()
    label = "mean of measured − simulated\nacceleration (m/s²)"
    colour_bar(figure, drawn, axes, label, extend="max")
    return figure


def _rms(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")
