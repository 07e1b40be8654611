"""From differences of positions to residuals that are about independent, of variance about 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Numerical errors of a simulated position, m: a lower limit of all noise.
NUMERICAL = 3e-4
#: A person's window counts half where its residuals are this many times as large as usual.
OUTLYING = 3.0
#: Rounds in which weights and covariances are found.
ROUNDS = 4


@dataclass(frozen=True)
class Whitening:
    """A linear map of the differences ``(P, L, 2)`` of the P people of all windows.

    Unknown start states are projected out, the rest is turned to the walking direction and
    filtered by the inverse root of its covariance, which is one for all people.

    Attributes:
        project: ``(P, L*2, L*2)``: takes the part that a start state explains out of x, y.
        turn: ``(P, 2, 2)``: from x, y to along and across the walking direction.
        filter: ``(2, L-2, L)``: of the differences along and across.
        weight: ``(P,)``: of the squares of each person's window, bounded influence.
        covariance: ``(2, L, L)`` m², of the projected differences.
    """

    project: np.ndarray
    turn: np.ndarray
    filter: np.ndarray
    weight: np.ndarray
    covariance: np.ndarray

    @classmethod
    def fit(cls, difference: np.ndarray, start: np.ndarray, turn: np.ndarray) -> Whitening:
        """The map for the differences of a model.

        Args:
            difference: ``(P, L, 2)`` m.
            start: ``(P, L, 2, 4)`` responses of the positions to the start state.
            turn: ``(P, 2, 2)``.
        """
        p, length = difference.shape[:2]
        basis, _ = np.linalg.qr(start.reshape(p, 2 * length, 4))
        project = np.eye(2 * length) - basis @ basis.transpose(0, 2, 1)
        left = np.einsum("pab,pb->pa", project, difference.reshape(p, -1)).reshape(p, length, 2)
        left = np.einsum("pcd,pld->pcl", turn, left)
        weight = np.ones(p)
        for _ in range(ROUNDS):
            total = np.einsum("p,pcl,pcm->clm", weight, left, left) / weight.sum()
            covariance = total + NUMERICAL**2 * np.eye(length)
            roots = np.stack([_inverse_root(part) for part in covariance])
            size = (np.einsum("ckl,pcl->pck", roots, left) ** 2).mean((1, 2))
            # outliers are measured against the usual person, not against each other
            usual = max(float(np.median(size)), 1e-12)
            weight = 1 / (1 + size / usual / OUTLYING**2)
        return cls(project, turn, roots, weight, covariance)

    def projected(self, difference: np.ndarray) -> np.ndarray:
        """``(..., P, L, 2)`` m: the differences without what start states explain."""
        flat = difference.reshape(*difference.shape[:-2], -1)
        out = np.einsum("pab,...pb->...pa", self.project, flat)
        return out.reshape(difference.shape)

    def matrix(self) -> np.ndarray:
        """``(P, 2*(L-2), L*2)``: the whole map, weights included."""
        c, k, _ = self.filter.shape
        p = len(self.weight)
        turned = np.einsum("ckl,pcd->pckld", self.filter, self.turn).reshape(p, c * k, -1)
        out: np.ndarray = turned @ self.project
        return out * np.sqrt(self.weight)[:, None, None]


def _inverse_root(covariance: np.ndarray) -> np.ndarray:
    """``(L-2, L)``: inverse root without the two directions that start states took away."""
    value, vector = np.linalg.eigh(covariance)
    return np.asarray((vector[:, 2:] / np.sqrt(value[2:])).T)
