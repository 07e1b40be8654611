"""Leverage adjustment of the residuals of clusters.

Source: Bell & McCaffrey 2002 (CR2).
"""

from __future__ import annotations

import numpy as np

from nnode.diagnosis.residuals.fit import grams, members


def leverage_adjusted(residual: np.ndarray, basis: np.ndarray, label: np.ndarray) -> np.ndarray:
    """``(n,)`` residuals times (1 - H)^-1/2, where H is each cluster's block of the projection onto
    an orthonormal basis. Directions that one cluster alone determines are not adjusted."""
    adjusted = residual.copy()
    if not basis.shape[1]:
        return adjusted
    for part, gram in zip(members(label), grams(basis, label), strict=True):
        size, turn = np.linalg.eigh(gram)
        invertible = (size > 1e-12) & (size < 1 - 1e-6)
        size, turn = size[invertible], turn[:, invertible]
        correction = turn * ((1 / np.sqrt(1 - size) - 1) / size) @ turn.T
        adjusted[part] += basis[part] @ (correction @ (basis[part].T @ residual[part]))
    return adjusted


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the columns' span."""
    scale = np.linalg.norm(columns, axis=0)
    columns = columns[:, scale > 0] / scale[scale > 0]
    if not columns.shape[1]:
        return columns
    vectors, values, _ = np.linalg.svd(columns, full_matrices=False)
    kept: np.ndarray = vectors[:, values > 1e-8 * values[0]]
    return kept


def without_span(columns: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """``(n, k)`` columns, projected orthogonally to an orthonormal basis ``(n, F)``."""
    remaining: np.ndarray = columns - basis @ (basis.T @ columns)
    return remaining
