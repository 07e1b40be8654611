"""Compiled simulation and exact discrete gradients on the processor, by Numba."""

from nnode.solvers.fused.engine import FusedSolver

__all__ = ["FusedSolver"]
