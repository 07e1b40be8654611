"""Simulations in compiled code that is made from formulas, with exact gradients."""

from __future__ import annotations

from typing import cast

from nnode.model.formula import crowd_of
from nnode.model.system import System, Traffic
from nnode.model.term import Term


def source(model: System) -> str:
    """The code that simulates a model, to be read.

    Raises:
        ValueError: the model has a term that is no formula.
    """
    from nnode.simulate.kernels.crowds.source import CrowdSource
    from nnode.simulate.kernels.lanes.source import LaneSource

    if isinstance(model, Traffic):
        lane = model.lane
        if lane is not None and lane.is_formula:
            return LaneSource(lane).text()
    else:
        law = crowd_of(cast(list[Term], list(model.terms)))
        if law is not None:
            return CrowdSource(law).text()
    raise ValueError("the model has a term that is code of its own: it runs in PyTorch")
