"""Figures of the study of car following."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.plots.style import GREY, OKABE_ITO, SMALL_FONT, curve_style, dress, new_figure

#: Rises of the error up to this are shown, m: beyond it no value is in question.
SHOWN = 0.6

_BLUE, _RED = OKABE_ITO["blue"], OKABE_ITO["vermillion"]


def errors(
    names: Sequence[str],
    differences: Mapping[str, np.ndarray],
    unit: str,
    reference: str,
) -> Figure:
    """Differences of candidates to a reference, with intervals, one row per candidate.

    Args:
        names: from top to bottom.
        differences: what was compared on to ``(N, 3)`` difference, low and high.
    """
    figure = new_figure(7.2, 0.24 * len(names) + 1.1)
    ax = figure.subplots()
    place = np.arange(len(names))[::-1]
    handles = []
    for i, (label, values) in enumerate(differences.items()):
        style = curve_style(i)
        y = place + (0.5 - i) * 0.3
        ax.hlines(y, values[:, 1], values[:, 2], color=style["color"], linewidth=1.4)
        ax.plot(values[:, 0], y, style["marker"], color=style["color"], markersize=4)
        handles.append(Line2D([], [], **{**style, "linestyle": "-"}, markersize=4, label=label))
    ax.axvline(0, color=GREY, linewidth=0.8)
    ax.set_yticks(place, names)
    ax.set_ylim(-0.8, len(names) - 0.2)
    # one that blows up on a few pairs must not hide the others
    ends = np.abs(np.concatenate([values[:, 1:].ravel() for values in differences.values()]))
    limit = 1.15 * float(np.nanquantile(ends, 0.9))
    ax.set_xlim(-limit, limit)
    dress(ax, x=f"error minus that of {reference} ({unit})")
    figure.legend(
        handles=handles, fontsize=SMALL_FONT, frameon=False, loc="outside upper center", ncols=2
    )
    return figure


def sides(values: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Mean speed and mean gap of the pairs of both sides of a division.

    Args:
        values: side to speeds (m/s) and gaps (m) by pair.
    """
    figure = new_figure(5.2, 3.4)
    ax = figure.subplots()
    for i, (name, (speed, gap)) in enumerate(values.items()):
        style = curve_style(i)
        face = "none" if i == 0 else style["color"]
        ax.plot(
            speed,
            gap,
            style["marker"],
            color=style["color"],
            markerfacecolor=face,
            markersize=5,
            label=f"{name}: {len(gap)} pairs",
        )
    dress(ax, x="mean speed of the follower (m/s)", y="mean gap (m)")
    ax.legend(fontsize=SMALL_FONT, frameon=False)
    return figure


def profiles(found: Mapping[str, Mapping[str, np.ndarray]], units: Mapping[str, str]) -> Figure:
    """The rise of the cost where one parameter is held and all others are calibrated again.

    Args:
        found: parameter to ``values``, ``rise``, ``low`` and ``high`` (m), and ``best``.
    """
    figure = new_figure(2.1 * len(found), 2.5)
    axes = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for ax, (name, one) in zip(axes, found.items(), strict=True):
        ax.fill_between(one["values"], one["low"], one["high"], color=_BLUE, alpha=0.15, lw=0)
        ax.plot(one["values"], one["rise"], "o-", color=_BLUE, markersize=3, linewidth=1.2)
        ax.axhline(0, color=GREY, linewidth=0.8)
        ax.axvline(float(one["best"]), color=_RED, linewidth=0.9, linestyle=(0, (4, 2)))
        first = ax is axes[0]
        dress(ax, x=f"{name} ({units.get(name, '')})", y="rise of the error (m)" if first else "")
        ax.set_xscale("log")
        ax.minorticks_off()
        ticks = [
            t
            for t in (0.25, 0.5, 1, 2, 5, 10, 20, 50, 100)
            if min(one["values"]) <= t <= max(one["values"])
        ]
        ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes[0].set_ylim(-0.1 * SHOWN, SHOWN)
    return figure


def equilibria(
    speeds: np.ndarray,
    gaps: Mapping[str, np.ndarray],
    measured: tuple[np.ndarray, np.ndarray],
    length: float,
) -> Figure:
    """Equilibrium gap by speed, and flow by density, of laws over nearly even driving.

    Args:
        speeds: m/s.
        gaps: law to equilibrium gaps, m.
        measured: speeds (m/s) and gaps (m) of samples at nearly even driving.
        length: of a vehicle, m.
    """
    figure = new_figure(8.6, 3.5)
    left, right = figure.subplots(1, 2)
    v, s = measured
    for ax, x, y in ((left, v, s), (right, 1e3 / (s + length), 3.6e3 * v / (s + length))):
        ax.plot(x, y, ".", color=GREY, markersize=1.5, alpha=0.25, rasterized=True)
    for i, (name, gap) in enumerate(gaps.items()):
        style = {**curve_style(i), "marker": "", "linewidth": 1.5}
        left.plot(speeds, gap, **style, label=name)
        right.plot(1e3 / (gap + length), 3.6e3 * speeds / (gap + length), **style)
    left.set(xlim=(0, float(speeds.max())), ylim=(0, float(np.quantile(s, 0.998))))
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
    _along(right, along)
    return figure


def _along(ax: Axes, along: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
    for i, (simulated, theory) in enumerate(along.values()):
        style = curve_style(i)
        place = np.arange(len(simulated))
        ax.plot(place, theory, color=style["color"], linewidth=1.2, linestyle=style["linestyle"])
        ax.plot(place, simulated, style["marker"], color=style["color"], markersize=4)
    dress(ax, x="place behind the leader", y="swing over the leader's")
    kinds = [
        Line2D([], [], color=GREY, linewidth=1.2, label="linear theory"),
        Line2D([], [], color=GREY, marker="o", linestyle="", markersize=4, label="simulated"),
    ]
    ax.legend(handles=kinds, fontsize=SMALL_FONT)


def by_group(values: Mapping[str, Mapping[str, np.ndarray]], y: str) -> Figure:
    """A number of each follower, by group along the axis and by colour within it.

    Args:
        values: group to what is told apart within it to numbers.
        y: label of the axis, with its unit.
    """
    figure = new_figure(6.4, 3.2)
    ax = figure.subplots()
    kinds = list(dict.fromkeys(kind for group in values.values() for kind in group))
    for i, kind in enumerate(kinds):
        style = curve_style(i)
        for place, group in enumerate(values.values()):
            own = group.get(kind, np.empty(0))
            x = place + (i - (len(kinds) - 1) / 2) * 0.16
            ax.plot(
                np.full(len(own), x),
                own,
                style["marker"],
                color=style["color"],
                markersize=5,
                fillstyle="none",
            )
    ax.set_xticks(range(len(values)), list(values))
    dress(ax, y=y)
    handles = [
        Line2D([], [], **{**curve_style(i), "linestyle": ""}, fillstyle="none", label=kind)
        for i, kind in enumerate(kinds)
    ]
    ax.legend(handles=handles, fontsize=SMALL_FONT)
    ax.set_ylim(bottom=0)
    return figure
