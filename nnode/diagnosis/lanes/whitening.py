"""Whitening of platoons: an autoregressive filter along time and along the platoon."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nnode.diagnosis import thresholds


@dataclass
class PlatoonFilter:
    """An autoregressive filter with the vehicle's own past and the vehicle ahead.

    The innovation is e_i(t) - sum_k past_k e_i(t - k) - sum_k ahead_k e_{i+1}(t - k), divided by
    its standard deviation. Samples before the first, and those of the leader, count as zero.

    Attributes:
        past: ``(p,)`` weights of the vehicle's p past samples.
        ahead: ``(p + 1,)`` weights of the vehicle ahead, the present sample first.
        scale: standard deviation of the innovations, m.
    """

    past: np.ndarray
    ahead: np.ndarray
    scale: float

    @classmethod
    def none(cls, scale: float = 1.0) -> PlatoonFilter:
        """A filter that only scales."""
        return cls(np.zeros(0), np.zeros(1), scale)

    @classmethod
    def fitted(cls, residual: Tensor, valid: Tensor, order: int) -> PlatoonFilter:
        """The filter with the smallest mean square of the innovations.

        The filter is fitted to residuals without each vehicle's mean. Otherwise it would absorb
        constant offsets, which are what effects produce.

        Args:
            residual: ``(K, B, N)`` m; 0 where not valid.
            valid: ``(K, B, N)`` True where a follower was measured.
            order: p.
        """
        mean = torch.where(valid, residual, 0.0).sum(0) / valid.sum(0).clamp(min=1)
        centred = torch.where(residual != 0, residual - mean, 0.0)
        columns = _lagged(centred, order)
        e, design = centred[valid].numpy(), torch.stack(columns, -1)[valid].numpy()
        gram = design.T @ design
        gram += max(thresholds.RIDGE**2 * np.trace(gram) / len(gram), 1e-12) * np.eye(len(gram))
        weights = np.linalg.solve(gram, design.T @ e)
        unscaled = cls(weights[:order], weights[order:], 1.0)
        scale = float(unscaled(residual)[valid].square().mean().sqrt())
        return replace(unscaled, scale=max(scale, 1e-9))

    def __call__(self, residual: Tensor) -> Tensor:
        """``(..., K, B, N)`` whitened residuals of ``(..., K, B, N)``."""
        whitened, k = residual / self.scale, residual.shape[-3]
        for lag, weight in enumerate([0.0, *self.past]):
            if weight and lag < k:
                share = -float(weight) / self.scale
                whitened[..., lag:, :, :].add_(residual[..., : k - lag, :, :], alpha=share)
        for lag, weight in enumerate(self.ahead):
            if weight and lag < k:
                share = -float(weight) / self.scale
                followers = whitened[..., lag:, :, :-1]
                followers.add_(residual[..., : k - lag, :, 1:], alpha=share)
        return whitened


def _lagged(e: Tensor, order: int) -> list[Tensor]:
    """The p past samples of each vehicle, and the p + 1 samples of the vehicle ahead."""
    ahead = torch.cat([e[..., 1:], torch.zeros_like(e[..., :1])], -1)
    return [_late(e, k) for k in range(1, order + 1)] + [_late(ahead, k) for k in range(order + 1)]


def _late(e: Tensor, k: int) -> Tensor:
    """``e`` as it was k samples ago; 0 before the first."""
    if not k:
        return e
    return torch.cat([torch.zeros_like(e[..., :k, :, :]), e[..., :-k, :, :]], -3)
