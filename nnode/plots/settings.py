"""Forces on two people in six settings of positions and velocities."""

from __future__ import annotations

from collections.abc import Sequence as Items
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nnode.model import System
from nnode.model.extend import omitted_effects
from nnode.plots.interaction import (
    Part,
    Vector,
    describe,
    evaluate_force,
    force_range,
    interaction,
)
from nnode.plots.style import FONT, GREY, OKABE_ITO, SMALL_FONT, dress, new_figure


@dataclass(frozen=True)
class Setting:
    """Two people: positions in m, velocities in m/s."""

    name: str
    x_blue: Vector
    x_red: Vector
    v_blue: Vector
    v_red: Vector


def _settings(ahead: float, lateral: float) -> tuple[Setting, ...]:
    """The six settings; people are 2 ``ahead`` (m) or 2 ``lateral`` (m) apart."""
    places = (
        ((0.0, ahead), (0.0, -ahead)),
        ((0.01, ahead), (-0.01, -ahead)),
        ((lateral, 0.0), (-lateral, 0.0)),
    )
    pairs = product(places, ((0.0, -1.0), (0.0, 1.0)))
    return tuple(
        Setting(f"S{i}", *place, v_blue, (0.0, 1.0)) for i, (place, v_blue) in enumerate(pairs, 1)
    )


#: Source: Göttlich & Totzeck, tables (data6settings) and (data6settingsNN).
SETTINGS = {
    "short": _settings(ahead=0.22, lateral=0.22),
    "long": _settings(ahead=4.0, lateral=0.5),
}


def six_settings(
    system: System, settings: Items[Setting] | None = None, *, part: Part | None = None
) -> tuple[Figure, pd.DataFrame]:
    """Forces on two people in the paper's six settings, drawn and as a table.

    On the left, the people face each other; on the right, they walk in the same direction. Arrows
    have one scale in all panels, which the keys above the panels show. The panels show different
    sections of space.

    Args:
        settings: settings; by default those of the paper, in which people are 0.44 m apart for the
            social force, and 8 m or 1 m for other forces.
        part: see :func:`evaluate_force`.

    Returns:
        The figure, and the table with the columns ``setting``, ``x_blue``, ``x_red`` (m),
        ``v_blue``, ``v_red`` (m/s), ``force_blue``, ``force_red`` (N); each cell is (x, y).

    Raises:
        ConfigError: no interaction force.

    Source: Göttlich & Totzeck, tables (data6settings), (data6settingsNN), figures (6Helbing),
    (6NN).
    """
    term = interaction(system)
    chosen = SETTINGS[force_range(term)] if settings is None else tuple(settings)
    table = pd.DataFrame(map(vars, chosen)).rename(columns={"name": "setting"})
    dx, dv = (np.subtract([*table[f"{k}_blue"]], [*table[f"{k}_red"]]) for k in "xv")
    for person, sign in (("blue", 1), ("red", -1)):
        force = evaluate_force(system, sign * dx, sign * dv, part)
        table[f"force_{person}"] = [tuple(map(float, row)) for row in force]
    what = ", ".join(filter(None, (describe(term, part), omitted_effects(system))))
    return _quivers(table, what), table


#: Lengths (inches) of the longest velocity and of the longest force arrow.
LONGEST = {"v": 0.40, "force": 0.60}
WIDTH = 5.4
#: Half width of a panel, in units of the larger coordinate of its people.
ROOM = 2.4

_ARROW: dict[str, dict[str, Any]] = {
    "v": {"width": 0.06, "headwidth": 2.6, "headlength": 2.4, "headaxislength": 2.2, "alpha": 0.6},
    "force": {"width": 0.02, "headwidth": 5.0, "color": "black", "zorder": 4},
}
_PERSON: dict[str, dict[str, Any]] = {
    "blue": {"color": OKABE_ITO["blue"], "marker": "o"},
    "red": {"color": OKABE_ITO["vermillion"], "marker": "s"},
}


def _quivers(table: pd.DataFrame, what: str) -> Figure:
    """The figure of :func:`six_settings`."""
    rows = (len(table) + 1) // 2
    figure = new_figure(WIDTH, 2.45 * rows + 0.6)
    grid = figure.add_gridspec(rows + 1, 2, height_ratios=[0.16, *[1.0] * rows])
    longest = {kind: _longest(table, kind) for kind in LONGEST}
    scale = {kind: longest[kind] / inches for kind, inches in LONGEST.items()}
    for i, (_, row) in enumerate(table.iterrows()):
        ax = figure.add_subplot(grid[1 + i // 2, i % 2])
        half = ROOM * max(*map(abs, (*row["x_blue"], *row["x_red"])), 1e-3)
        for person in _PERSON:
            where = row[f"x_{person}"]
            _arrow(ax, "v", where, row[f"v_{person}"], scale, color=_PERSON[person]["color"])
            _arrow(ax, "force", where, row[f"force_{person}"], scale)
            _person(ax, person, where)
        ax.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(MaxNLocator(4))
        dress(ax, x="x (m)", y="y (m)", title=str(row["setting"]))
    _key(figure.add_subplot(grid[0, :]), longest, scale)
    figure.suptitle(what, fontsize=FONT)
    return figure


def _longest(table: pd.DataFrame, kind: str) -> float:
    """Largest length of a vector in the table; 1 if all are zero."""
    norms = np.hypot(*np.array([*table[f"{kind}_blue"], *table[f"{kind}_red"]]).T)
    return float(np.max(norms[np.isfinite(norms)], initial=0.0)) or 1.0


def _arrow(
    ax: Axes, kind: str, where: Vector, vector: Vector, scale: dict[str, float], **style: Any
) -> None:
    # a length in inches is the same in panels that show different sections of space
    ax.quiver(
        *where,
        *vector,
        scale=scale[kind],
        gid=kind,
        angles="uv",
        scale_units="inches",
        units="inches",
        minlength=0,
        **(_ARROW[kind] | style),
    )


def _person(ax: Axes, person: str, where: Vector) -> None:
    ax.plot(
        *where,
        markersize=7,
        markeredgecolor="white",
        markeredgewidth=0.7,
        zorder=3,
        gid=person,
        **_PERSON[person],
    )


def _key(ax: Axes, longest: dict[str, float], scale: dict[str, float]) -> None:
    """Draw the legend of markers and arrows, with the lengths of the arrows."""
    width = WIDTH * 0.9  # inches, about
    ax.set(xlim=(0, 1), ylim=(0, 1))
    ax.set_axis_off()
    for x, person in ((0.03, "blue"), (0.17, "red")):
        _person(ax, person, (x, 0.5))
        ax.text(x + 0.03, 0.5, person, fontsize=SMALL_FONT, va="center")
    for x, kind, name, unit in ((0.31, "v", "velocity", "m/s"), (0.61, "force", "force", "N")):
        color = {"v": GREY, "force": "black"}[kind]
        _arrow(ax, kind, (x, 0.5), (longest[kind], 0.0), scale, color=color)
        says = f"{name},\nthis long: {longest[kind]:.3g} {unit}"
        ax.text(x + LONGEST[kind] / width + 0.02, 0.5, says, fontsize=SMALL_FONT, va="center")
