"""What a model costs on recorded platoons: of the recalibrated base law, and of the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from benchmarks.synthetic_cases.traffic.motion import LAWS, Hidden, simulate

#: Steps between two samples for a smooth right-hand side.
_COARSE = 4
#: The shortest length that a recalibrated law may have, m.
_LEAST_LENGTH = 2.0
NOTHING = Hidden()


@dataclass(frozen=True)
class Recording:
    """Recorded platoons, and what moves behind their recorded leaders.

    Attributes:
        x: ``(S, K + 1, N)`` positions, m.
        clock: ``(S,)`` time of the day of the first sample, s.
        dt: sampling interval, s.
        law: ``lin`` or ``log``.
    """

    x: np.ndarray
    clock: np.ndarray
    dt: float
    law: str

    def errors(
        self,
        v0: float,
        L: float,
        hidden: Hidden = NOTHING,
        own: np.ndarray | None = None,
        past: tuple[np.ndarray, np.ndarray] | None = None,
        substeps: int = _COARSE,
    ) -> np.ndarray:
        """``(S, K + 1, N - 1)`` simulated minus recorded positions of the followers, m.

        Every platoon starts where it was recorded, behind its recorded leader.

        Args:
            v0, L: of the base law, m/s and m.
            hidden: acts beside the law.
            own: ``(S, N)`` factors of the vehicles.
            past: ``(S, P + 1, N)`` positions and velocities until the first sample.
            substeps: steps between two samples.
        """
        x, step = self.x, self.dt / substeps
        sequences, samples, vehicles = x.shape
        half = np.arange(2 * substeps * (samples - 1) + 1) / (2 * substeps)
        k = np.minimum(half.astype(int), samples - 2)
        away = np.diff(x[:, :, -1], axis=1)[:, k]
        lead_x = x[:, k, -1] + away * (half - k)
        lead_v = away / self.dt
        if past is None:
            past = x[:, :1], np.zeros((sequences, 1, vehicles))
        found, _ = simulate(
            LAWS[self.law],
            v0,
            L,
            hidden,
            np.ones((sequences, vehicles)) if own is None else own,
            np.ascontiguousarray(lead_x),
            np.ascontiguousarray(lead_v),
            np.ascontiguousarray(past[0]),
            np.ascontiguousarray(past[1]),
            np.zeros((sequences, 1, vehicles)),
            self.clock,
            0.0,
            step,
            substeps,
        )
        error: np.ndarray = (found - x)[:, :, :-1]
        return error

    def recalibrated(self, v0: float, L: float) -> tuple[float, float]:
        """v0 and L of the base law that fit best, from a first guess."""

        def residuals(p: np.ndarray) -> np.ndarray:
            return self.errors(float(p[0]), float(p[1])).ravel()

        found = least_squares(
            residuals,
            [v0, L],
            bounds=([1.0, _LEAST_LENGTH], np.inf),
            x_scale=[v0, L],
            diff_step=1e-5,
            ftol=1e-7,
        ).x
        return float(found[0]), float(found[1])


def cost_by_sequence(error: np.ndarray) -> np.ndarray:
    """``(S,)`` mean over samples and followers of the squared error, m²."""
    return np.asarray(np.mean(error**2, axis=(1, 2)))
