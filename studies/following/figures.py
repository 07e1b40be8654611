"""Figures of the study of car following."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.plots.style import (
    FONT,
    GREY,
    OKABE_ITO,
    SMALL_FONT,
    curve_style,
    dress,
    legend_above,
    new_figure,
)

#: Rises of the error up to this are shown, m: beyond it no value is in question.
SHOWN = 0.6

_BLUE, _RED = OKABE_ITO["blue"], OKABE_ITO["vermillion"]


def errors(names: Sequence[str], differences: Mapping[str, pd.DataFrame], reference: str) -> Figure:
    """Differences of candidates to a reference, with intervals, one row per candidate.

    Args:
        names: from top to bottom.
        differences: what was compared on to ``difference``, ``low`` and ``high`` (m) by candidate.
    """
    figure = new_figure(7.2, 0.24 * len(names) + 1.1)
    ax = figure.subplots()
    place = np.arange(len(names))[::-1]
    handles = []
    for i, (label, table) in enumerate(differences.items()):
        style = curve_style(i)
        y = place + (0.5 - i) * 0.3
        ax.hlines(y, table["low"], table["high"], color=style["color"], linewidth=1.4)
        ax.plot(table["difference"], y, style["marker"], color=style["color"], markersize=4)
        handles.append(Line2D([], [], **{**style, "linestyle": "-"}, markersize=4, label=label))
    ax.axvline(0, color=GREY, linewidth=0.8)
    ax.set_yticks(place, names)
    ax.set_ylim(-0.8, len(names) - 0.2)
    # one that blows up on a few pairs must not hide the others
    ends = pd.concat(differences)[["low", "high"]].abs()
    limit = 1.15 * float(np.nanquantile(ends, 0.9))
    ax.set_xlim(-limit, limit)
    dress(ax, x=f"error minus that of {reference} (m)")
    legend_above(figure, handles, columns=2)
    return figure


def sides(pairs: pd.DataFrame) -> Figure:
    """Mean speed (m/s) and mean gap (m) of the pairs by ``side`` of a division."""
    figure = new_figure(5.2, 3.4)
    ax = figure.subplots()
    for i, (name, part) in enumerate(pairs.groupby("side", sort=False)):
        style = curve_style(i)
        ax.plot(
            part["speed (m/s)"],
            part["gap (m)"],
            style["marker"],
            color=style["color"],
            markerfacecolor="none" if i == 0 else style["color"],
            markersize=5,
            label=f"{name}: {len(part)} pairs",
        )
    dress(ax, x="mean speed of the follower (m/s)", y="mean gap (m)")
    ax.legend(fontsize=SMALL_FONT, frameon=False)
    return figure


def profiles(
    points: Mapping[str, Mapping[str, Sequence[float]]],
    best: Mapping[str, float],
    units: Mapping[str, str],
) -> Figure:
    """The rise of the cost where one parameter is held and all others are calibrated again.

    Args:
        points: parameter to ``values``, ``rise``, ``low`` and ``high`` (m).
    """
    figure = new_figure(2.1 * len(points), 2.5)
    axes = figure.subplots(1, len(points), sharey=True, squeeze=False)[0]
    for ax, (name, one) in zip(axes, points.items(), strict=True):
        ax.fill_between(one["values"], one["low"], one["high"], color=_BLUE, alpha=0.15, lw=0)
        ax.plot(one["values"], one["rise"], "o-", color=_BLUE, markersize=3, linewidth=1.2)
        ax.axhline(0, color=GREY, linewidth=0.8)
        ax.axvline(best[name], color=_RED, linewidth=0.9, linestyle=(0, (4, 2)))
        dress(ax, x=f"{name} ({units.get(name, '')})")
        ax.set_xscale("log")
        ax.minorticks_off()
        low, high = min(one["values"]), max(one["values"])
        ticks = [t for t in (0.25, 0.5, 1, 2, 5, 10, 20, 50, 100) if low <= t <= high]
        ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes[0].set_ylabel("rise of the error (m)", fontsize=FONT)
    axes[0].set_ylim(-0.1 * SHOWN, SHOWN)
    return figure


def equilibria(gaps: pd.DataFrame, measured: pd.DataFrame, length: float) -> Figure:
    """Equilibrium gap by speed, and flow by density, of laws over nearly even driving.

    Args:
        gaps: equilibrium gaps (m), a column per law, indexed by speed (m/s).
        measured: samples at nearly even driving: speed ``v`` (m/s) and ``gap`` (m).
        length: of a vehicle, m.
    """
    figure = new_figure(8.6, 3.5)
    left, right = figure.subplots(1, 2)
    speeds, v, s = gaps.index.to_numpy(), measured["v"], measured["gap"]
    for ax, x, y in ((left, v, s), (right, 1e3 / (s + length), 3.6e3 * v / (s + length))):
        ax.plot(x, y, ".", color=GREY, markersize=1.5, alpha=0.25, rasterized=True)
    for i, (name, gap) in enumerate(gaps.items()):
        style = {**curve_style(i), "marker": "", "linewidth": 1.5}
        left.plot(speeds, gap, **style, label=name)
        right.plot(1e3 / (gap + length), 3.6e3 * speeds / (gap + length), **style)
    left.set(xlim=(0, speeds.max()), ylim=(0, s.quantile(0.998)))
    right.set(xlim=(0, 180), ylim=(0, 3000))
    dress(left, x="speed (m/s)", y="gap (m)")
    dress(right, x="density (vehicles/km)", y="flow (vehicles/h)")
    left.legend(fontsize=SMALL_FONT, loc="upper left")
    return figure


def amplification(
    gains: Mapping[str, np.ndarray],
    frequency: np.ndarray,
    along: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> Figure:
    """How much of a swing one follower passes on, and what it comes to along a platoon.

    Args:
        gains: law to |G| at frequencies (1/s).
        along: law to simulated amplitudes by place, over the leader's, and what |G| says.
    """
    figure = new_figure(8.6, 3.3)
    left, right = figure.subplots(1, 2)
    for i, (name, gain) in enumerate(gains.items()):
        style = {**curve_style(i), "marker": "", "linewidth": 1.4}
        left.plot(2 * np.pi / frequency, gain, **style, label=name)
    left.axhline(1, color=GREY, linewidth=0.8)
    left.set(xscale="log", xlim=(3, 200), ylim=(0, None))
    dress(left, x="period of the swing (s)", y="swing of the follower over the leader's")
    left.legend(fontsize=SMALL_FONT)
    for i, (simulated, theory) in enumerate(along.values()):
        style = curve_style(i)
        place = np.arange(len(simulated))
        right.plot(place, theory, color=style["color"], linewidth=1.2, linestyle=style["linestyle"])
        right.plot(place, simulated, style["marker"], color=style["color"], markersize=4)
    dress(right, x="place behind the leader", y="swing over the leader's")
    kinds = [
        Line2D([], [], color=GREY, linewidth=1.2, label="linear theory"),
        Line2D([], [], color=GREY, marker="o", linestyle="", markersize=4, label="simulated"),
    ]
    right.legend(handles=kinds, fontsize=SMALL_FONT)
    return figure


def time_gaps(followers: pd.DataFrame, settings: Sequence[str]) -> Figure:
    """Time gap ``T`` (s) of each follower, by ``setting`` along the axis and ``make`` within it."""
    place = followers["setting"].map({name: i for i, name in enumerate(settings)})
    followers = followers.assign(place=place).dropna(subset="place")
    figure = new_figure(6.4, 3.2)
    ax = figure.subplots()
    makes = followers.sort_values(["place", "make"])["make"].unique()
    for i, make in enumerate(makes):
        part = followers[followers["make"] == make]
        style = {**curve_style(i), "linestyle": "", "fillstyle": "none", "markersize": 5}
        shift = (i - (len(makes) - 1) / 2) * 0.16
        ax.plot(part["place"] + shift, part["T"], **style, label=make)
    ax.set_xticks(range(len(settings)), settings)
    dress(ax, y="time gap T (s)")
    ax.legend(fontsize=SMALL_FONT)
    ax.set_ylim(bottom=0)
    return figure
