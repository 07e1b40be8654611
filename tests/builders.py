"""What tests make up: vehicles in lanes, people who walk straight on, linear platoons, and fits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.sequence import Sequence
from nnode.data.sequences import Sequences
from nnode.diagnosis.residuals.fit import Fit
from nnode.model import Law, System, make_law


def lane(
    x: Any, dt: float = 0.2, *, v: Any = None, start: float = 0.0, name: str = "r/0", **more: Any
) -> Sequence:
    """Vehicles in a lane.

    Args:
        x, v: ``(K, N)`` places (m) and speeds (m/s), the foremost vehicle last.
        dt, start: sampling interval and first time, s.
        name: the recording's stands before the stroke.
        more: further fields; a number as ``length`` is that of all vehicles, m.
    """
    x = np.asarray(x, float)[..., None]
    if isinstance(more.get("length"), float):
        more["length"] = np.full(x.shape[1], more["length"])
    if v is not None:
        more["v"] = np.broadcast_to(np.asarray(v, float), x.shape[:2])[..., None].copy()
    return people(x, dt, start=start, name=name, **more)


def people(
    x: np.ndarray, dt: float, *, start: float = 0.0, name: str = "r/0", **more: Any
) -> Sequence:
    """People on paths ``(K, N, 2)``, m."""
    time = start + dt * np.arange(len(x))
    more.setdefault("recording", name.split("/")[0])
    return Sequence(name=name, time=time, x=x, **more)


def straight(x: Any, v: Any, samples: int, dt: float, **more: Any) -> Sequence:
    """People from ``(N, 2)`` places (m) who keep their velocities ``(N, 2)``, m/s."""
    time = dt * np.arange(samples)[:, None, None]
    path = np.asarray(x, float) + time * np.asarray(v, float)
    return people(path, dt, v=np.broadcast_to(v, path.shape).copy(), **more)


def as_table(sequences: Iterable[Sequence]) -> pd.DataFrame:
    """The tidy table of sequences, of which each has agents of its own."""
    return Sequences(
        replace(s, agents=tuple(f"{s.name}/{i}" for i in range(s.n_agents))) for s in sequences
    ).to_dataframe()


def linear(
    starts: Iterable[np.ndarray], v0: float, length: float, samples: int, step: float
) -> list[Sequence]:
    """Platoons that drive by the linear law v0 (1 - L/gap), by Euler's method in plain NumPy.

    Sampled every 0.2 s; each begins 100 s after the one before.

    Args:
        starts: places at first, m.
        v0, length: of the law, m/s and m.
        step: s.
    """
    found = []
    every = round(0.2 / step)
    for i, x in enumerate(starts):
        path = [x]
        for _ in range(every * (samples - 1)):
            path.append(path[-1] + step * np.append(v0 * (1 - length / np.diff(path[-1])), v0))
        found.append(lane(path[::every], start=100.0 * i, name=f"r/{i:03d}"))
    return found


def regression(columns: np.ndarray, residual: np.ndarray) -> Fit:
    """The least squares of a linear model.

    Args:
        columns: ``(n, P)`` derivatives of the residuals.
        residual: ``(n,)`` with all parameters zero.
    """
    row = -np.linalg.lstsq(columns, residual, rcond=None)[0]
    names, free = [f"p{i}" for i in range(len(row))], np.ones(len(row), dtype=bool)
    return Fit(System([]), names, row, residual + columns @ row, columns, free)


def social_forces(**options: Any) -> list[Law]:
    """Terms of a crowd: relaxation, and a social force with some strengths or with others."""
    strengths = {"A": 2.0, "k": 30.0, "kappa": 9.0, **options}
    return [make_law("relaxation"), make_law("social_force", **strengths)]
