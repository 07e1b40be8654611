"""Simulations in compiled code that is made from formulas, with exact gradients."""

from __future__ import annotations

from nnode.models.system import Traffic


def source(model: Traffic) -> str:
    """The code that simulates a model of a lane, to be read.

    Raises:
        ValueError: the model has a term that is no formula.
    """
    from nnode.simulate.lane_source import LaneSource

    lane = model.lane
    if lane is None or not lane.is_formula:
        raise ValueError("the model has a term that is code of its own: it runs in PyTorch")
    return LaneSource(lane).text()
