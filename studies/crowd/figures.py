"""Figures of the crowd study: forces by distance, what follows own speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.plots.style import (
    GREY,
    OKABE_ITO,
    SHADE,
    SMALL_FONT,
    curve_style,
    dress,
    legend_above,
    new_figure,
)


def forces_by_distance(curves: Mapping[str, Sequence[pd.DataFrame]]) -> Figure:
    """Mean force between two people along the line that joins them, by their distance.

    Args:
        curves: model to one table per start, the best first, with the columns ``facing`` and
            ``same way`` (N), indexed by distance (m).
    """
    figure = new_figure(7.2, 3.4)
    axes = figure.subplots(1, 2, sharey=True)
    titles = {"facing": "walking in opposite directions", "same way": "walking the same way"}
    handles = []
    for i, (model, tables) in enumerate(curves.items()):
        style = {**curve_style(i), "marker": ""}
        handles.append(Line2D([], [], **style, linewidth=1.8, label=f"{model}, best start"))
        if len(tables) > 1:
            label = f"{model}, other starts ({len(tables) - 1})"
            handles.append(Line2D([], [], **style, linewidth=0.7, alpha=0.6, label=label))
        for ax, way in zip(axes, titles, strict=True):
            for n, table in enumerate(tables):
                if way in table:
                    width, alpha = (1.8, 1.0) if n == 0 else (0.7, 0.6)
                    ax.plot(table.index, table[way], linewidth=width, alpha=alpha, **style)
    for ax, way in zip(axes, titles, strict=True):
        ax.axhline(0, color=GREY, linewidth=0.6)
        dress(ax, x="distance (m)", title=titles[way])
    axes[0].set_ylabel("mean force, + apart, - together (N)", fontsize=9.0)
    legend_above(figure, handles, len(handles))
    return figure


def acceleration_by_speed(tables: Mapping[str, pd.DataFrame]) -> Figure:
    """Mean acceleration along a person's own way by his speed; one panel per model.

    Args:
        tables: model to a table with the columns ``pair``, ``wall``, ``sum`` (m/s²) and ``n``
            (people), indexed by speed (m/s).
    """
    figure = new_figure(2.4 * len(tables) + 0.4, 3.2)
    axes = np.atleast_1d(figure.subplots(1, len(tables), sharey=True, sharex=True))
    lines: dict[str, tuple[str, str, Any]] = {
        "pair": ("from people", "vermillion", (0, (6, 2))),
        "wall": ("from walls", "blue", (0, (1.2, 1.4))),
        "sum": ("sum", "black", "-"),
    }
    for ax, (model, table) in zip(axes, tables.items(), strict=True):
        share = table["n"] / table["n"].max()
        twin = ax.twinx()
        twin.bar(table.index, share, width=0.09, color=SHADE, edgecolor="none")
        twin.set(ylim=(0, 4), yticks=[])
        twin.set_zorder(0)
        ax.set_zorder(1)
        ax.patch.set_visible(False)
        for part, (label, color, line) in lines.items():
            style = {"label": label, "color": OKABE_ITO[color], "linestyle": line}
            ax.plot(table.index, table[part], **style, linewidth=1.4)
        ax.axhline(0, color=GREY, linewidth=0.6)
        dress(ax, x="own speed (m/s)", title=model)
    axes[0].set_ylabel("mean acceleration along the own way (m/s²)", fontsize=SMALL_FONT)
    legend_above(figure, axes[0].get_legend_handles_labels()[0])
    return figure
