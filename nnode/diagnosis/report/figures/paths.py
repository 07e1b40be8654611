"""Paths of one sequence as measured and as two models simulate it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.data.sequence import Sequence
from nnode.diagnosis.report.figures.maps import TALL, draw_walls
from nnode.diagnosis.report.figures.marks import AFTER, BEFORE
from nnode.pages.replay import Scene
from nnode.plots.style import GREY, dress, legend_above, new_figure

_MEASURED: dict[str, Any] = {"color": GREY, "marker": "o"}


@dataclass(frozen=True)
class Simulated:
    """A simulation of a sequence.

    Attributes:
        title: of its panel.
        x: ``(K, N, D)`` m; NaN where nothing is simulated.
        style: colour and marker.
        note: added to the title, as the error of the simulation.
        restart: samples after which the simulation starts again from the measurement.
    """

    title: str
    x: np.ndarray
    style: dict[str, Any]
    note: str = ""
    restart: int | None = None

    @property
    def heading(self) -> str:
        """Title and note."""
        return f"{self.title}: {self.note}" if self.note else self.title


def as_drawn(scene: Scene) -> list[Simulated]:
    """The simulations of a scene as they are drawn: the first without effects."""
    return [
        Simulated(title, x, style, scene.notes.get(title, ""), scene.restart)
        for (title, x), style in zip(scene.simulated.items(), (BEFORE, AFTER), strict=False)
    ]


def trajectories(sequence: Sequence, simulated: list[Simulated]) -> Figure:
    """Measured and simulated trajectories, one column or row per simulation.

    Traffic: time-space lines, and below what is simulated minus what was measured. Crowds: paths
    in the plane, with a line from where people arrived to where they were simulated to.
    """
    draw = _lines if sequence.x.shape[2] == 1 else _paths
    return draw(sequence, simulated)


def _lines(s: Sequence, simulated: list[Simulated]) -> Figure:
    figure = new_figure(4.3 * len(simulated) + 0.5, 5.6)
    axes = figure.subplots(
        2, len(simulated), sharex=True, sharey="row", squeeze=False, height_ratios=[1.6, 1]
    )
    for (top, lower), simulation in zip(axes.T, simulated, strict=True):
        colour = simulation.style["color"]
        top.plot(s.time, s.x[..., 0], color=GREY, linewidth=2.2, alpha=0.55)
        top.plot(s.time, simulation.x[..., 0], color=colour, linewidth=0.9)
        lower.axhline(0, color=GREY, linewidth=0.8)
        lower.plot(s.time, (simulation.x - s.x)[..., 0], color=colour, linewidth=0.9)
        dress(top, y="position (m)", title=simulation.heading)
        dress(lower, x="clock time (s)", y="simulated −\nmeasured (m)")
        for ax in (top, lower):
            ax.label_outer()
    _legend(figure, simulated)
    return figure


def _paths(s: Sequence, simulated: list[Simulated]) -> Figure:
    low, high = _view(s)
    figure, axes = _planes(low, high, len(simulated))
    for ax, simulation in zip(axes, simulated, strict=True):
        colour = simulation.style["color"]
        draw_walls(ax, s.walls)
        ax.plot(s.x[..., 0], s.x[..., 1], color=GREY, linewidth=2.2, alpha=0.55)
        number = simulation.restart or s.n_samples
        for start in range(0, s.n_samples, number):
            part = slice(start, start + number)
            ax.plot(*simulation.x[part].transpose(2, 0, 1), color=colour, linewidth=0.9)
            ends = np.stack([s.x[part][-1], simulation.x[part][-1]], 1)
            ax.add_collection(LineCollection(list(ends), colors="black", linewidths=0.7))
        ax.plot(*s.x[-1].T, linestyle="", markersize=4, **_MEASURED)
        ax.plot(*simulation.x[-1].T, linestyle="", markersize=4, **simulation.style)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        dress(ax, x="x (m)", y="y (m)", title=simulation.heading)
        ax.label_outer()
    _legend(figure, simulated)
    return figure


def _legend(figure: Figure, simulated: list[Simulated]) -> None:
    lines = [Line2D([], [], label="measured", color=GREY, linewidth=2.2, alpha=0.55)]
    lines += [Line2D([], [], label=s.title, color=s.style["color"]) for s in simulated]
    legend_above(figure, lines)


def _view(s: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the view: where people walk, and nearby walls."""
    low, high = s.x.min((0, 1)) - 0.5, s.x.max((0, 1)) + 0.5
    if s.walls is not None and len(s.walls):
        ends = s.walls.reshape(-1, 2)
        near = ((ends > low - 1.5) & (ends < high + 1.5)).all(1)
        # a long wall along the path has distant ends, but a small distance across
        for axis in (0, 1):
            flat = np.abs(s.walls[:, axis] - s.walls[:, axis + 2]) < 1e-9
            at = s.walls[flat, axis]
            at = at[(at > low[axis] - 1.5) & (at < high[axis] + 1.5)]
            at = np.concatenate([at, ends[near, axis]])
            if at.size:
                low[axis] = min(low[axis], at.min() - 0.2)
                high[axis] = max(high[axis], at.max() + 0.2)
    return low, high


def _planes(
    low: np.ndarray, high: np.ndarray, number: int, side: float = 7.4
) -> tuple[Figure, list[Axes]]:
    """Panels of one plane: above each other where it is wide, else beside each other."""
    ratio = float(np.clip((high - low)[1] / (high - low)[0], 0.15, 2.0))
    if ratio < 0.7:
        shape, size = (number, 1), (side, (0.9 * side * ratio + 0.45) * number + 0.6)
    else:
        width = min(side / number, TALL / ratio)
        shape, size = (1, number), (width * number + 0.6, 0.9 * width * ratio + 1.1)
    figure = new_figure(*size)
    panels = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
    return figure, list(panels.ravel())
