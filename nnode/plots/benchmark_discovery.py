"""Figures of the benchmark of the diagnosis: what was named for what, noise and sample size."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nnode.plots.style import SEQUENTIAL, SMALL_FONT, dress, new_figure

#: Shares below this are not written into their cells.
_WRITTEN = 0.005
#: From this share on the cell is pale, and its text dark.
_PALE = 0.6


def confusion_figure(shares: pd.DataFrame) -> Figure:
    """What was named first (columns) where an effect was hidden (rows).

    Args:
        shares: rows sum to 1; its index and columns are the labels.
    """
    rows, columns = shares.shape
    figure = new_figure(2.6 + 0.42 * columns, 1.8 + 0.3 * rows)
    ax = figure.subplots()
    _cells(ax, shares)
    ax.set_xticks(range(columns), [str(name) for name in shares.columns], rotation=60, ha="right")
    ax.set_yticks(range(rows), [str(name) for name in shares.index])
    dress(ax, x="named first", y="hidden", grid=False)
    return figure


def map_figure(shares: pd.DataFrame) -> Figure:
    """Share of exact names by measurement noise (rows, m) and number of sequences (columns)."""
    figure = new_figure(2.2 + 0.8 * shares.shape[1], 1.4 + 0.45 * shares.shape[0])
    ax = figure.subplots()
    _cells(ax, shares)
    ax.set_xticks(range(shares.shape[1]), [f"{size:g}" for size in shares.columns])
    ax.set_yticks(range(shares.shape[0]), [f"{noise:g}" for noise in shares.index])
    dress(ax, x="sequences", y="noise, m", grid=False)
    return figure


def _cells(ax: Axes, shares: pd.DataFrame) -> None:
    """A field of shares with their percentages written into it."""
    values = shares.to_numpy(dtype=float)
    ax.imshow(values, cmap=SEQUENTIAL, vmin=0, vmax=1, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value) and value >= _WRITTEN:
            colour = "black" if value >= _PALE else "white"
            ax.text(
                j, i, f"{100 * value:.0f}", ha="center", va="center", color=colour,
                fontsize=SMALL_FONT,
            )  # fmt: skip
