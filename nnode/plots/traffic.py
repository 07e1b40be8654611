"""Figures of traffic models: speed as a function of the gap, errors of followers, drivers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from nnode.data.sequence import Sequence
from nnode.errors import ConfigError, DataError
from nnode.model import System
from nnode.model.extend import omitted_effects
from nnode.model.laws import Law
from nnode.plots.style import (
    GREY,
    OKABE_ITO,
    SEQUENTIAL,
    SHADE,
    SMALL_FONT,
    curve_style,
    dress,
    new_figure,
    set_ticks,
    thinned,
    with_unit,
)

#: Range of shown speeds (m/s); the laws have a pole at gap 0.
SHOWN = (-20.0, 60.0)
#: Percentiles between which gaps count as supported by the data.
SUPPORT = (1.0, 99.0)
KMH = 3.6
SAMPLES = 481
#: Smallest and usual largest gap (m) of a figure.
SPAN = (2.0, 50.0)
BINS = 48
#: Largest number of measured samples in a figure.
POINTS = 3000


def follow_law(system: System, name: str = "model") -> Law:
    """The first follow-the-leader law among the terms of ``system``.

    Raises:
        ConfigError: there is none.
    """
    law = system.find(Law)
    if law is None or system.domain != "traffic":
        raise ConfigError(
            f"{name}: a speed curve needs a traffic model with a law of the gap, found a "
            f"{system.domain} model with the terms {[t.name for t in system.terms]}"
        )
    return law


def measured_gaps(sequences: Iterable[Sequence]) -> np.ndarray:
    """All gaps x_{i+1} - x_i in m of traffic sequences, as one vector.

    Raises:
        DataError: a sequence is not one-dimensional.
    """
    parts = []
    for item in sequences:
        if item.x.shape[2] != 1:
            raise DataError(
                f"sequence {item.name}: gaps exist on a lane only, got "
                f"{item.x.shape[2]}-dimensional positions"
            )
        parts.append(np.diff(item.x[..., 0], axis=1).ravel())
    return np.concatenate(parts) if parts else np.empty(0)


def measured_speeds(sequences: Iterable[Sequence], system: System) -> np.ndarray:
    """``(P, 2)`` gaps (m) and speeds (m/s) of followers, evenly thinned out to at most
    :data:`POINTS` samples. Speeds that were not measured are central differences.

    A gap is x_{i+1} - x_i, less the length of the vehicle ahead if the model's law takes gaps from
    bumper to bumper.

    Raises:
        DataError: a sequence is not one-dimensional.
    """
    parts = [np.empty((0, 2))]
    net = "length_1" in getattr(system.formula, "symbols", ())
    for s in sequences:
        gap = measured_gaps([s])
        if net and s.length is not None and np.isfinite(s.length).any():
            ahead = np.where(np.isfinite(s.length), s.length, np.nanmean(s.length))[1:]
            gap = gap - np.tile(ahead, len(s.x))
        speed = s.v if s.v is not None else np.gradient(s.x, s.dt, axis=0)
        parts.append(np.column_stack([gap, speed[:, :-1, 0].ravel()]))
    return thinned(np.concatenate(parts), POINTS)


@torch.no_grad()
def curve_table(models: Mapping[str, System], gaps: np.ndarray) -> pd.DataFrame:
    """Speed W (m/s) of every model at ``gaps`` (m).

    Only the follow-the-leader law is evaluated; further terms of a model are left out.

    Returns:
        One row per gap (index ``gap``, m), one column per model.

    Raises:
        ConfigError: no model, or one without a law of the gap.
    """
    if not models:
        raise ConfigError("speed curves need at least one model, got none")
    columns = {}
    for name, system in models.items():
        law = follow_law(system, name)
        like = next(law.parameters())
        speed = law.speed(torch.tensor(gaps, dtype=like.dtype, device=like.device))
        columns[name] = speed.double().cpu().numpy()
    return pd.DataFrame(columns, index=pd.Index(gaps, name="gap"))


def speed_curves(
    models: Mapping[str, System],
    gaps: np.ndarray | None = None,
    points: np.ndarray | None = None,
) -> Figure:
    """Speed against gap for one or many models.

    A marker at the right edge shows each constant leader's v0. Up to seven models have a colour,
    line style and marker each; more, such as the checkpoints of a run, are shaded from first to
    last. Speeds outside -20...60 m/s are cut, and the figure says so.

    Args:
        models: name to traffic model.
        gaps: measured gaps in m, for a histogram below. Curves fade outside the 1st to 99th
            percentile, where no data support them.
        points: ``(P, 2)`` measured gaps (m) and speeds (m/s), drawn as dots behind the curves.
            The axis extends beyond 50 m if more than 1 % of their gaps are larger.

    Raises:
        ConfigError: no model, or one without a law of the gap.

    Source: Göttlich & Totzeck, figure (interactionForce).
    """
    low, high = SPAN
    if points is not None:
        high = max(high, float(np.percentile(points[:, 0], SUPPORT[1])))
    table = curve_table(models, np.linspace(low, high, SAMPLES))
    leaders = {
        name: float(follow_law(system).get_parameter("v0").detach())
        for name, system in models.items()
        if not system.leader_measured and system.order == 1
    }
    if gaps is None:
        figure = new_figure(6.4, 4.0)
        ax = figure.subplots()
        support = None
    else:
        figure = new_figure(6.4, 5.0)
        ax, below = figure.subplots(2, 1, sharex=True, height_ratios=(3.4, 1))
        support = _histogram(below, gaps, (low, high))
        for panel in (ax, below):
            for edge in ((low, support[0]), (support[1], high)):
                if edge[0] < edge[1]:
                    panel.axvspan(*edge, color=SHADE, linewidth=0, zorder=0)
    # a law of second order has no speed of the gap alone
    direct = all(follow_law(system).of_gap for system in models.values())
    what = "speed W" if direct else "equilibrium speed"
    dress(ax, x="gap (m)" if gaps is None else "", y=f"{what} (m/s)")
    names = [str(name) for name in table]
    many = len(names) > len(OKABE_ITO)
    styles, handles = (_many if many else _few)(names)
    for i, (name, style) in enumerate(zip(names, styles, strict=True)):
        # side by side, since calibrated leaders often drive at nearly the same speed
        place = 0.985 - (0 if many else 0.022 * i)
        _curve(ax, name, table[name], support, leaders.get(name), place, style)
    if points is not None:
        style = {"color": GREY, "alpha": 0.25, "linewidths": 0, "zorder": 1}
        ax.scatter(points[:, 0], points[:, 1], s=3, gid="measured", **style)
        handles.append(Line2D([], [], color=GREY, marker=".", linestyle="", label="measured"))
    if leaders:
        marker = styles[0]["marker"] if many else ""
        label = "markers: leader's v0"
        handles.append(Line2D([], [], color=GREY, marker=marker, linestyle="", label=label))
    ax.set_xlim(low, high)
    shown = [] if points is None else list(np.percentile(points[:, 1], SUPPORT))
    _limit(ax, table, [*leaders.values(), *shown], _left_out(models))
    right = ax.secondary_yaxis(
        "right", functions=(partial(np.multiply, KMH), partial(np.multiply, 1 / KMH))
    )
    right.set_ylabel(f"{what} (km/h)", fontsize=ax.yaxis.label.get_fontsize())
    set_ticks(right)
    right.spines["right"].set(linewidth=0.6, edgecolor=GREY)
    right_half = table.to_numpy()[SAMPLES // 2 :]
    bottom, top = ax.get_ylim()
    free = bool((right_half > bottom + 0.45 * (top - bottom)).all())
    ax.legend(
        handles=handles,
        handlelength=3.4,
        fontsize=SMALL_FONT,
        loc="lower right" if free else "best",
        framealpha=0.9,
        edgecolor="none",
    )
    return figure


def _few(names: list[str]) -> tuple[list[dict[str, Any]], list[Line2D]]:
    """A colour, line style and marker for each model, and a legend that names all."""
    styles = [curve_style(i) | {"linewidth": 1.8} for i in range(len(names))]
    handles = [
        Line2D([], [], markersize=4.5, label=name, **style)
        for name, style in zip(names, styles, strict=True)
    ]
    return styles, handles


def _many(names: list[str]) -> tuple[list[dict[str, Any]], list[Line2D]]:
    """Shades from the first to the last model, and a legend that names three of them."""
    # the palest end of the map would vanish on white
    colours = matplotlib.colormaps[SEQUENTIAL](np.linspace(0.85, 0.0, len(names)))
    styles: list[dict[str, Any]] = [
        {"color": colour, "linewidth": 0.9, "linestyle": "-", "marker": "<"} for colour in colours
    ]
    handles = [
        Line2D([], [], color=colours[i], linewidth=1.8, label=names[i])
        for i in (0, (len(names) - 1) // 2, len(names) - 1)
    ]
    return styles, [Line2D([], [], linestyle="", label=f"{len(names)} models:"), *handles]


def _curve(
    ax: Axes,
    name: str,
    speeds: pd.Series,
    support: tuple[float, float] | None,
    v0: float | None,
    place: float,
    style: dict[str, Any],
) -> None:
    """One curve, pale where no data support it, and its leader's speed at the right edge."""
    gap, speed = speeds.index.to_numpy(), speeds.to_numpy()
    line = {key: value for key, value in style.items() if key != "marker"}
    held = np.full(gap.shape, True)
    if support is not None:
        held = (gap >= support[0]) & (gap <= support[1])
        ax.plot(gap, np.where(held, np.nan, speed), gid=f"unsupported:{name}", alpha=0.3, **line)
    ax.plot(gap, np.where(held, speed, np.nan), gid=f"curve:{name}", **line)
    if v0 is not None:
        ax.plot(
            place,
            v0,
            gid=f"v0:{name}",
            transform=ax.get_yaxis_transform(),
            linestyle="",
            marker=style["marker"],
            color=style["color"],
            markersize=5,
            zorder=4,
            markeredgecolor="white",
            markeredgewidth=0.4,
        )


