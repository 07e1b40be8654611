"""Exact tangents of crowds: forward-mode derivatives of the steps, by PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call

from nnode.calibrate.cost import FOLLOWING
from nnode.calibrate.gauss_newton.method import TangentCost
from nnode.errors import ConfigError
from nnode.models.system import Crowd
from nnode.solvers.base import observed, simulated_batch, substeps
from nnode.solvers.fused.engine import replaced
from nnode.solvers.rates import Rates


class CrowdTangentCost(TangentCost):
    """Cost of every sequence of a batch of people with its derivatives.

    Costs alone come from the compiled solver; derivatives take some hundred times as long, so that
    models of few parameters are what it is for.

    Raises:
        ConfigError: a network among the terms, terms that are code, or a cost of vehicles.
    """

    def _owned(self) -> dict[str, Any]:
        system = self.system
        law = system.formula if isinstance(system, Crowd) else None
        if law is None or any(axes is not None for _, _, axes in law.owned.values()):
            raise ConfigError(
                "optimizer=gauss_newton needs a model of people whose terms are formulas without "
                "networks, as model=sf; take another optimizer"
            )
        if self.convention in FOLLOWING:
            raise ConfigError(
                f"trainer.cost={self.convention.value} is one of vehicles that follow another; "
                "take integral or sum for people"
            )
        return law.owned

    def _errors(self, x: Tensor, v: Tensor | None) -> tuple[Tensor, Tensor]:
        """``(K, B, N D)`` errors of both coordinates, and which count."""
        seen = self.batch.valid.repeat_interleave(self.system.dim, -1)
        return torch.where(seen, x - self.batch.x.flatten(-2), 0.0), seen

    def _simulated(
        self, rows: np.ndarray, names: Sequence[str]
    ) -> tuple[Tensor, Tensor | None, Tensor, Tensor | None]:
        """Positions ``(K, B, N D)`` and their derivatives ``(P, K, B, N D)``."""
        row = torch.from_numpy(np.array(rows, dtype=np.float64))
        if not names:
            known = {name: p.detach() for name, p in self.system.named_parameters()}
            with torch.no_grad():
                x = self.solver.unchecked(
                    replaced(self.system, known | self._parameters(row)), self.batch
                ).x
            return x.flatten(-2), None, x.new_zeros(0), None
        n = substeps(self.batch.dt, self.solver.dt, self.system)
        near, origin = simulated_batch(self.system, self.batch)
        rates, start = Rates(self.system, near, n), self.system.initial(near)
        times = torch.arange(n * (self.batch.n_samples - 1), dtype=start.dtype)

        def path(row: Tensor) -> tuple[Tensor, Tensor]:
            values = {f"system.{name}": p for name, p in self._parameters(row).items()}
            states = [start]
            for step in times:
                states.append(states[-1] + functional_call(rates, values, (step, states[-1])))
            x = observed(self.system, torch.stack(states[::n]), self.batch, origin).x.flatten(-2)
            return x, x

        slope, x = torch.func.jacfwd(path, has_aux=True)(row)
        return x, None, slope.movedim(-1, 0), None

    def _parameters(self, row: Tensor) -> dict[str, Tensor]:
        """A row ``(P,)`` as the model's calibrated parameters by name."""
        names = (self._places[symbol][0] for symbol in self.names)
        return {name: row[i].to(self._own[name]) for i, name in enumerate(names)}
