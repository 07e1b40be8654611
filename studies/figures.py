"""Figures that several studies draw."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nnode.plots.style import curve_style, dress, legend_above, new_figure


def error_bars(
    ax: Axes,
    values: pd.DataFrame,
    low: pd.DataFrame,
    high: pd.DataFrame,
    spread: float,
    **style: Any,
) -> None:
    """A series of points for every row of a table, at 0, 1, 2, ..., with intervals.

    Args:
        low, high: ends of the intervals, the same layout, NaN where there is none.
        spread: distance of two series along the axis.
        style: of all series, in place of their own.
    """
    ends = np.stack([values - low, high - values], axis=1)
    for i, name in enumerate(values.index):
        ax.errorbar(
            np.arange(values.shape[1]) + spread * (i - (len(values) - 1) / 2),
            values.loc[name],
            yerr=np.nan_to_num(ends[i]).clip(min=0),
            label=name,
            markersize=4.5,
            elinewidth=0.8,
            **{**curve_style(i), **style},
        )


def horizon_costs(costs: pd.DataFrame, low: pd.DataFrame, high: pd.DataFrame) -> Figure:
    """Cost relative to the first row's, against the horizon.

    Args:
        costs: m² s; a row per model, a column per horizon (s).
        low, high: ends of the intervals, the same layout, NaN where there is none.
    """
    figure = new_figure(6.6, 3.8)
    ax = figure.subplots()
    unit = costs.iloc[0]
    error_bars(ax, costs / unit, low / unit, high / unit, 0.03, linewidth=1.2)
    ax.set_yscale("log")
    ticks = [0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0]
    ax.set_yticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.set_ylim(np.nanmin(costs / unit) / 1.25, np.nanmax(costs / unit) * 1.25)
    ax.set_xticks(range(len(costs.columns)), [f"{h:g}" for h in costs])
    dress(ax, x="length of a sequence (s)", y=f"held-out J / J of {costs.index[0]}")
    legend_above(figure, ax.get_legend_handles_labels()[0])
    return figure
