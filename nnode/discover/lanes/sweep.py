"""How vehicles are moved by small changes of their rates: from the front of a lane backwards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from nnode.discover.lanes.motion import Slopes

#: By numbers of two states, each ``(N - 1, K, B)``.
_Blocks = dict[tuple[int, int], np.ndarray]


@dataclass
class Sweep:
    """The linearised equations along one run, d' = A d + s, by the trapezoidal rule.

    A vehicle's rates depend on itself, on the two ahead, and on the speed of the first of these:
    so at each time the vehicles are solved one by one, from the front on.

    Args:
        slopes: along the run.
        width: M, the number of a vehicle's states.
        dt: sampling interval, s.
    """

    slopes: Slopes
    width: int
    dt: float

    def __post_init__(self) -> None:
        half, m = self.dt / 2, self.width
        found = self.slopes
        self._first, self._second = (
            {key: half * value for key, value in part.items()}
            for part in (found.first, found.second)
        )
        self._inverse = _inverse(found.own, half, m)

    def rates(self, d: np.ndarray, k: int) -> np.ndarray:
        """A d at one time, of ``(M, N, C, B)``."""
        found, own = np.zeros_like(d), self.slopes
        for i in range(d.shape[1] - 2, -1, -1):
            for part, ahead in ((own.own, 0), (own.first, 1), (own.second, 2)):
                for (p, q), slope in part.items():
                    if i + ahead < d.shape[1]:
                        found[p, i] += slope[i, k] * d[q, i + ahead]
            for p, slope in own.chain.items():
                found[p, i] += slope[i, k] * found[0, i + 1]
        return found

    def moved(self, source: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """``(K, N, C, B)`` m: positions moved by changes of the rates.

        Args:
            source: ``(K, W, N, C, B)`` changes of the first W states' rates; the others' do not
                change.
            start: ``(M, N, C, B)`` changes of the states at the start, by default none.
        """
        times, known, n, c, b = source.shape
        d = np.zeros((self.width, n, c, b)) if start is None else start.copy()
        # what one half of the rule makes of the states: d + dt / 2 A d
        half = d.copy() if start is None else d + self.dt / 2 * self.rates(d, 0)
        right, share = np.empty_like(d), np.empty((c, b))
        found = np.empty((times, n, c, b))
        found[0] = d[0]
        for k in range(1, times):
            right[:] = half
            right[:known] += self.dt / 2 * (source[k - 1] + source[k])
            d[:, -1] = right[:, -1]
            for i in range(n - 2, -1, -1):
                self._solve(d, right, i, k, share)
            # the other half follows from what was solved: d - dt / 2 A d = right
            np.multiply(d, 2.0, out=half)
            half -= right
            found[k] = d[0]
        return found

    def _solve(self, d: np.ndarray, right: np.ndarray, i: int, k: int, share: np.ndarray) -> None:
        """The states of vehicle ``i`` at a time, those ahead of it being known."""
        rest = right[:, i]
        if len(self._first) + len(self._second) + len(self.slopes.chain):
            rest = rest.copy()
        for part, ahead in ((self._first, 1), (self._second, 2)):
            if i + ahead < d.shape[1]:
                for (p, q), slope in part.items():
                    np.multiply(slope[i, k], d[q, i + ahead], out=share)
                    rest[p] += share
        for p, slope in self.slopes.chain.items():
            np.subtract(d[0, i + 1], right[0, i + 1], out=share)
            share *= slope[i, k]
            rest[p] += share
        if not self._inverse:
            d[:, i] = rest
            return
        d[:, i] = 0.0
        for (p, q), inverse in self._inverse.items():
            np.multiply(inverse[i, k], rest[q], out=share)
            d[p, i] += share


def _inverse(own: Mapping[tuple[int, int], np.ndarray], half: float, width: int) -> _Blocks:
    """Entries of (1 - half own)^-1 that are not all zero; none at all where own is zero."""
    if not own:
        return {}
    matrix = np.zeros((*next(iter(own.values())).shape, width, width))
    matrix += np.eye(width)
    for (p, q), slope in own.items():
        matrix[..., p, q] -= half * slope
    if width == 1:
        inverse = 1 / matrix
    else:  # of a model that blows up there may be none
        found, info = torch.linalg.inv_ex(torch.from_numpy(matrix))
        inverse = torch.where(info[..., None, None] == 0, found, torch.nan).numpy()
    return {
        (p, q): np.ascontiguousarray(inverse[..., p, q])
        for p in range(width)
        for q in range(width)
        if p == q or inverse[..., p, q].any()
    }
