"""Solvers: one interface, several ways to a trajectory and its gradient."""

from nnode.solvers.base import Solver, Trajectory, substeps
from nnode.solvers.ode import TorchdiffeqSolver

__all__ = ["Solver", "TorchdiffeqSolver", "Trajectory", "substeps"]
