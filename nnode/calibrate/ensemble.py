"""Many runs of one model at once: cost and gradient as functions of flat parameter vectors."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from nnode.calibrate.cost import Convention, sequence_costs
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver


class EnsembleCost:
    """Cost of R runs of a model on one batch, each run with parameters of its own.

    A run is a row of K numbers: all parameters that are calibrated, one after the other.
    Rows are in float64 whatever the precision of the simulation.

    Args:
        system: the model; it is not changed. Parameters that need no gradient stay its own.
        batch: the sequences, in the precision of the system.
        solver: its step, method and threads.
        convention: what is minimised.

    Attributes:
        vector: the parameters that are calibrated.
        low, high: ``(K,)`` the admissible set.
    """

    def __init__(
        self,
        system: System,
        batch: Batch,
        solver: FusedSolver,
        convention: Convention = Convention.integral,
    ) -> None:
        self.system, self.batch, self.solver = system, batch, solver
        self.convention, self.vector = convention, ParameterVector(system)
        self.low, self.high = (torch.from_numpy(end) for end in self.vector.bounds)

    def costs(self, rows: Tensor) -> Tensor:
        """``(R, B)`` cost of every sequence, inf where a simulation blows up; no gradient."""
        with torch.no_grad():
            found = self._costs(self.vector.runs(rows)).double()
        return torch.where(torch.isfinite(found), found, math.inf)

    def __call__(self, rows: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """``(R,)`` weighted costs and their ``(R, K)`` gradients.

        Args:
            weights: ``(R, B)`` or ``(B,)`` weight of every sequence; None takes the mean.
        """
        stacked = _leaves(self.vector.runs(rows))
        each = self._costs(stacked)
        if weights is None:
            cost = each.mean(1)
        else:
            # a sequence without weight must not spoil the sum where it blows up
            cost = torch.where(weights > 0, each * weights.to(each), 0.0).sum(1)
        parts = torch.autograd.grad(cost.sum(), list(stacked.values()))
        gradient = torch.cat([part.reshape(len(rows), -1) for part in parts], 1).double()
        if weights is not None:
            usable = torch.isfinite(cost) & ~torch.isfinite(gradient).all(1)
            for r in usable.nonzero().flatten().tolist():
                gradient[r] = self._without_the_rest(rows[r], weights.expand(each.shape)[r])
        return cost.detach().double(), gradient

    def _without_the_rest(self, row: Tensor, weights: Tensor) -> Tensor:
        """``(K,)`` gradient of one run, simulated without the sequences that have no weight.

        The derivative of a simulation that blows up is not a number, even times 0.
        """
        places = weights.nonzero().flatten()
        batch = self.batch.select(places.tolist())
        part = EnsembleCost(self.system, batch, self.solver, self.convention)
        each = part._costs(stacked := _leaves(self.vector.runs(row[None])))
        total = (each * weights[places].to(each)).sum()
        return torch.cat([g.flatten() for g in torch.autograd.grad(total, list(stacked.values()))])

    def _costs(self, stacked: Mapping[str, Tensor]) -> Tensor:
        found = self.solver.ensemble(self.system, stacked, self.batch)
        return sequence_costs(found, self.batch, self.convention)


def _leaves(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().clone().requires_grad_() for name, value in parameters.items()}