def _left_out(models: Mapping[str, System]) -> list[str]:
    """Remarks on effects that the curves do not include."""
    effects = {name: omitted_effects(system) for name, system in models.items()}
    having = {name: words for name, words in effects.items() if words}
    if len(having) > 2:
        return [f"effects of {len(having)} models are not drawn"]
    return [f"{name}: law {words}" for name, words in having.items()]


def _limit(ax: Axes, table: pd.DataFrame, leaders: list[float], extra: list[str]) -> None:
    """Limit the axis of speeds, and note what is cut or not shown."""
    values = np.concatenate([table.to_numpy().ravel(), leaders, [0.0]])
    values = values[np.isfinite(values)]
    bottom, top = max(values.min(), SHOWN[0]), min(values.max(), SHOWN[1])
    pad = 0.05 * (top - bottom) or 1.0
    ax.set_ylim(
        bottom if values.min() < SHOWN[0] else bottom - pad,
        top if values.max() > SHOWN[1] else top + pad,
    )
    cut = []
    if values.min() < SHOWN[0]:
        cut.append(f"below −{-SHOWN[0]:g} m/s")
    if values.max() > SHOWN[1]:
        cut.append(f"above {SHOWN[1]:g} m/s")
    unfinished = [str(name) for name in table if not np.isfinite(table[name]).all()]
    notes = [f"curves {' and '.join(cut)} are cut"] if cut else []
    notes += extra
    if unfinished:
        notes.append(f"not finite everywhere: {', '.join(unfinished[:3])}")
    if bottom < 0:
        ax.axhline(0.0, color=GREY, linewidth=0.6, zorder=1)
    if notes:
        ax.set_title("\n".join(notes), fontsize=SMALL_FONT, color=GREY, loc="left")


