"""What a model costs on recorded crowds, in windows of 1.5 s from the true states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from benchmarks.synthetic_cases.crowd.motion import Base, Hidden, simulate
from benchmarks.synthetic_cases.crowd.scene import Scene

#: Length of a window, s.
WINDOW = 1.5
#: A fit ends where a step lowers its cost by less than this share.
_ENOUGH = 1e-4
NOTHING = Hidden()


@dataclass(frozen=True)
class Windows:
    """Recorded crowds cut into windows.

    Attributes:
        scene: where people walk.
        x, v: ``(S, K + 1, N, 2)`` true positions (m) and velocities (m/s).
        measured: ``(S, K + 1, N, 2)`` m.
        dt: sampling interval, s.
    """

    scene: Scene
    x: np.ndarray
    v: np.ndarray
    measured: np.ndarray
    dt: float

    def errors(
        self, base: Base, hidden: Hidden = NOTHING, *, eta: float = 0.0, substeps: int = 1
    ) -> np.ndarray:
        """``(S, W, k, N, 2)`` simulated minus measured positions, m; the start does not count.

        Args:
            eta: standard deviation of how vigorously people steer.
            substeps: steps of Runge–Kutta's method between two samples.
        """
        scene, length = self.scene, round(WINDOW / self.dt)
        sequences, samples, people = self.x.shape[:3]
        length = min(length, samples - 1)
        starts = np.arange(0, samples - length, length)
        number = len(starts)

        def spread(value: np.ndarray) -> np.ndarray:
            return np.repeat(value, number, axis=0)

        since = np.tile(starts * self.dt, sequences)
        found, _ = simulate(
            base,
            hidden,
            self.x[:, starts].reshape(-1, people, 2),
            self.v[:, starts].reshape(-1, people, 2),
            spread(scene.goal),
            spread(scene.group),
            spread(eta * scene.eta),
            spread(scene.phase),
            scene.points,
            scene.segments,
            np.zeros((sequences * number, 1, people, 2)),
            spread(scene.clocks) + since,
            since,
            self.dt / substeps,
            length * substeps,
            substeps,
        )
        found = found.reshape(sequences, number, length + 1, people, 2)[:, :, 1:]
        wanted = np.stack([self.measured[:, s + 1 : s + 1 + length] for s in starts], axis=1)
        return np.asarray(found - wanted)

    def recalibrated(self, start: Base) -> Base:
        """A, k and kappa of the base law that fit best, from a first guess."""
        guess = np.array([start.A, start.k, start.kappa])

        def model(p: np.ndarray) -> Base:
            return start._replace(A=float(p[0]), k=float(p[1]), kappa=float(p[2]))

        found = least_squares(
            lambda p: self.errors(model(p)).ravel(),
            guess,
            bounds=(0.0, np.inf),
            x_scale=guess,
            diff_step=1e-5,
            ftol=_ENOUGH,
        )
        return model(found.x)


def cost_by_sequence(error: np.ndarray) -> np.ndarray:
    """``(S,)`` mean over windows, samples and people of the squared distance, m²."""
    return np.asarray((error**2).sum(-1).mean(axis=(1, 2, 3)))
