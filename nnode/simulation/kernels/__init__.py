"""Simulations in compiled code that is generated from formulas, with exact gradients."""

from __future__ import annotations

from nnode.model.system import Crowd, System, Traffic


def source(model: System) -> str:
    """The generated source code that simulates a model.

    Raises:
        ValueError: the model has a term that is not a formula.
    """
    from nnode.simulation.kernels.crowds import CrowdSource
    from nnode.simulation.kernels.lanes import LaneSource

    if isinstance(model, Traffic) and model.formula is not None and model.formula.is_formula:
        return LaneSource(model.formula).text()
    if isinstance(model, Crowd) and model.formula is not None:
        return CrowdSource(model.formula).text()
    raise ValueError("the model has a term that is code of its own: it runs in PyTorch")
