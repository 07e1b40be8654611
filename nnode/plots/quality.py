"""Figures of sequences with faults, for a visual check."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from nnode.data.quality import KINDS, Fault
from nnode.data.sequence import Domain, Sequence
from nnode.plots.style import GREY, OKABE_ITO, SMALL_FONT, dress, new_figure, save

#: Largest number of faulty sequences in a figure.
MAX_PANELS = 60
COLUMNS = 5

#: Colour and marker of every kind, the same in all figures. Colours repeat, markers do not.
STYLES = {
    kind: (colour, marker)
    for kind, colour, marker in zip(
        KINDS, cycle(c for name, c in OKABE_ITO.items() if name != "black"), "sXDv^oP*hd"
    )
}


def plot_faults(
    sequences: list[Sequence],
    faults: Mapping[str, list[Fault]],
    domain: Domain,
    path: Path | str,
) -> None:
    """Save :func:`faults_figure` of all sequences of one recording as PNG at ``path``."""
    save(faults_figure(sequences, faults, domain), path)


def faults_figure(
    sequences: list[Sequence],
    faults: Mapping[str, list[Fault]],
    domain: Domain,
    most: int = MAX_PANELS,
) -> Figure:
    """Space-time lines of sequences with faults, which are marked.

    Args:
        sequences: sequences with and without faults.
        faults: name of a sequence to its faults.
        domain: in a crowd the axis of the greater extent is drawn, and people without a fault
            are grey.
        most: largest number of drawn sequences.
    """
    faulty = [s for s in sequences if faults.get(s.name)]
    shown = faulty[:most]
    rows = math.ceil(len(shown) / COLUMNS)
    figure = new_figure(2.4 * COLUMNS, 2.2 + 2.0 * rows)
    grid = figure.add_gridspec(rows + 1, COLUMNS)
    _bars(figure.add_subplot(grid[0, :]), sequences, faulty, faults, most)
    used = dict.fromkeys(f.kind for s in shown for f in faults[s.name])
    for n, s in enumerate(shown):
        axes = figure.add_subplot(grid[1 + n // COLUMNS, n % COLUMNS])
        _panel(axes, s, faults[s.name], domain)
        dress(
            axes,
            x="time (s)" if n + COLUMNS >= len(shown) else "",
            y="position (m)" if n % COLUMNS == 0 else "",
            title=s.name,
        )
    handles = [
        Line2D([], [], color=STYLES[k][0], marker=STYLES[k][1], linestyle="", label=k) for k in used
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles) or 1)
    return figure


def _bars(
    axes: Axes,
    sequences: list[Sequence],
    faulty: list[Sequence],
    faults: Mapping[str, list[Fault]],
    most: int,
) -> None:
    counts = Counter(kind for s in faulty for kind in {f.kind for f in faults[s.name]})
    kinds = [kind for kind in KINDS if counts[kind]]
    bars = axes.barh(kinds, [counts[k] for k in kinds], color=[STYLES[k][0] for k in kinds])
    axes.bar_label(bars, padding=3, fontsize=SMALL_FONT)
    axes.invert_yaxis()
    axes.margins(x=0.06)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    recordings = {s.recording for s in sequences}
    which = recordings.pop() if len(recordings) == 1 else f"{len(recordings)} recordings"
    title = f"{which}: {len(faulty)} of {len(sequences)} sequences are faulty"
    if len(faulty) > most:
        title += f"; the first {most} are shown"
    dress(axes, x="sequences", title=title, grid=False)


def _panel(axes: Axes, s: Sequence, faults: list[Fault], domain: Domain) -> None:
    involved = {i for fault in faults for i in fault.agents}
    finite = np.where(np.isfinite(s.x), s.x, np.nan)
    axis = 0
    if domain == "crowd" and np.isfinite(finite).any():
        extent = np.nanmax(finite, axis=(0, 1)) - np.nanmin(finite, axis=(0, 1))
        axis = int(np.argmax(extent))
    for i in range(s.n_agents):
        grey = domain == "crowd" and i not in involved
        axes.plot(
            s.time,
            finite[:, i, axis],
            color="0.8" if grey else GREY,
            linewidth=0.8,
            marker="" if domain == "crowd" else ".",
            markersize=3,
        )
    for fault in faults:
        colour, marker = STYLES[fault.kind]
        k = 0 if fault.time is None else int(np.argmin(np.abs(s.time - fault.time)))
        agents = list(fault.agents) or [0]
        y = [finite[k, i, axis] for i in agents if i < s.n_agents]
        axes.plot([s.time[k]] * len(y), y, marker, color=colour, markersize=6, alpha=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=4))
