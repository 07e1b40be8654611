"""Vehicles behind each other, in compiled code."""

from nnode.simulate.kernels.lanes.runs import simulate, supports, tangents

__all__ = ["simulate", "supports", "tangents"]
