"""Figures of calibrated models and of data."""

from nnode.plots.crowd import crowd_figures, force_contours, six_settings
from nnode.plots.force import force_figure
from nnode.plots.style import save
from nnode.plots.traffic import curve_table, measured_gaps, speed_curves, traffic_figures

__all__ = [
    "crowd_figures",
    "curve_table",
    "force_contours",
    "force_figure",
    "measured_gaps",
    "save",
    "six_settings",
    "speed_curves",
    "traffic_figures",
]
