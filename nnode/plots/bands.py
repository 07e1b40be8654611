"""Measured gaps with bands of sampled gaps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from nnode.plots.style import GREY, OKABE_ITO, dress, legend_above, new_figure


@dataclass(frozen=True)
class Bands:
    """Bands of a vehicle's gap.

    Attributes:
        name: name of the sequence.
        time: ``(K,)`` s after the start.
        measured, median: ``(K,)`` gaps, m.
        bands: level to ``(2, K)`` lower and upper end, m.
    """

    name: str
    time: np.ndarray
    measured: np.ndarray
    median: np.ndarray
    bands: Mapping[float, tuple[np.ndarray, np.ndarray]]


def band_panels(
    vehicles: Sequence[Bands],
    what: str = "gap (m)",
    *,
    median: str = "median of samples",
    band: str = "of samples",
    begins: float | None = None,
) -> Figure:
    """A panel per vehicle or person, two side by side.

    Args:
        what: label of the vertical axis.
        median, band: labels of the medians, and of the bands after their level.
        begins: s, where the prediction begins; a dotted line marks it.
    """
    rows = -(-len(vehicles) // 2)
    figure = new_figure(7.2, 1.9 * rows + 0.5)
    panels = figure.subplots(rows, 2, squeeze=False).ravel()
    blue = OKABE_ITO["blue"]
    for ax, vehicle in zip(panels, vehicles, strict=False):
        for level, (low, high) in sorted(vehicle.bands.items(), reverse=True):
            ax.fill_between(
                vehicle.time,
                low,
                high,
                color=blue,
                alpha=0.4 if level < 0.9 else 0.18,
                linewidth=0,
                label=f"{100 * level:g} % {band}",
            )
        ax.plot(vehicle.time, vehicle.median, color=blue, linewidth=1.0, label=median)
        ax.plot(vehicle.time, vehicle.measured, color="black", linewidth=1.2, label="measured")
        if begins is not None:
            ax.axvline(begins, color=GREY, linestyle=":", linewidth=1.0)
        dress(ax, x="time (s)", y=what, title=vehicle.name)
        if what.startswith("gap"):
            ax.set_ylim(bottom=min(0.0, float(vehicle.measured.min())))
    for ax in panels[len(vehicles) :]:
        ax.set_visible(False)
    legend_above(figure, panels[0].get_legend_handles_labels()[0], 4)
    return figure
