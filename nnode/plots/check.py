"""Speeds, sampling steps and presence of agents in a file of trajectories."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from nnode.data.limits import Range
from nnode.data.sequence import Domain
from nnode.data.trajectories import Trajectories
from nnode.data.units import displacements
from nnode.plots.style import GREY, OKABE_ITO, dress, new_figure

#: Largest number of drawn paths, and of drawn positions of each.
PATHS, POINTS = 300, 200


def speeds(rows: Trajectories, usual: Range) -> Figure:
    """Histograms of speeds over some samples, m/s, and of sampling steps, s."""
    figure = new_figure(8.6, 2.8)
    left, right = figure.subplots(1, 2)
    moves = displacements(rows)
    values = moves.size / moves.took
    top = max(float(np.percentile(values, 99.5)) * 1.1, 1.3 * usual.high) if values.size else 1.0
    left.axvspan(usual.low, usual.high, color=OKABE_ITO["orange"], alpha=0.25, linewidth=0)
    left.hist(np.clip(values, 0, top), bins=60, range=(0, top), color=OKABE_ITO["blue"])
    dress(left, x="speed (m/s)", y="displacements")
    steps = rows.steps.round(6)  # equal steps differ by rounding, which would divide a bar
    end = float(np.clip(np.percentile(steps, 99.9), 1.5 * rows.dt, 5 * rows.dt))
    right.hist(np.clip(steps, 0, end), bins=61, range=(0, end), color=OKABE_ITO["blue"])
    right.set_yscale("log")
    right.set_ylim(bottom=0.7)
    dress(right, x="time between neighbouring samples (s)", y="steps")
    return figure


def presence(rows: Trajectories, domain: Domain) -> Figure:
    """Positions of agents over time along the axis of their motion, and their number."""
    figure = new_figure(8.6, 4.6)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
    start, end = rows.ends()
    axis = int(np.argmax(np.abs(rows.x[end] - rows.x[start]).sum(axis=0)))
    every = max(1, -(-len(start) // PATHS))
    lines = []
    for a, b in zip(start[::every], end[::every], strict=True):
        k = np.unique(np.linspace(a, b, POINTS).astype(int))
        lines.append(np.column_stack([rows.time[k], rows.x[k, axis]]))
    above.add_collection(LineCollection(lines, colors=OKABE_ITO["blue"], linewidths=0.6))
    above.autoscale()
    along = f"{'xy'[axis]} (m)" if domain == "crowd" else "position (m)"
    dress(above, y=along)
    # by first and last times: counts at the samples would bridge times without any agent
    events = np.concatenate([rows.time[start], rows.time[end]])
    change = np.repeat([1, -1], len(start))
    order = np.argsort(events, kind="stable")
    below.fill_between(
        events[order],
        np.cumsum(change[order]),
        step="post",
        color=GREY,
        alpha=0.5,
        linewidth=0,
    )
    below.set_ylim(0)
    dress(below, x="time (s)", y="agents")
    return figure
