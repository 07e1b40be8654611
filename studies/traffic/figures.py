"""Figures of the traffic study: leaders' speeds, laws, descent, faulty sequences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.pages.replay import Scene
from nnode.plots.style import GREY, SMALL_FONT, curve_style, dress, legend_above, new_figure
from studies.figures import error_bars

#: Speeds outside are cut, m/s.
LIMITS = (-8.0, 38.0)


def leader_speeds(speeds: pd.DataFrame, low: pd.DataFrame, high: pd.DataFrame) -> Figure:
    """Identified speed of the leading vehicle by recording, and its mean by model.

    Args:
        speeds: km/h; a row per model, a column per recording.
        low, high: ends of their intervals, the same layout, NaN where there is none.

    Source: Göttlich & Totzeck, figure (veloLength).
    """
    figure = new_figure(7.2, 4.0)
    ax = figure.subplots()
    error_bars(ax, speeds, low, high, 0.14, linestyle="")
    handles = []
    for i, (model, mean) in enumerate(speeds.mean(axis=1).items()):
        style = curve_style(i)
        ax.axhline(mean, color=style["color"], linestyle=style["linestyle"], linewidth=1)
        label = f"{model}: mean {mean:.0f} km/h"
        handles.append(Line2D([], [], **style, markersize=4.5, label=label))
    numbered = [f"{n}\n{name}" for n, name in enumerate(speeds.columns, 1)]
    ax.set_xticks(range(len(numbered)), numbered)
    dress(ax, x="recording", y="leader's speed v0 (km/h)")
    legend_above(figure, handles)
    return figure


def law_panels(
    speeds: Mapping[str, pd.DataFrame],
    bands: Mapping[str, Mapping[str, np.ndarray]],
    measured: Mapping[str, np.ndarray],
) -> Figure:
    """Speed against gap, one panel per recording, all models.

    Args:
        speeds: recording to m/s, a column per model, indexed by the gap, m.
        bands: recording to model to ``(2, G)`` ends of the interval, m/s; may be empty.
        measured: recording to measured gaps, m; a bar below shows their middle 90 %.

    Source: Göttlich & Totzeck, figure (interactionForce).
    """
    rows = -(-len(speeds) // 5)
    figure = new_figure(11.0, 2.5 * rows + 0.4)
    axes = figure.subplots(rows, 5, sharex=True, sharey=True, squeeze=False)
    handles: list[Line2D] = []
    for n, (name, table) in enumerate(speeds.items()):
        ax, handles = axes.flat[n], []
        for i, (model, speed) in enumerate(table.items()):
            style = {**curve_style(i), "marker": ""}
            ax.plot(table.index, speed.clip(-1e3, 1e3), linewidth=1.2, **style)
            handles.append(Line2D([], [], **style, label=model))
            if name in bands:
                low, high = np.clip(bands[name][str(model)], -1e3, 1e3)
                ax.fill_between(
                    table.index, low, high, color=style["color"], alpha=0.10, linewidth=0
                )
        span = np.quantile(measured[name], [0.05, 0.95])
        ax.plot(span, [LIMITS[0] + 1.5] * 2, color=GREY, linewidth=4, solid_capstyle="butt")
        last = n // 5 == rows - 1
        dress(
            ax,
            x="gap (m)" if last else "",
            y="speed W (m/s)" if n % 5 == 0 else "",
            title=f"{n + 1}: {name}",
        )
    for ax in axes.flat[len(speeds) :]:
        ax.set_axis_off()
    axes[0, 0].set(xlim=(table.index.min(), table.index.max()), ylim=LIMITS)
    handles.append(Line2D([], [], color=GREY, linewidth=4, label="middle 90 % of measured gaps"))
    legend_above(figure, handles, len(handles))
    return figure


def descents(curves: Mapping[str, np.ndarray]) -> Figure:
    """Average cost above the least one known, against simulations, one curve per model.

    Args:
        curves: model to ``(P, 2)`` simulations and excess of the average cost, m² s.
    """
    figure = new_figure(5.6, 3.2)
    ax = figure.subplots()
    for i, (model, values) in enumerate(curves.items()):
        ax.plot(*values.T, **{**curve_style(i), "marker": ""}, linewidth=1.3, label=model)
    ax.set(xscale="log", yscale="log")
    ax.set_ylim(bottom=max(ax.get_ylim()[0], 1e-3))  # lower values are rounding errors
    dress(ax, x="simulations", y="average J above the least (m² s)")
    ax.legend(fontsize=SMALL_FONT, frameon=False)
    return figure


def space_time(scene: Scene, marked: Sequence[tuple[int, float]]) -> Figure:
    """One traffic sequence: measured positions and simulated ones.

    Args:
        marked: vehicles and times (s) at which a fault of the measurement was found.
    """
    figure = new_figure(6.4, 3.8)
    ax = figure.subplots()
    sequence = scene.sequence
    t = sequence.time - sequence.time[0]
    handles = [Line2D([], [], color=GREY, marker="o", markersize=4, label="measured")]
    ax.plot(t, sequence.x[:, :, 0], color=GREY, marker="o", markersize=4, linewidth=1)
    for i, (name, x) in enumerate(scene.simulated.items()):
        style = {**curve_style(i), "marker": ""}
        ax.plot(t, x[:, :, 0], **style, linewidth=1.3)
        handles.append(Line2D([], [], **style, label=name))
    for agent, time in marked:
        k = int(np.abs(sequence.time - time).argmin())
        ax.plot(t[k], sequence.x[k, agent, 0], "s", color="black", fillstyle="none", markersize=10)
    if marked:
        box: dict[str, Any] = {"marker": "s", "fillstyle": "none", "markersize": 8, "linestyle": ""}
        handles.append(Line2D([], [], color="black", **box, label="fault of the measurement"))
    dress(ax, x="time in the sequence (s)", y="position along the lane (m)", title=sequence.name)
    ax.legend(handles=handles, fontsize=SMALL_FONT)
    return figure
