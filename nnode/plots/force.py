"""A compact figure of a model of either domain."""

from __future__ import annotations

from collections.abc import Iterable

from matplotlib.figure import Figure

from nnode.data.sequence import Sequence
from nnode.model import System
from nnode.plots.crowd import head_on_figure, relative_positions
from nnode.plots.traffic import follow_law, measured_speeds, speed_curves


def force_figure(system: System, sequences: Iterable[Sequence] = ()) -> Figure:
    """The speed curve of a traffic model, or both force components of a head-on pair of people.

    Args:
        sequences: measured sequences, drawn as points: gaps and speeds of followers, or positions
            of people relative to others.

    Raises:
        ConfigError: the model has neither a law of the gap nor an interaction force.
    """
    items = list(sequences)
    if system.domain == "traffic":
        points = measured_speeds(items, system) if items else None
        return speed_curves({follow_law(system).name: system}, points=points)
    return head_on_figure(system, points=relative_positions(items) if items else None)
