"""Deviations of the measurement from simulations, for residual maps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from nnode.data.sequence import Sequence, collate
from nnode.errors import SimulationError
from nnode.model import System
from nnode.simulation import TorchdiffeqSolver

#: Method and longest step, s; their error is invisible in figures.
METHOD = {"traffic": "rk4", "crowd": "midpoint"}
STEP = {"traffic": 0.1, "crowd": 0.05}

#: Length of the simulated pieces, s. Shorter ones show the noise of the positions; in longer ones
#: deviations appear far from their origin.
SPAN = {"traffic": 2.0, "crowd": 1.0}

#: Number of pieces that start within the length of one, and the largest number of pieces that are
#: simulated. In crowds, pieces contain many people and are expensive.
WITHIN = {"traffic": 2, "crowd": 1}
MOST = {"traffic": 5000, "crowd": 300}

#: Half width of the window for a person's velocity, s.
SMOOTH = 0.3

#: Number of sequences that are simulated at once.
TOGETHER = 64


@dataclass(frozen=True)
class Deviation:
    """Measured minus simulated motion at n places and times.

    Attributes:
        time: ``(n,)`` s, on the recording's clock.
        position: ``(n, D)`` m, measured.
        value: ``(n, D)`` speed in m/s (traffic) or acceleration in m/s² (crowd).
        walking_frame: ``(n, D)`` ``value``, in a crowd along and left of the walking direction.
        neighbour: ``(n, 2)``. Traffic: gap in m, and the speed of the vehicle ahead minus one's own
            in m/s. Crowd: the nearest person's place in m, ahead of and left of one's own way.
            NaN where there is nobody.
    """

    time: np.ndarray
    position: np.ndarray
    value: np.ndarray
    walking_frame: np.ndarray
    neighbour: np.ndarray


@torch.no_grad()
def simulate(
    system: System, sequences: list[Sequence], step: float | None = None
) -> list[np.ndarray | None]:
    """Positions ``(K, N, D)`` in m of each sequence, from its first measured state on.

    Args:
        step: longest step, s; by default :data:`STEP`.

    Returns:
        None for a sequence whose simulation blows up.
    """
    paths: list[np.ndarray | None] = []
    for first in range(0, len(sequences), TOGETHER):
        part = sequences[first : first + TOGETHER]
        try:
            paths += _together(system, part, step)
        except SimulationError:
            single = len(part) == 1
            paths += [None] if single else [x for s in part for x in simulate(system, [s], step)]
    return paths


def _together(system: System, sequences: list[Sequence], step: float | None) -> list[np.ndarray]:
    like = next(system.parameters(), torch.zeros((), dtype=torch.float64))
    batch = collate(sequences).to(like.device, like.dtype)
    longest = STEP[system.domain] if step is None else step
    dt = batch.dt / max(1, math.ceil(batch.dt / longest - 1e-6))
    # a map from step to step cannot be evaluated within a step
    method = system.step if system.is_map else METHOD[system.domain]
    x = TorchdiffeqSolver(method, dt=dt)(system, batch).x.double().cpu().numpy()
    return [x[: s.n_samples, i, : s.n_agents] for i, s in enumerate(sequences)]


def deviation(system: System, sequences: list[Sequence], step: float | None = None) -> Deviation:
    """The deviations of the sequences from simulations of ``system``.

    Sequences are cut into pieces of :data:`SPAN`, each simulated from its first state. The error at
    the end of a piece is expressed as a constant speed (traffic) or acceleration (crowd). A leader
    with a given path is left out.
    """
    pieces = [piece for s in sequences for piece in _pieces(s, system)]
    pieces = pieces[:: max(1, -(-len(pieces) // MOST[system.domain]))]
    measure = _traffic if system.domain == "traffic" else _crowd
    led = system.leader_measured
    parts = [
        measure(s, x, s.n_agents - led)
        for s, x in zip(pieces, simulate(system, pieces, step), strict=True)
        if x is not None
    ]
    if not parts:
        none = np.empty((0, system.dim))
        return Deviation(np.empty(0), none, none, none, np.empty((0, 2)))
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return Deviation(*map(np.concatenate, columns))


def _traffic(s: Sequence, x: np.ndarray, number: int) -> Deviation:
    """The deviations of the last ``number`` vehicles of a piece that was simulated as ``x``."""
    seconds = s.time[-1] - s.time[0]
    value = (s.x[-1] - x[-1]) / seconds
    place = (s.x[0] + s.x[-1])[:, 0] / 2
    speed = (s.x[-1] - s.x[0])[:, 0] / seconds
    neighbour = np.stack([np.diff(place, append=np.nan), np.diff(speed, append=np.nan)], 1)
    time = np.full(s.n_agents, (s.time[0] + s.time[-1]) / 2)
    columns = (time, place[:, None], value, value, neighbour)
    return Deviation(*(column[:number] for column in columns))


def _crowd(s: Sequence, x: np.ndarray, number: int) -> Deviation:
    assert s.v is not None
    seconds = s.time[-1] - s.time[0]
    value = 2 * (s.x[-1] - x[-1]) / seconds**2
    time = np.full(number, s.time.mean())
    neighbour = nearest(s.x[0], s.v[0])
    return Deviation(time, s.x.mean(0), value, in_walking_frame(value, s.v[0]), neighbour)


def _pieces(s: Sequence, system: System) -> list[Sequence]:
    """Pieces of a sequence with smoothed velocities, and with the destinations of the whole.

    They keep its name, by which effects know its agents.
    """
    # an acceleration needs at least two steps
    n = min(max(system.order, round(SPAN[system.domain] / s.dt)), s.n_samples - 1)
    goal = s.x[-1] if s.destination is None else s.destination
    v = smooth_velocity(s)
    return [
        replace(
            s,
            time=s.time[first : first + n + 1],
            x=s.x[first : first + n + 1],
            v=v[first : first + n + 1],
            destination=goal,
        )
        for first in range(0, s.n_samples - n, max(1, n // WITHIN[system.domain]))
    ]


def smooth_velocity(sequence: Sequence) -> np.ndarray:
    """``(K, N, D)`` m/s: slopes of parabolas through the samples within :data:`SMOOTH`."""
    s = sequence
    half = max(1, round(SMOOTH / s.dt))
    v = np.empty_like(s.x)
    for k in range(s.n_samples):
        low, high = max(0, k - half), min(s.n_samples, k + half + 1)
        degree = min(2, high - low - 1)
        t = s.time[low:high] - s.time[k]
        fit = np.polynomial.polynomial.polyfit(t, s.x[low:high].reshape(len(t), -1), degree)
        v[k] = fit[1].reshape(s.x.shape[1:])
    return v


def in_walking_frame(vectors: np.ndarray, v: np.ndarray) -> np.ndarray:
    """``(N, 2)`` parts of vectors ahead and left of the way of velocities ``v``, both ``(N, 2)``.

    NaN where somebody stands still and has no way.
    """
    speed = np.linalg.norm(v, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        way = np.where(speed > 0, v / speed, np.nan)
    left = np.stack([-way[:, 1], way[:, 0]], 1)
    return np.stack([(vectors * way).sum(1), (vectors * left).sum(1)], 1)


def nearest(x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """``(N, 2)`` m: the nearest person's place ahead of and left of everyone's own way.

    NaN where there is nobody else, or where somebody stands still.

    Args:
        x, v: ``(N, 2)`` positions in m and velocities in m/s.
    """
    if len(x) < 2:
        return np.full((len(x), 2), np.nan)
    away = x[None] - x[:, None]
    distance = np.linalg.norm(away, axis=-1)
    np.fill_diagonal(distance, np.inf)
    return in_walking_frame(away[np.arange(len(x)), distance.argmin(1)], v)
