"""Simulations of a calibrated crowd in which everybody reacts, for estimates of bias.

People are simulated among the measured paths of the others. But the others have reacted to the
person's actual path, including disturbances, and the starts of windows are smoothed. Both bias
scores and parameters. The bias is estimated from crowds that the calibrated model simulates with
all interactions. Their disturbances are the accelerations that the model does not explain in the
measured paths, with a random sign for each person.

Source: Wu 1986 (signs of residuals).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence as Many
from dataclasses import replace

import numpy as np
import torch

from nnode.data.sequence import Batch, Sequence, collate
from nnode.diagnosis.crowds.paths import Path, Smoother
from nnode.model.system import Crowd, System
from nnode.simulation.numpy import simulated

#: Simulation steps per sampling interval.
STEPS = 2


def simulated_pair(
    system: System, sequences: Many[Sequence], seed: int
) -> tuple[list[Sequence], list[Sequence]]:
    """Two simulations of sequences whose random numbers have opposite signs, so that linear terms
    cancel.

    Args:
        system: the calibrated model.
        sequences: as they were measured, with the people's desired speeds as ``preferred``.
        seed: of signs and errors.
    """
    smoother, rng = Smoother(sequences), np.random.default_rng(seed)
    paths = [smoother.path(s, s.dt * np.arange(s.n_samples)) for s in sequences]
    smoothed = [replace(s, x=p.x, v=p.v) for s, p in zip(sequences, paths, strict=True)]
    batch, error = collate(smoothed), np.sqrt(smoother.variance)
    disturbances = _disturbances(system, batch, paths)
    kicks = [kick * rng.choice([-1.0, 1.0], (1, kick.shape[1], 1)) for kick in disturbances]
    errors = [error * rng.standard_normal(path.x.shape) for path in paths]

    def crowd(sign: float) -> list[Sequence]:
        simulated_paths = _simulated(system, batch, [sign * kick for kick in kicks])
        return [
            replace(s, x=x + sign * e, v=None, preferred=None)
            for s, x, e in zip(sequences, simulated_paths, errors, strict=True)
        ]

    return crowd(1.0), crowd(-1.0)


@torch.no_grad()
def _disturbances(system: System, batch: Batch, paths: list[Path]) -> list[np.ndarray]:
    """``(K, N, 2)`` accelerations of the measured people that the model does not explain, m/s²."""
    among_measured = _with(system, "measured")
    scene = among_measured.scene(batch)
    time = batch.dt * torch.arange(batch.n_samples, dtype=torch.float64)
    states = torch.cat([batch.x, batch.v], -1)
    explained = torch.stack(
        [among_measured(t, y, scene)[..., 2:4] for t, y in zip(time, states, strict=True)]
    )
    return [
        path.a - explained[: len(path.x), b, : path.x.shape[1]].numpy()
        for b, path in enumerate(paths)
    ]


@torch.no_grad()
def _simulated(system: System, batch: Batch, kicks: list[np.ndarray]) -> list[np.ndarray]:
    """``(K, N, 2)`` positions of each sequence's people with all interactions, m."""
    interacting = _with(system, "simulated")
    scene, y = interacting.scene(batch), interacting.initial(batch)
    push = torch.zeros(batch.n_samples, *y.shape, dtype=torch.float64)
    for b, kick in enumerate(kicks):
        push[: len(kick), b, : kick.shape[1], 2:4] = torch.from_numpy(kick)

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        k = min(int(t / batch.dt + 1e-6), batch.n_samples - 2)
        kick = torch.lerp(push[k], push[k + 1], t / batch.dt - k)
        time = torch.tensor(t, dtype=torch.float64)
        return (interacting(time, torch.from_numpy(y), scene) + kick).numpy()

    states = simulated(rate, y.numpy(), batch.dt, batch.n_samples, batch.dt / STEPS)
    return [states[: len(kick), b, : kick.shape[1], :2] for b, kick in enumerate(kicks)]


def _with(system: System, neighbours: str) -> Crowd:
    crowd = copy.deepcopy(system)
    assert isinstance(crowd, Crowd)
    crowd.neighbours = neighbours
    return crowd
