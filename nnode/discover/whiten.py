"""Residuals without memory: an autoregressive filter along time and along the platoon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass
class PlatoonFilter:
    """What the past and the vehicle ahead tell of a residual, and how large the rest is.

    The rest is e_i(t) - sum_k own_k e_i(t - k) - sum_k ahead_k e_{i+1}(t - k), divided by its
    standard deviation; samples before the first count as zero, and so do the leader's.

    Attributes:
        own: ``(p,)`` weights of the vehicle's own p past samples.
        ahead: ``(p + 1,)`` weights of the vehicle ahead, the present sample first.
        scale: standard deviation of the rest, m.
    """

    own: np.ndarray
    ahead: np.ndarray
    scale: float

    @classmethod
    def none(cls, scale: float = 1.0) -> PlatoonFilter:
        """A filter that only scales."""
        return cls(np.zeros(0), np.zeros(1), scale)

    @classmethod
    def fitted(cls, residual: Tensor, valid: Tensor, order: int) -> PlatoonFilter:
        """The filter with the least mean square of the rest.

        Args:
            residual: ``(K, B, N)`` m; 0 where not valid.
            valid: ``(K, B, N)`` True where a follower was measured.
            order: p.
        """
        columns = _lagged(residual, order)
        e, design = residual[valid].numpy(), torch.stack(columns, -1)[valid].numpy()
        gram = design.T @ design
        # a hair of damping, for platoons of two have nobody ahead who deviates
        gram += 1e-9 * max(np.trace(gram), 1e-12) * np.eye(len(gram))
        weights = np.linalg.solve(gram, design.T @ e)
        rest = e - design @ weights
        scale = float(np.sqrt(np.mean(rest**2)))
        return cls(weights[:order], weights[order:], max(scale, 1e-9))

    def __call__(self, residual: Tensor) -> Tensor:
        """``(..., K, B, N)`` whitened residuals of ``(..., K, B, N)``."""
        columns = _lagged(residual, len(self.own))
        rest = residual.clone()
        for weight, column in zip([*self.own, *self.ahead], columns, strict=True):
            if weight:
                rest -= float(weight) * column
        return rest / self.scale


def _lagged(e: Tensor, order: int) -> list[Tensor]:
    """The p past samples of each vehicle, and the p + 1 samples of the vehicle ahead."""
    ahead = torch.cat([e[..., 1:], torch.zeros_like(e[..., :1])], -1)
    return [_late(e, k) for k in range(1, order + 1)] + [_late(ahead, k) for k in range(order + 1)]


def _late(e: Tensor, k: int) -> Tensor:
    """``e`` as it was k samples ago; 0 before the first."""
    if not k:
        return e
    return torch.cat([torch.zeros_like(e[..., :k, :, :]), e[..., :-k, :, :]], -3)
