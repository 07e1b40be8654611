"""Figures of results: curves by variable, intervals of coefficients, costs by sequence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.diagnosis.result import NamedEffect, Place, Structure
from nnode.model.effects import CATALOGUE
from nnode.plots.style import (
    GREY,
    OKABE_ITO,
    SMALL_FONT,
    dress,
    legend_above,
    new_figure,
    with_unit,
)

COLUMNS = 3
#: Largest number of sequences with labels.
NAMED = 24

#: Colour and marker of the model before and after, the same in all figures.
BEFORE: dict[str, Any] = {"color": OKABE_ITO["vermillion"], "marker": "s"}
AFTER: dict[str, Any] = {"color": OKABE_ITO["blue"], "marker": "o"}


def place_curves(places: Sequence[Place], unit: str) -> Figure:
    """Missing term by variable, with its standard errors and the significant interval.

    Args:
        places: one panel each.
        unit: of the deviations.
    """
    rows = -(-len(places) // COLUMNS)
    columns = min(COLUMNS, len(places))
    figure = new_figure(3.1 * columns + 0.3, 2.5 * rows + 0.3)
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for n, place in enumerate(places):
        ax = axes.flat[n]
        ax.axhline(0, color=GREY, linewidth=0.8)
        if np.isfinite([place.low, place.high]).all():
            ax.axvspan(place.low, place.high, color=OKABE_ITO["orange"], alpha=0.25, linewidth=0)
        if place.curve:
            ax.errorbar(
                place.curve["at"],
                place.curve["deviation"],
                yerr=place.curve.get("error"),
                fmt=".-",
                color=OKABE_ITO["blue"],
                linewidth=1,
                elinewidth=0.8,
                markersize=4,
            )
        share = f"{100 * place.share:.0f} % of the error" if np.isfinite(place.share) else ""
        dress(
            ax,
            x=with_unit(place.variable, place.unit),
            y=f"missing term ({unit})" if n % columns == 0 else "",
            title=share.replace("-", "−"),
        )
    for ax in axes.flat[len(places) :]:
        ax.set_axis_off()
    return figure


def coefficient_intervals(effects: Sequence[NamedEffect]) -> Figure:
    """Coefficients with their 95 % intervals, each on a separate scale.

    A dotted line stands at the value without the effect, where it has one.
    """
    rows = [(e, name, c) for e in effects for name, c in e.coefficients.items()]
    figure = new_figure(6.4, 0.75 * len(rows) + 0.35)
    axes = figure.subplots(len(rows), 1, squeeze=False)[:, 0]
    for ax, (effect, name, c) in zip(axes, rows, strict=True):
        catalogued = CATALOGUE.effects.get(effect.name)
        strength = catalogued.strengths.get(name) if catalogued else None
        if strength is not None and strength.neutral is not None:
            ax.axvline(strength.neutral, color=GREY, linestyle=":", linewidth=1.4)
        ends = np.array([[c.value - c.low], [c.high - c.value]])
        ax.errorbar(
            [c.value],
            [0],
            xerr=np.nan_to_num(ends).clip(min=0),
            fmt="o",
            color=OKABE_ITO["blue"],
            capsize=4,
            markersize=6,
        )
        ax.set_ylim(-1, 1)
        ax.set_yticks([0], [f"{effect.name}\n{with_unit(name, c.unit)}"])
        dress(ax, grid=False)
        ax.ticklabel_format(axis="x", useOffset=False)
        ax.tick_params(axis="y", length=0)
        ax.margins(x=0.15)
        for side in ("top", "right", "left"):
            ax.spines[side].set_visible(False)
    return figure


def confirmation_costs(
    names: Sequence[str], before: Sequence[float], after: Sequence[float] | None, floor: float
) -> Figure:
    """Mean square error of every confirmation sequence, before and after, m².

    Args:
        after: None where no effect was added.
        floor: of the measurement's noise, m².
    """
    order = np.argsort(before)[::-1]
    b, a = (
        np.asarray(costs, float)[order] for costs in (before, before if after is None else after)
    )
    place = np.arange(len(order))
    recordings = {name.rpartition("/")[0] for name in names}
    shared = f"{recordings.pop()}/" if len(recordings) == 1 and "" not in recordings else ""
    figure = new_figure(7.2, 3.2)
    ax = figure.subplots()
    ax.vlines(place, np.minimum(b, a), np.maximum(b, a), color=GREY, linewidth=1)
    shown = [("without effects", b, BEFORE), ("with effects", a, AFTER)][: 1 + (after is not None)]
    for _, values, style in shown:
        ax.plot(place, values, linestyle="", markersize=5.5, **style)
    levels = np.concatenate([b, a, [floor] if floor > 0 else []])
    if (levels > 0).all():
        ax.set_yscale("log")
        ax.set_ylim(0.7 * np.nanmin(levels), 1.4 * np.nanmax(levels))
        ax.tick_params(which="minor", labelsize=SMALL_FONT, width=0.6, color=GREY)
    handles = [Line2D([], [], linestyle="", label=label, **style) for label, _, style in shown]
    if np.isfinite(floor) and floor > 0:
        ax.axhline(floor, color="black", linestyle="--", linewidth=0.9)
        handles.append(Line2D([], [], color="black", linestyle="--", label="measurement noise"))
    if len(order) <= NAMED:
        short = [names[i].removeprefix(shared) for i in order]
        ax.set_xticks(place, short, rotation=40, ha="right")
    else:
        ax.set_xticks([])
    of = f" of {shared.rstrip('/')}" if shared else ""
    dress(ax, x=f"confirmation sequence{of}", y="mean square error (m²)")
    legend_above(figure, handles)
    return figure


def flexible_curve(structure: Structure, unit: str) -> Figure:
    """The nonparametric fit of unexplained structure over its first variable."""
    figure = new_figure(4.8, 3.0)
    ax: Axes = figure.subplots()
    ax.axhline(0, color=GREY, linewidth=0.8)
    ax.plot(structure.curve["at"], structure.curve["deviation"], color=OKABE_ITO["blue"])
    variable = structure.variables[0] if structure.variables else "variable"
    dress(ax, x=with_unit(variable, structure.unit), y=f"missing term ({unit})")
    return figure
