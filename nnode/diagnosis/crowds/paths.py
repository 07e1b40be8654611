"""Smoothed paths of people, and the variance of the measurement noise."""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from nnode.data.sequence import Sequence
from nnode.errors import DataError

#: Strengths of the roughness penalty for cross-validation.
PENALTIES = np.logspace(-4, 5, 55)
#: Longer sequences are smoothed in pieces of about this many samples, with an overlap.
PIECE, OVERLAP = 240, 24
#: Smallest number of samples for a third difference.
LEAST = 4


@dataclass(frozen=True)
class Path:
    """The smoothed paths of a sequence.

    Attributes:
        t: ``(T,)`` s since the first sample.
        x: ``(T, N, 2)`` m.
        v: ``(T, N, 2)`` m/s.
        a: ``(T, N, 2)`` m/s².
    """

    t: np.ndarray
    x: np.ndarray
    v: np.ndarray
    a: np.ndarray


class Smoother:
    """Smooths measured paths with a penalty of the jerk.

    The smoothed positions minimise the squared distance to the measured ones plus a penalty times
    the squared third differences. The penalty is one for all people and coordinates, by
    generalised cross-validation (Craven & Wahba 1979).

    Args:
        sequences: with ``(K, N, 2)`` positions, K >= 4.

    Attributes:
        penalty: the selected strength.
        variance: m², of the noise in one coordinate.

    Raises:
        DataError: a sequence is too short or has positions that are no numbers.
    """

    def __init__(self, sequences: Many[Sequence]) -> None:
        pieces: dict[int, list[np.ndarray]] = {}
        for item in sequences:
            if item.n_samples < LEAST:
                raise DataError(
                    f"sequence {item.name} has {item.n_samples} samples, smoothing needs at least "
                    f"{LEAST}; leave it out"
                )
            if not np.isfinite(item.x).all():
                raise DataError(
                    f"sequence {item.name} holds positions that are no numbers; check it with "
                    "data.faults first"
                )
            for part in _pieces(item.n_samples):
                flat = item.x[part].reshape(part.stop - part.start, -1)
                pieces.setdefault(len(flat), []).append(flat)
        stacks = {k: np.concatenate(parts, 1) for k, parts in pieces.items()}
        degrees = np.zeros(len(PENALTIES))
        residual_square = np.zeros(len(PENALTIES))
        for k, y in stacks.items():
            value, vector = _modes(k)
            power = ((vector.T @ y) ** 2).sum(1)
            keep = 1 / (1 + PENALTIES[:, None] * value)
            residual_square += ((1 - keep) ** 2 * power).sum(1)
            degrees += (1 - keep).sum(1) * y.shape[1]
        best = int(np.argmin(residual_square / degrees**2))
        self.penalty = float(PENALTIES[best])
        self.variance = float(residual_square[best] / degrees[best])

    def path(self, item: Sequence, t: np.ndarray) -> Path:
        """The smoothed paths of one of the sequences at times ``t`` (s since the first)."""
        k, flat = item.n_samples, item.x.reshape(item.n_samples, -1)
        smooth, weight = np.zeros_like(flat), np.zeros((k, 1))
        for part in _pieces(k):
            value, vector = _modes(part.stop - part.start)
            keep = 1 / (1 + self.penalty * value)
            # estimates at the ends of a piece are less precise, so they have smaller weights
            taper = np.minimum(np.arange(1, len(value) + 1), np.arange(len(value), 0, -1))[:, None]
            smooth[part] += taper * (vector @ (keep[:, None] * (vector.T @ flat[part])))
            weight[part] += taper
        line = make_interp_spline(item.dt * np.arange(k), smooth / weight, k=min(5, k - 1))
        shape = (len(t), item.n_agents, 2)
        x, v, a = (line(t, nu=order).reshape(shape) for order in range(3))
        return Path(np.asarray(t), x, v, a)


def _pieces(k: int) -> list[slice]:
    """Overlapping pieces of ``k`` samples, of nearly equal lengths."""
    number = max(1, round(k / PIECE))
    edges = np.linspace(0, k, number + 1).round().astype(int)
    return [
        slice(max(0, low - OVERLAP), min(k, high + OVERLAP))
        for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    ]


_MODES: dict[int, tuple[np.ndarray, np.ndarray]] = {}


def _modes(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues ``(k,)`` and eigenvectors ``(k, k)`` of the roughness penalty."""
    if k not in _MODES:
        third = np.diff(np.eye(k), 3, axis=0)
        value, vector = np.linalg.eigh(third.T @ third)
        _MODES[k] = value.clip(min=0), vector
    return _MODES[k]
