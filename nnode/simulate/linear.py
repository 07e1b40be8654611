"""The linear response of a simulated path: how small changes move it, without simulating again.

Along a path y(t) of dy/dt = f(t, y) small changes d of the states obey d' = A(t) d + s(t), where A
is the derivative of f by the states and s a change of the rates. The trapezoidal rule solves this
at the sampling times, in time proportional to their number.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


class DenseSolver:
    """Equations where all states of a group depend on all.

    Args:
        matrix: A, ``(K, B, M N, M N)``, one state of all agents after the other.
        width: M. dt: sampling interval, s.
    """

    def __init__(self, matrix: np.ndarray, width: int, dt: float) -> None:
        half, one = dt / 2 * torch.from_numpy(matrix), torch.eye(matrix.shape[-1]).double()
        self._width, self._half = width, dt / 2
        self._after = _inverse(one - half[1:])
        self._step = self._after @ (one + half[:-1])

    def response(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """``(K, N, C, B)`` changes of the first state, by changes of rates and starts.

        Args:
            source: ``(K, W, N, C, B)`` changes of the first W states' rates; the others' do not
                change.
            start: ``(M, N, C, B)`` changes of the states at the start; None: there are none.
        """
        k, w, n, c, b = source.shape
        every = np.zeros((k, self._width, n, c, b))
        every[:, :w] = source
        flat = torch.from_numpy(every).flatten(1, 2).permute(0, 3, 1, 2)
        forced = self._after @ (self._half * (flat[1:] + flat[:-1]))
        state = flat.new_zeros(flat.shape[1:])
        if start is not None:
            state = torch.from_numpy(start).flatten(0, 1).permute(2, 0, 1).contiguous()
        found = [state]
        for step, change in zip(self._step, forced, strict=True):
            found.append(step @ found[-1] + change)
        moved: np.ndarray = torch.stack(found)[:, :, :n].permute(0, 2, 3, 1).numpy()
        return moved


def _inverse(matrix: Tensor) -> Tensor:
    """Inverse matrices; no numbers where there is none, as of a model that blows up."""
    found, info = torch.linalg.inv_ex(matrix)
    return torch.where(info[..., None, None] == 0, found, torch.nan)
