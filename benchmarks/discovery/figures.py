"""The first screen's p-values where nothing is hidden, against uniform ones."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import beta

from nnode.plots.style import FONT, GREY, OKABE_ITO, SHADE, dress, new_figure

#: Panels in a row.
_COLUMNS = 3


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
    first = min(1 / (len(p) + 1) for p in values.values())
    lowest = min(first, *(p[0] for p in values.values()))
    for ax, (name, p) in zip(axes, values.items(), strict=False):
        k, n = np.arange(1, len(p) + 1), len(p)
        expected = k / (n + 1)
        low, high = (beta.ppf(q, k, n - k + 1) for q in (0.025, 0.975))
        ax.fill_between(expected, low, high, color=SHADE)
        ax.plot([first, 1], [first, 1], color=GREY, linewidth=0.8)
        ax.axhline(0.05, color=GREY, linewidth=0.8, linestyle=":")
        ax.plot(expected, p, ".", color=OKABE_ITO["blue"], markersize=3)
        ax.set(xscale="log", yscale="log", xlim=(0.7 * first, 1.3), ylim=(0.7 * lowest, 1.3))
        ax.tick_params(labelbottom=True)
        dress(ax, title=f"{name}, {n} cases")
    for ax in axes[len(values) :]:
        ax.remove()
    figure.supxlabel("expected of uniform p-values", fontsize=FONT)
    figure.supylabel("p-value of the first screen", fontsize=FONT)
    return figure
