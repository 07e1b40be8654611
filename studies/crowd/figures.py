"""Figures of the crowd study: costs by horizon, forces by distance, what follows own speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.plots.style import GREY, OKABE_ITO, SHADE, SMALL_FONT, curve_style, dress, new_figure


def horizon_costs(
    horizons: Sequence[float], costs: pd.DataFrame, low: pd.DataFrame, high: pd.DataFrame
) -> Figure:
    """Cost relative to the first row's, against the horizon.

    Args:
        horizons: s.
        costs: m² s; a row per model, a column per horizon.
        low, high: ends of the intervals, the same layout, NaN where there is none.
    """
    figure = new_figure(6.6, 3.8)
    ax = figure.subplots()
    unit = costs.iloc[0].to_numpy(float)
    place = np.arange(len(horizons), dtype=float)
    for i, model in enumerate(costs.index):
        shift = 0.03 * (i - (len(costs) - 1) / 2)
        y = costs.loc[model].to_numpy(float) / unit
        ends = np.stack(
            [y - low.loc[model].to_numpy(float) / unit, high.loc[model].to_numpy(float) / unit - y]
        )
        ax.errorbar(
            place + shift,
            y,
            yerr=np.nan_to_num(ends).clip(min=0),
            label=model,
            markersize=4.5,
            linewidth=1.2,
            elinewidth=0.8,
            **curve_style(i),
        )
    ax.set_yscale("log")
    ticks = [0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0]
    ax.set_yticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    least, most = (np.nanmin(costs / unit), np.nanmax(costs / unit))
    ax.set_ylim(least / 1.25, most * 1.25)
    ax.set_xticks(place, [f"{h:g}" for h in horizons])
    dress(ax, x="length of a sequence (s)", y=f"held-out J / J of {costs.index[0]}")
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=SMALL_FONT)
    return figure


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
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles),
        frameon=False,
        fontsize=SMALL_FONT,
    )
    return figure


def acceleration_by_speed(tables: Mapping[str, pd.DataFrame]) -> Figure:
    """Mean acceleration along a person's own way by his speed; one panel per model.

    Args:
        tables: model to a table with the columns ``pair``, ``wall``, ``sum`` (m/s²) and ``n``
            (people), indexed by speed (m/s).
    """
    figure = new_figure(2.4 * len(tables) + 0.4, 3.2)
    axes = np.atleast_1d(figure.subplots(1, len(tables), sharey=True, sharex=True))
    names = {"pair": "from people", "wall": "from walls", "sum": "sum"}
    colors = {"pair": "vermillion", "wall": "blue", "sum": "black"}
    lines = {"pair": (0, (6, 2)), "wall": (0, (1.2, 1.4)), "sum": "-"}
    for ax, (model, table) in zip(axes, tables.items(), strict=True):
        share = table["n"] / table["n"].max()
        twin = ax.twinx()
        twin.bar(table.index, share, width=0.09, color=SHADE, edgecolor="none")
        twin.set(ylim=(0, 4), yticks=[])
        twin.set_zorder(0)
        ax.set_zorder(1)
        ax.patch.set_visible(False)
        for part, name in names.items():
            ax.plot(
                table.index,
                table[part],
                label=name,
                color=OKABE_ITO[colors[part]],
                linestyle=lines[part],
                linewidth=1.4,
            )
        ax.axhline(0, color=GREY, linewidth=0.6)
        dress(ax, x="own speed (m/s)", title=model)
    axes[0].set_ylabel("mean acceleration along the own way (m/s²)", fontsize=SMALL_FONT)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=SMALL_FONT
    )
    return figure
