"""Windows of a person that continue each other.

Each window is simulated from the smoothed measured state at its start. By itself, its residuals
have the errors of this state, which are made of the measurements that are explained, and lack what
happened before. So the gap between the end of a simulation and the start of the next one is added
to the residuals of the next window, by linear response. They are then those of one simulation of
the whole record, linearised in every window along a path close to the measured one.

Source: Bock & Plitt 1984 (multiple shooting, condensing).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

#: Largest growth of a small change over windows that continue each other: rounding errors of paths
#: that are given to 16 digits remain small.
GROWN = 1e6


class Change(NamedTuple):
    """C changes of people's paths in windows.

    Attributes:
        position: ``(P, 2 L, C)`` m, both coordinates at each of the L residual times.
        end: ``(P, 4, C)`` of the positions (m) and velocities (m/s) where the next window starts.
    """

    position: np.ndarray
    end: np.ndarray


@dataclass(frozen=True)
class Continuation:
    """How changes continue in the next windows.

    Attributes:
        position: ``(D, W, K, 4)`` derivatives of the K coordinates by the state at the start of a
            window.
        end: ``(D, W, 4, 4)`` of the state at the start of the next one.
        continues: ``(D, W)`` whether a window continues the one before.
    """

    position: np.ndarray
    end: np.ndarray
    continues: np.ndarray

    def __call__(self, position: np.ndarray, end: np.ndarray) -> np.ndarray:
        """``(D, W K, C)`` changes of the coordinates, with those of earlier windows.

        Args:
            position: ``(D, W, K, C)``. end: ``(D, W, 4, C)``.
        """
        change, before = position.copy(), np.zeros_like(end[:, 0])
        for w in range(1, change.shape[1]):
            before = end[:, w - 1] + self.end[:, w - 1] @ before
            before = np.where(self.continues[:, w, None, None], before, 0.0)
            change[:, w] += self.position[:, w] @ before
        people, windows, coordinates, columns = change.shape
        return change.reshape(people, windows * coordinates, columns)


def not_grown(end: np.ndarray, continues: np.ndarray) -> np.ndarray:
    """``(D, W)`` where windows continue those before, without those in which small changes have
    grown too much, see :data:`GROWN`.

    Args:
        end, continues: see :class:`Continuation`.
    """
    kept, growth = continues.copy(), np.broadcast_to(np.eye(4), end[:, 0].shape)
    for w in range(1, end.shape[1]):
        growth = end[:, w - 1] @ growth
        kept[:, w] &= np.abs(growth).max((1, 2)) < GROWN
        growth = np.where(kept[:, w, None, None], growth, np.eye(4))
    return kept
