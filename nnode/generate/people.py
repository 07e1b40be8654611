"""The noise of people: an Ornstein-Uhlenbeck process of two components, and who differ in pace."""

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

#: The least preferred speed that is drawn, of the measured one.
SLOWEST = 0.1


def takes_paces(system: Crowd, batch: Batch) -> bool:
    """Whether a model asks for preferred speeds: with others, it says other rates."""
    scene = system.scene(batch)
    y = system.initial(batch)
    rates = [system(torch.zeros(()), y, one) for one in (scene, _paced(scene, torch.tensor(1.1)))]
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
        batch: every sequence so often as it is sampled.
        noise: sigma (m/s or m/s², of each component), tau (s), spread of the paces.
        rng: of all that is drawn.
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
        own = 1 + spread * rng.normal(size=(*batch.agent.shape, 1))
        # after the directions of the streams are known: these are the measured ones
        rates.scene = _paced(rates.scene, torch.from_numpy(np.maximum(own, SLOWEST)))
    y = system.initial(batch, step)
    width, driven = y.shape[-1], slice(2 * (system.order - 1), 2 * system.order)
    real = batch.agent[..., None].to(y.dtype)

    def normal() -> Tensor:
        return real * torch.randn(*y.shape[:2], 2, generator=generator, dtype=y.dtype)

    def change(k: Tensor, state: Tensor) -> Tensor:
        found, push = rates(k, state[..., :width]), state[..., width:]
        found[..., driven] += rates.until_the_end(k, step * push)
        return torch.cat([found, (kept - 1) * push + kick * normal()], -1)

    times = n * torch.arange(batch.n_samples, dtype=y.dtype)
    begin = torch.cat([y, sigma * normal()], -1)
    states = odeint(change, begin, times, method="euler", options={"grid_constructor": whole_steps})
    return check_finite(Trajectory(*system.observe(states[..., :width], batch)), batch)


def _paced(scene: Scene, factor: Tensor) -> Scene:
    """The scene with other preferred speeds."""
    return replace(scene, preferred=factor * scene.preferred)
