"""Solvers: one interface, several ways to a trajectory and its gradient."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nnode.simulation.base import Solver, Trajectory, substeps
from nnode.simulation.ode import TorchdiffeqSolver

if TYPE_CHECKING:
    from nnode.simulation.fused import FusedSolver

__all__ = ["FusedSolver", "Solver", "TorchdiffeqSolver", "Trajectory", "substeps"]


def __getattr__(name: str) -> Any:
    # Numba takes a second to import: only who asks for compiled code waits for it
    if name == "FusedSolver":
        from nnode.simulation.fused import FusedSolver

        return FusedSolver
    raise AttributeError(f"module {__name__} has no attribute {name}")
