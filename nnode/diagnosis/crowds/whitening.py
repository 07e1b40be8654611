"""Whitening of a crowd's differences of positions: approximately independent, variance 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Numerical errors of a simulated position, m: a lower limit of all noise.
NUMERICAL = 3e-4
#: A person's window has weight 1/2 if its residuals are this many times the median.
OUTLYING = 3.0
#: Directions are left out if the variance of the differences is below this multiple of the
#: measurement noise's, but at least the FEWEST largest are kept.
TELLING, FEWEST = 1.25, 4
#: Number of iterations of weights and covariances.
ROUNDS = 4


@dataclass(frozen=True)
class Whitening:
    """A linear map of the differences ``(P, L, 2)`` of the P people of all windows.

    Unknown start states are projected out. The remainder is rotated to the walking direction and
    multiplied by the inverse square root of its covariance, which is pooled over all people.
    Directions that contain little but measurement noise are left out.

    Attributes:
        project: ``(P, L*2, L*2)``: projects start states out of x, y.
        turn: ``(P, 2, 2)``: from x, y to along and across the walking direction.
        filter: ``(M, 2, L)``: M filters of the differences along and across.
        weight: ``(P,)``: of the squares of each person's window, for bounded influence.
        covariance: ``(2, L, L)`` m², of the projected differences.
    """

    project: np.ndarray
    turn: np.ndarray
    filter: np.ndarray
    weight: np.ndarray
    covariance: np.ndarray

    @classmethod
    def fit(
        cls, difference: np.ndarray, start: np.ndarray, turn: np.ndarray, variance: float
    ) -> Whitening:
        """The map for the differences of a model.

        Args:
            difference: ``(P, L, 2)`` m.
            start: ``(P, L, 2, 4)`` responses of the positions to the start state.
            turn: ``(P, 2, 2)``.
            variance: m², of the measurement's noise.
        """
        p, length = difference.shape[:2]
        basis, _ = np.linalg.qr(start.reshape(p, 2 * length, 4))
        project = np.eye(2 * length) - basis @ basis.transpose(0, 2, 1)
        projected = np.einsum("pab,pb->pa", project, difference.reshape(p, -1)).reshape(
            p, length, 2
        )
        projected = np.einsum("pcd,pld->pcl", turn, projected)
        weight = np.ones(p)
        for _ in range(ROUNDS):
            total = np.einsum("p,pcl,pcm->clm", weight, projected, projected) / weight.sum()
            covariance = total + NUMERICAL**2 * np.eye(length)
            filters = _filters(covariance, variance)
            size = (np.einsum("mcl,pcl->pm", filters, projected) ** 2).mean(1)
            # relative to the median, which is robust to outliers
            median_size = max(float(np.median(size)), 1e-12)
            weight = 1 / (1 + size / median_size / OUTLYING**2)
        return cls(project, turn, filters, weight, covariance)

    def projected(self, difference: np.ndarray) -> np.ndarray:
        """``(..., P, L, 2)`` m: the differences, start states projected out."""
        flat = difference.reshape(*difference.shape[:-2], -1)
        out = np.einsum("pab,...pb->...pa", self.project, flat)
        return out.reshape(difference.shape)

    def matrix(self) -> np.ndarray:
        """``(P, M, L*2)``: the whole map, weights included."""
        p, m = len(self.weight), len(self.filter)
        turned = np.einsum("mcl,pcd->pmld", self.filter, self.turn).reshape(p, m, -1)
        out: np.ndarray = turned @ self.project
        return out * np.sqrt(self.weight)[:, None, None]


def _filters(covariance: np.ndarray, variance: float) -> np.ndarray:
    """``(M, 2, L)``: from the ``(2, L, L)`` covariances of the differences along and across."""
    filters = []
    for c, part in enumerate(covariance):
        value, vector = np.linalg.eigh(part)
        # start states were projected out, which removes two directions
        informative = np.flatnonzero(value > TELLING * (variance + NUMERICAL**2))
        start = int(np.clip(len(value) - len(informative), 2, max(2, len(value) - FEWEST)))
        rows = np.zeros((len(value) - start, *covariance.shape[::2]))
        rows[:, c] = (vector[:, start:] / np.sqrt(value[start:])).T
        filters.append(rows)
    return np.concatenate(filters)