def _histogram(ax: Axes, gaps: np.ndarray, span: tuple[float, float]) -> tuple[float, float]:
    """Histogram of the gaps within ``span``; returns the percentiles that bound the support."""
    low, high = (float(value) for value in np.percentile(gaps, SUPPORT))
    inside = gaps[(gaps >= span[0]) & (gaps <= span[1])]
    ax.hist(inside, bins=BINS, range=span, color=OKABE_ITO["sky"], edgecolor="white", linewidth=0.3)
    outside = 1 - len(inside) / len(gaps)
    note = f"percentiles {SUPPORT[0]:g} and {SUPPORT[1]:g}: {low:.3g} m and {high:.3g} m"
    if outside:
        note += f"; {outside:.1%} of the gaps lie outside the figure"
    dress(ax, x="gap (m)", y="measured\nsamples")
    ax.set_title(note, fontsize=SMALL_FONT, color=GREY, loc="left")
    return low, high


def follower_errors(rows: pd.DataFrame) -> Figure:
    """Spacing and speed errors of followers, the largest first, with their biases.

    Args:
        rows: see :func:`nnode.app.followers.follower_errors`.
    """
    figure = new_figure(7.2, 3.4)
    axes = figure.subplots(1, 2)
    for ax, what, unit in zip(axes, ("spacing", "speed"), ("m", "m/s"), strict=True):
        order = np.argsort(-rows[f"{what}_rmse"].to_numpy(), kind="stable")
        place = np.arange(1, len(rows) + 1)
        for i, (kind, label) in enumerate((("rmse", "RMSE"), ("bias", "bias"))):
            style = curve_style(i) | {"linestyle": "none", "label": label}
            ax.plot(place, rows[f"{what}_{kind}"].to_numpy()[order], markersize=3, **style)
        ax.axhline(0, color=GREY, linewidth=0.8)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        dress(ax, x="followers, by decreasing RMSE", y=f"{what} error ({unit})")
    axes[0].legend(fontsize=SMALL_FONT, frameon=False)
    return figure


def driver_figure(
    table: pd.DataFrame, names: list[str], variability: pd.DataFrame, units: Mapping[str, str]
) -> Figure:
    """The parameters of drivers in ascending order, with bars of one standard error.

    Args:
        table: a row per driver with ``NAME`` and ``NAME_error``.
        names: the parameters, one panel each.
        variability: table by name with the standard deviation between drivers, ``estimate``, %.
        units: name to unit.
    """
    figure = new_figure(1.2 + 3.4 * len(names), 3.4)
    panels = figure.subplots(1, len(names), squeeze=False)[0]
    for i, (ax, name) in enumerate(zip(panels, names, strict=True)):
        rows = table.sort_values(name)
        color = curve_style(i)["color"]
        ax.errorbar(
            rows[name],
            np.arange(1, len(rows) + 1),
            xerr=rows[f"{name}_error"],
            fmt="o",
            markersize=3,
            linewidth=0.8,
            color=color,
        )
        ax.axvline(float(rows[name].median()), color=GREY, linewidth=0.8, linestyle="--")
        title = f"standard deviation between drivers {variability.estimate[name]:.3g} %"
        label = with_unit(name, units.get(name, ""))
        dress(ax, x=label, y="driver, in order" if i == 0 else "", title=title)
    return figure
