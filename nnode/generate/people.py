"""The noise of people: an Ornstein-Uhlenbeck process of two components, and preferred speeds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torchdiffeq import odeint

from nnode.data.sequence import Batch
from nnode.model.scene import Scene
from nnode.model.system import Crowd
from nnode.simulation.base import Trajectory, check_finite, substeps
from nnode.simulation.ode import Rates, whole_steps

#: Smallest random factor on a measured preferred speed.
SLOWEST = 0.1


def depends_on_preferred_speed(system: Crowd, batch: Batch) -> bool:
    """Whether the rates of a model depend on preferred speeds."""
    scene = system.scene(batch)
    y = system.initial(batch)
    rates = [
        system(torch.zeros(()), y, each_scene)
        for each_scene in (scene, _with_speed_factor(scene, torch.tensor(1.1)))
    ]
    return not torch.equal(*rates)


def sample_people(
    system: Crowd,
    batch: Batch,
    noise: tuple[float, float, float],
    rng: np.random.Generator,
    dt: float | None,
) -> Trajectory:
    """Sampled motion of people in Euler's steps, see :func:`nnode.generate.noise.sample`.

    Args:
        batch: the sequences, repeated for every sample.
        noise: sigma (m/s or m/s², of each component), tau (s), spread of preferred speeds.
        rng: source of all random numbers.
        dt: step, s.
    """
    sigma, tau, spread = noise
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    n = substeps(batch.dt, dt, system)
    step = batch.dt / n
    kept = math.exp(-step / tau)
    kick = sigma * math.sqrt(1 - kept**2)
    rates = Rates(system, batch, n, system.step)
    if spread:
        factors = 1 + spread * rng.normal(size=(*batch.agent.shape, 1))
        # the directions of streams are already computed from the measured preferred speeds
        rates.scene = _with_speed_factor(
            rates.scene, torch.from_numpy(np.maximum(factors, SLOWEST))
        )
    y = system.initial(batch, step)
    width, driven = y.shape[-1], slice(2 * (system.order - 1), 2 * system.order)
    real = batch.agent[..., None].to(y.dtype)

    def normal() -> Tensor:
        return real * torch.randn(*y.shape[:2], 2, generator=generator, dtype=y.dtype)

    def change(k: Tensor, state: Tensor) -> Tensor:
        rate, push = rates(k, state[..., :width]), state[..., width:]
        rate[..., driven] += rates.until_the_end(k, step * push)
        return torch.cat([rate, (kept - 1) * push + kick * normal()], -1)

    times = n * torch.arange(batch.n_samples, dtype=y.dtype)
    begin = torch.cat([y, sigma * normal()], -1)
    states = odeint(change, begin, times, method="euler", options={"grid_constructor": whole_steps})
    return check_finite(Trajectory(*system.observe(states[..., :width], batch)), batch)


def _with_speed_factor(scene: Scene, factor: Tensor) -> Scene:
    """The scene with preferred speeds multiplied by a factor."""
    return replace(scene, preferred=factor * scene.preferred)
