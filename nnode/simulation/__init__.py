"""Solvers with one interface, which compute trajectories and their gradients."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nnode.simulation.base import Solver, Trajectory, substeps
from nnode.simulation.ode import TorchdiffeqSolver

if TYPE_CHECKING:
    from nnode.simulation.fused import FusedSolver

__all__ = ["FusedSolver", "Solver", "TorchdiffeqSolver", "Trajectory", "substeps"]


def __getattr__(name: str) -> Any:
    # importing Numba takes a second, so it is delayed until compiled code is needed
    if name == "FusedSolver":
        from nnode.simulation.fused import FusedSolver

        return FusedSolver
    raise AttributeError(f"module {__name__} has no attribute {name}")
