"""The right-hand side of a batch, counted in steps."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor, nn

from nnode.data.sequence import Batch
from nnode.model.system import System


class Rates(nn.Module):
    """Change of the state in one step: time counted in steps is exact in any precision.

    A sequence that is shorter than its batch stands still after its end, so that nothing that
    nobody measured can blow up and spoil the gradient of the others.

    Args:
        steps: in a sampling interval.
        method: what becomes of a law of vehicles in a step, see :mod:`nnode.model.steps`.
    """

    def __init__(self, system: System, batch: Batch, steps: int, method: str = "euler") -> None:
        super().__init__()
        self.system, self.dt = system, batch.dt / steps
        self.scene = replace(system.scene(batch), step=self.dt, method=method)
        last = batch.valid.any(-1).sum(0) - 1
        self.end = steps * last[:, None, None]
        self.ragged = bool((last < batch.n_samples - 1).any())

    def forward(self, step: Tensor, y: Tensor) -> Tensor:
        """``(B, N, order * D)``: change of ``y`` from ``step`` to the next."""
        return self.until_the_end(step, self.dt * self.system(step * self.dt, y, self.scene))

    def until_the_end(self, step: Tensor, rate: Tensor) -> Tensor:
        """A change of the state, and none of the sequences that have ended."""
        # the end itself still moves: integrating backwards starts there
        return rate.where(step <= self.end, 0.0) if self.ragged else rate
