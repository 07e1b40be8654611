"""Cost and gradient of many runs of a model at once, as functions of parameter vectors."""

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
    """Cost of R runs of a model on one batch, with separate parameters for each run.

    A run is a row of K numbers, the calibrated parameters. Rows are float64 for every precision of
    the simulation.

    Args:
        system: the model, which is not changed. Parameters that need no gradient keep its values.
        batch: the sequences, in the precision of the system.
        solver: gives step, method and threads.
        convention: the cost.

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
        """``(R, B)`` cost of every sequence, inf if a simulation blows up; without gradient."""
        with torch.no_grad():
            costs = self._costs(self.vector.runs(rows)).double()
        return torch.where(torch.isfinite(costs), costs, math.inf)

    def __call__(self, rows: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """``(R,)`` weighted costs and their ``(R, K)`` gradients.

        Args:
            weights: ``(R, B)`` or ``(B,)`` weight of every sequence; None takes the mean.
        """
        stacked = {n: p.clone().requires_grad_() for n, p in self.vector.runs(rows).items()}
        each = self._costs(stacked)
        if weights is None:
            cost = each.mean(1)
        else:
            # a sequence with weight 0 may blow up
            cost = torch.where(weights > 0, each * weights.to(each), 0.0).sum(1)
        parts = torch.autograd.grad(cost.sum(), list(stacked.values()))
        gradient = torch.cat([part.reshape(len(rows), -1) for part in parts], 1).double()
        if weights is not None:
            weights = weights.expand(each.shape)
            spoiled = torch.isfinite(cost) & ~torch.isfinite(gradient).all(1)
            for r in (spoiled & (weights == 0).any(1)).nonzero().flatten().tolist():
                gradient[r] = self._gradient_of_weighted(rows[r], weights[r])
        return cost.detach().double(), gradient

    def _gradient_of_weighted(self, row: Tensor, weights: Tensor) -> Tensor:
        """``(K,)`` gradient of one run, simulated without the sequences of weight 0.

        The derivative of a simulation that blows up is NaN, also if it is multiplied by 0.
        """
        places = weights.nonzero().flatten()
        batch = self.batch.select(places.tolist())
        part = EnsembleCost(self.system, batch, self.solver, self.convention)
        return part(row[None], weights[places])[1][0]

    def _costs(self, stacked: Mapping[str, Tensor]) -> Tensor:
        trajectory = self.solver.ensemble(self.system, stacked, self.batch)
        return sequence_costs(trajectory, self.batch, self.convention)
