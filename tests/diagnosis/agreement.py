"""How far what an engine computes is from what simulations say."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.model import System


def distance(found: Tensor, expected: Tensor) -> float:
    """Distance relative to what is expected, which is not zero."""
    assert expected.any()
    return float((found - expected).norm() / expected.norm())


def residuals(engine: Any, system: System) -> Tensor:
    """``(n,)`` of a system's own parameters."""
    found: Tensor = engine.residuals(system, ParameterVector(system).row[None])[0]
    return found


def differences(engine: Any, system: System, row: Tensor, step: Tensor) -> Tensor:
    """``(P, n)`` central differences of the residuals by parameters."""
    above, below = (engine.residuals(system, row + torch.diag(s)) for s in (step, -step))
    return (above - below) / (2 * step[:, None])
