"""Platoons of cars that follow a first-order law, written like the ESIMAS sequences."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import scipy.io
from scipy.integrate import solve_ivp

from nnode.errors import ConfigError

#: Length of the free text that a MATLAB 5 file begins with, in bytes.
_HEADER = 116


def traffic_recording(
    path: Path | str,
    *,
    seed: int,
    law: str = "linear",
    v0: float = 25.0,
    L: float = 6.0,
    sequences: int = 40,
    cars: tuple[int, int] = (3, 6),
    duration: tuple[float, float] = (3.0, 8.0),
    gap: tuple[float, float] = (10.0, 40.0),
    pause: float = 10.0,
    dt: float = 0.2,
    noise: float = 0.0,
) -> Path:
    """Simulate independent platoons and write them as a ``.mat`` file.

    The last car of a platoon drives at v0, the others at v0 (1 - L/gap) (``linear``) or
    v0 log(gap/L) (``log``), gap being the distance to the position of the car in front.

    Args:
        path: the file, by convention ``sequence_data{recording}.mat``; folders are created.
        seed: the same seed gives the same bytes.
        law: ``linear`` or ``log``.
        v0: m/s.
        L: m.
        sequences: number of platoons.
        cars: fewest and most cars of a platoon.
        duration: shortest and longest platoon, s.
        gap: smallest and largest initial gap, m.
        pause: time between two platoons, s; no car is seen in two of them.
        dt: sampling interval, s.
        noise: standard deviation of the measured positions, m.

    Returns:
        The path: a cell array ``sequences`` of structs ``Xarr`` (cars × samples, m, the leader
        last) and ``Tarr`` (1 × samples, s).

    Raises:
        ConfigError: a law that does not exist, or initial gaps at which cars would reverse.

    Source: Göttlich & Totzeck, equation (LWR).
    """
    laws = {
        "linear": lambda distance: v0 * (1 - L / distance),
        "log": lambda distance: v0 * np.log(distance / L),
    }
    if law not in laws:
        raise ConfigError(f"law={law!r}: expected one of {', '.join(laws)}")
    if not 0 < L <= gap[0] <= gap[1]:
        raise ConfigError(f"gap={gap}: expected gaps (m) that rise, from L={L:g} m or more")
    velocity = laws[law]

    def rates(_: float, x: np.ndarray) -> np.ndarray:
        return np.append(velocity(np.diff(x)), v0)

    rng = np.random.default_rng(seed)
    cell = np.empty((sequences, 1), dtype=object)
    start = 0.0
    for i in range(sequences):
        n = int(rng.integers(cars[0], cars[1] + 1))
        steps = round(rng.uniform(*duration) / dt)
        time = dt * np.arange(steps + 1)
        gaps = rng.uniform(*gap, size=n - 1)
        x0 = rng.uniform(5.0, 15.0) + np.concatenate([[0.0], np.cumsum(gaps)])
        path_of = solve_ivp(
            rates, (0.0, time[-1]), x0, method="DOP853", t_eval=time, rtol=1e-11, atol=1e-11
        )
        x = path_of.y + noise * rng.standard_normal(path_of.y.shape)
        cell[i, 0] = {"Xarr": x, "Tarr": (start + time)[None]}
        # a whole number of steps keeps all platoons on one reference grid
        start += dt * round((time[-1] + pause) / dt)
    return _write(Path(path), cell)


def _write(path: Path, cell: np.ndarray) -> Path:
    buffer = BytesIO()
    scipy.io.savemat(buffer, {"sequences": cell})
    # savemat writes the present time into the header
    text = b"MATLAB 5.0 MAT-file, synthetic platoons of cars".ljust(_HEADER)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text + buffer.getvalue()[_HEADER:])
    return path
