"""Figures of the benchmark of the diagnosis: names for truths, noise and sample size, levels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import beta

from nnode.plots.style import (
    FONT,
    GREY,
    OKABE_ITO,
    SEQUENTIAL,
    SHADE,
    SMALL_FONT,
    dress,
    new_figure,
)

#: Shares below this are not written into their cells.
_WRITTEN = 0.005
#: From this share on the cell is pale, and its text dark.
_PALE = 0.6
#: Panels beside each other.
_COLUMNS = 3


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


def uniform_figure(values: Mapping[str, np.ndarray]) -> Figure:
    """Quantiles of p-values against those of uniform ones, a panel each, on logarithmic axes.

    Args:
        values: by label, ascending. The k-th of n uniform ones follows Beta(k, n - k + 1): its mean
            is the line, its quantiles of 2.5 and 97.5 % are the band; dots mark 5 %.
    """
    columns = min(len(values), _COLUMNS)
    rows = -(-len(values) // columns)
    figure = new_figure(0.4 + 2.4 * columns, 0.4 + 2.3 * rows)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    first = min(1 / (len(found) + 1) for found in values.values())
    least = min(first, *(found[0] for found in values.values()))
    for ax, (name, found) in zip(axes, values.items(), strict=False):
        k, n = np.arange(1, len(found) + 1), len(found)
        expected = k / (n + 1)
        low, high = (beta.ppf(q, k, n - k + 1) for q in (0.025, 0.975))
        ax.fill_between(expected, low, high, color=SHADE)
        ax.plot([first, 1], [first, 1], color=GREY, linewidth=0.8)
        ax.axhline(0.05, color=GREY, linewidth=0.8, linestyle=":")
        ax.plot(expected, found, ".", color=OKABE_ITO["blue"], markersize=3)
        ax.set(xscale="log", yscale="log", xlim=(0.7 * first, 1.3), ylim=(0.7 * least, 1.3))
        ax.tick_params(labelbottom=True)
        dress(ax, title=f"{name}, {n} cases")
    for ax in axes[len(values) :]:
        ax.remove()
    figure.supxlabel("expected of uniform p-values", fontsize=FONT)
    figure.supylabel("p-value of the first screen", fontsize=FONT)
    return figure


def _cells(ax: Axes, shares: pd.DataFrame) -> None:
    """A field of shares with their percentages written into it."""
    values = shares.to_numpy(dtype=float)
    ax.imshow(values, cmap=SEQUENTIAL, vmin=0, vmax=1, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value) and value >= _WRITTEN:
            colour = "black" if value >= _PALE else "white"
            ax.text(
                j,
                i,
                f"{100 * value:.0f}",
                ha="center",
                va="center",
                color=colour,
                fontsize=SMALL_FONT,
            )
