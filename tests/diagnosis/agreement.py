"""Comparisons of an engine's derivatives with differences of simulations."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.model import System


def distance(actual: Tensor, expected: Tensor) -> float:
    """Distance relative to the expected values, which are not zero."""
    assert expected.any()
    return float((actual - expected).norm() / expected.norm())


def residuals(engine: Any, system: System) -> Tensor:
    """``(n,)`` with a system's parameters."""
    residual: Tensor = engine.residuals(system, ParameterVector(system).row[None])[0]
    return residual


def differences(engine: Any, system: System, row: Tensor, step: Tensor) -> Tensor:
    """``(P, n)`` central differences of the residuals by the parameters."""
    above, below = (engine.residuals(system, row + torch.diag(s)) for s in (step, -step))
    return (above - below) / (2 * step[:, None])
