"""Simulations of a calibrated crowd in which everybody reacts, for estimates of bias.

People are simulated among the measured paths of the others. But the others have reacted to the
person's actual path, including disturbances, and the starts of windows are smoothed. Both bias
scores and parameters. The bias is estimated from crowds that the calibrated model simulates with
all interactions. Their disturbances are the accelerations that the model does not explain in the
measured paths, with a random sign for each person.

Source: Wu 1986 (signs of residuals).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch, Sequence, collate
from nnode.diagnosis.crowds.paths import Path, Smoother
from nnode.diagnosis.crowds.windows import Individuals, turn_destinations
from nnode.model.scene import Scene
from nnode.model.system import System
from nnode.simulation.alone import PersonAlone, Surroundings
from nnode.simulation.numpy import simulated

#: Simulation steps per sampling interval.
STEPS = 2

#: People among positions and velocities ``(H, B, N, 2)``, with a step, s.
Among = Callable[[Tensor, Tensor, float], PersonAlone]


def simulated_pair(
    system: System, sequences: Many[Sequence], individuals: Individuals, seed: int
) -> tuple[list[Sequence], list[Sequence]]:
    """Two simulations of sequences whose random numbers have opposite signs, so that linear terms
    cancel.

    Args:
        system: the calibrated model.
        sequences: as they were measured, with the people's desired speeds as ``preferred``.
        individuals: the people of all sequences, one sequence after the other.
        seed: of signs and errors.
    """
    smoother, rng = Smoother(sequences), np.random.default_rng(seed)
    paths = [smoother.path(s, s.dt * np.arange(s.n_samples)) for s in sequences]
    smoothed = [replace(s, x=p.x, v=p.v) for s, p in zip(sequences, paths, strict=True)]
    batch, error = collate(smoothed), np.sqrt(smoother.variance)
    scene, (window, person) = system.scene(batch), torch.nonzero(batch.agent, as_tuple=True)
    turn_destinations(scene, batch.x[0], window, person, torch.from_numpy(individuals.turn))
    people = partial(_people, system, scene, individuals.factors)
    disturbances = _disturbances(people, batch, paths)
    kicks = [kick * rng.choice([-1.0, 1.0], (1, kick.shape[1], 1)) for kick in disturbances]
    errors = [error * rng.standard_normal(path.x.shape) for path in paths]

    def crowd(sign: float) -> list[Sequence]:
        simulated_paths = _simulated(people, batch, [sign * kick for kick in kicks])
        return [
            replace(s, x=x + sign * e, v=None, preferred=None)
            for s, x, e in zip(sequences, simulated_paths, errors, strict=True)
        ]

    return crowd(1.0), crowd(-1.0)


def _disturbances(people: Among, batch: Batch, paths: list[Path]) -> list[np.ndarray]:
    """``(K, N, 2)`` accelerations of the measured people that the model does not explain, m/s²."""
    among_measured = people(batch.x, batch.v, 2 * batch.dt)
    states = torch.cat([batch.x, batch.v], -1)
    explained = among_measured(np.arange(len(states)), states).numpy()
    return [path.a - explained[: len(path.x), b, : path.x.shape[1]] for b, path in enumerate(paths)]


def _simulated(people: Among, batch: Batch, kicks: list[np.ndarray]) -> list[np.ndarray]:
    """``(K, N, 2)`` positions of each sequence's people with all interactions, m."""
    step = batch.dt / STEPS
    reacting = people(batch.x[:1], batch.v[:1], step)
    push = np.zeros(batch.x.shape)
    for b, kick in enumerate(kicks):
        push[: len(kick), b, : kick.shape[1]] = kick

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        k = min(int(t / batch.dt + 1e-6), batch.n_samples - 2)
        share, states = t / batch.dt - k, torch.from_numpy(y)
        reacting.around.replace_others(states)
        acceleration = reacting(np.array([round(2 * t / step)]), states[None])[0].numpy()
        kick = (1 - share) * push[k] + share * push[k + 1]
        return np.concatenate([y[..., 2:], acceleration + kick], -1)

    start = torch.cat([batch.x[0], batch.v[0]], -1).numpy()
    states = simulated(rate, start, batch.dt, batch.n_samples, step)
    return [states[: len(kick), b, : kick.shape[1], :2] for b, kick in enumerate(kicks)]


def _people(
    system: System,
    scene: Scene,
    factors: dict[str, np.ndarray],
    x: Tensor,
    v: Tensor,
    step: float,
) -> PersonAlone:
    """The people of a scene among positions and velocities ``(H, B, N, 2)``."""
    window, person = torch.nonzero(scene.agent, as_tuple=True)
    around = Surroundings(scene, x, v, window, person, step, factors)
    vector = ParameterVector(system)
    return PersonAlone(around, system, vector.runs(vector.row[None]))
