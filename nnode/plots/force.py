"""One compact figure of what a model has learned, whatever its domain."""

from __future__ import annotations

from matplotlib.figure import Figure

from nnode.model import System
from nnode.plots.crowd import head_on_figure
from nnode.plots.traffic import follow_law, speed_curves


def force_figure(system: System) -> Figure:
    """The speed curve of a traffic model, or both force components of a head-on pair of people.

    Raises:
        ConfigError: the model has neither a law of the gap nor an interaction force.
    """
    if system.domain == "traffic":
        return speed_curves({follow_law(system).name: system})
    return head_on_figure(system)
