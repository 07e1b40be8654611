"""Figures of calibrated models and of data."""

from nnode.plots.crowd import force_contours
from nnode.plots.force import force_figure
from nnode.plots.settings import six_settings
from nnode.plots.style import save
from nnode.plots.traffic import curve_table, measured_gaps, speed_curves

__all__ = [
    "curve_table",
    "force_contours",
    "force_figure",
    "measured_gaps",
    "save",
    "six_settings",
    "speed_curves",
]
