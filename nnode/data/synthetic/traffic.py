"""Platoons of cars that follow a first-order law, written like the ESIMAS sequences."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import scipy.io
from scipy.integrate import solve_ivp

#: Length of the free text that a MATLAB 5 file begins with, in bytes.
_HEADER = 116
#: Number of platoons; fewest and most cars of one; its shortest and longest duration, s.
_PLATOONS, _CARS, _DURATION = 40, (3, 6), (3.0, 8.0)
#: Smallest and largest initial gap, m; sampling interval, s.
_GAP, _DT = (10.0, 40.0), 0.2
#: s between two platoons: no car is seen in two of them.
_PAUSE = 10.0


def traffic_recording(
    path: Path | str,
    *,
    seed: int,
    v0: float = 25.0,
    L: float = 6.0,
    noise: float = 0.0,
) -> Path:
    """Simulate independent platoons and write them as a ``.mat`` file.

    The last car of a platoon drives at v0, the others at v0 (1 - L/gap), gap being the distance to
    the position of the car in front.

    Args:
        path: the file, by convention ``sequence_data{recording}.mat``; folders are created.
        seed: the same seed gives the same bytes.
        v0: m/s.
        L: m.
        noise: standard deviation of the measured positions, m.

    Returns:
        The path: a cell array ``sequences`` of structs ``Xarr`` (cars × samples, m, the leader
        last) and ``Tarr`` (1 × samples, s).

    Source: Göttlich & Totzeck, equation (LWR).
    """

    def rates(_: float, x: np.ndarray) -> np.ndarray:
        return np.append(v0 * (1 - L / np.diff(x)), v0)

    rng = np.random.default_rng(seed)
    cell = np.empty((_PLATOONS, 1), dtype=object)
    start = 0.0
    for i in range(_PLATOONS):
        n = int(rng.integers(_CARS[0], _CARS[1] + 1))
        steps = round(rng.uniform(*_DURATION) / _DT)
        time = _DT * np.arange(steps + 1)
        gaps = rng.uniform(*_GAP, size=n - 1)
        x0 = rng.uniform(5.0, 15.0) + np.concatenate([[0.0], np.cumsum(gaps)])
        path_of = solve_ivp(
            rates, (0.0, time[-1]), x0, method="DOP853", t_eval=time, rtol=1e-11, atol=1e-11
        )
        x = path_of.y + noise * rng.standard_normal(path_of.y.shape)
        cell[i, 0] = {"Xarr": x, "Tarr": (start + time)[None]}
        # a whole number of steps keeps all platoons on one reference grid
        start += _DT * round((time[-1] + _PAUSE) / _DT)
    return _write(Path(path), cell)


def _write(path: Path, cell: np.ndarray) -> Path:
    buffer = BytesIO()
    scipy.io.savemat(buffer, {"sequences": cell})
    # savemat writes the present time into the header
    text = b"MATLAB 5.0 MAT-file, synthetic platoons of cars".ljust(_HEADER)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text + buffer.getvalue()[_HEADER:])
    return path
