"""The noise of drivers and people: an Ornstein-Uhlenbeck process on speeds or accelerations."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torchdiffeq import odeint

from nnode.data.sequence import Batch
from nnode.errors import ConfigError
from nnode.exchange.drivers import drawn
from nnode.generate.people import sample_people, takes_paces
from nnode.model import Crowd, Traffic
from nnode.model.effects.base import IndividualEffect
from nnode.model.effects.crowd import GaitSway
from nnode.model.effects.lane import DriverHeterogeneity
from nnode.model.formula import effect_increment
from nnode.model.laws import law_from
from nnode.model.steps import STAGES
from nnode.model.system import System
from nnode.model.term import State, Term
from nnode.model.terms import Rule
from nnode.simulation.base import Trajectory, check_finite, substeps
from nnode.simulation.ode import Rates, whole_steps


@dataclass(frozen=True)
class Noise:
    """What drivers and people do beside their law, and what measurements add.

    In samples a step dt apart the push is autoregressive of first order with the factor
    exp(-dt/tau), in any step.

    Attributes:
        sigma: standard deviation of the push, m/s (first order) or m/s² (second order); of people
            that of each of its two components.
        tau: its correlation time, s.
        measurement: variance of the white error of measured positions, m², of each component.
        drivers: standard deviation of the pace (first order) or time gap (second order) among
            drivers, as a share; of models without ``driver_heterogeneity``. Of people, that of
            their preferred speed from what was taken for it.
    """

    sigma: float
    tau: float
    measurement: float = 0.0
    drivers: float = 0.0

    def __post_init__(self) -> None:
        if not (min(self.sigma, self.measurement, self.drivers) >= 0 and self.tau > 0):
            raise ConfigError(f"{self}: expected sizes from 0 on and a positive time")


class Push(Term):
    """A state of each vehicle that is added to what the law and all effects say.

    By itself it stays; :func:`sample` lets it decay and kicks it after each step. A push stops a
    vehicle, it does not make it drive backwards.
    """

    name = "noise"
    rules: ClassVar[dict[int, Rule]] = {
        1: Rule(rate="max(W + push, min(W, 0*W))", states={"push": ("m/s", "0*push/tau", "0*W")}),
        # whoever stands stays: steps end at a speed of 0 at the least
        2: Rule(rate="W + push", states={"push": ("m/s^2", "0*push/tau", "0*W")}),
    }
    source = "Uhlenbeck & Ornstein 1930; in car following: Treiber, Kesting & Helbing 2006"

    def __init__(self) -> None:
        super().__init__()
        self.declare("tau", 1.0, unit="s")

    def forward(self, state: State) -> Tensor:
        return effect_increment(self, state)


def constant_speed(domain: str = "traffic") -> System:
    """Baseline: every follower, or everybody, keeps the first measured speed."""
    if domain == "crowd":
        return Crowd([])
    law = law_from("constant_speed", {"parameters": {"change": "0 m/s^2"}, "rate": {"v": "change"}})
    return Traffic([law], leader="measured")


def takes_drivers(system: System, batch: Batch) -> bool:
    """Whether drivers or people may differ, and the model does not say how already."""
    if any(isinstance(term, IndividualEffect) for term in system.terms):
        return False
    if isinstance(system, Crowd):
        return takes_paces(system, batch)
    assert isinstance(system, Traffic)
    trial = copy.deepcopy(system)
    trial.terms.append(DriverHeterogeneity())
    try:
        return trial.formula is not None or trial.order == 1
    except ConfigError:  # a law without a time gap
        return False


def free(system: System) -> System:
    """A copy of a model in which all move but the first vehicle, which drives as measured."""
    found = copy.deepcopy(system).double()
    if isinstance(found, Traffic):
        found.leader = "measured"
    if isinstance(found, Crowd):
        found.neighbours = "simulated"
    return found


@torch.no_grad()
def sample(
    system: System,
    batch: Batch,
    noise: Noise,
    samples: int,
    *,
    seed: int | tuple[int, ...],
    dt: float | None = None,
    method: str | None = None,
) -> Trajectory:
    """Sampled motion from the measured start, each vehicle and everybody with an own push.

    The push starts in its stationary distribution. Drivers who differ (``driver_heterogeneity``)
    get numbers drawn from their distribution where the model knows none of them, and so do people
    (``walker_heterogeneity``).

    Args:
        system: of :func:`free`.
        batch: B sequences.
        noise: its measurement error is not added: places are those of the vehicles.
        samples: S.
        seed: of all that is drawn; batches that are to be independent need different ones.
        dt: step, s; None: the default of the model.
        method: of stepping, ``semi_implicit``, ``ballistic`` or ``rk4``; others are the model's
            own. The push stays the same during a step, also between the stages of ``rk4``:
            without noise the motion is that of the solver.

    Returns:
        ``(K, S * B, N, D)``, sample by sample.

    Raises:
        SimulationError: no finite number.
        ConfigError: a step that does not divide the sampling interval.
    """
    return sample_each(system, batch, [noise], samples, seed=seed, dt=dt, method=method)[0]


@torch.no_grad()
def sample_each(
    system: System,
    batch: Batch,
    noises: list[Noise],
    samples: int,
    *,
    seed: int | tuple[int, ...],
    dt: float | None = None,
    method: str | None = None,
) -> list[Trajectory]:
    """What :func:`sample` gives of each of several noises, from the same random numbers.

    Vehicles of all noises are simulated side by side where nothing but size and time of the push
    differs between them.
    """
    alike = len({noise.drivers for noise in noises}) == 1
    drawn_each = any(isinstance(term, IndividualEffect) for term in system.terms)
    if len(noises) > 1 and (isinstance(system, Crowd) or not alike or drawn_each):
        options: dict[str, Any] = {"seed": seed, "dt": dt, "method": method}
        return [sample_each(system, batch, [one], samples, **options)[0] for one in noises]
    rng = np.random.default_rng(seed)
    copies = samples * len(noises)
    many = batch.select([b for _ in range(copies) for b in range(len(batch))])
    many = replace(many, names=numbered(batch.names, copies))
    if isinstance(system, Crowd):
        moving = copy.deepcopy(system)
        _give_drivers(moving, many, batch.names, rng)
        (noise,) = noises
        own = (noise.sigma, noise.tau, noise.drivers)
        return [sample_people(moving, many, own, rng, dt)]
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    n = substeps(batch.dt, dt, system)
    step = batch.dt / n
    noisy = copy.deepcopy(system)
    if noises[0].drivers:
        noisy.terms.append(DriverHeterogeneity(sigma=noises[0].drivers))
    _give_drivers(noisy, many, batch.names, rng)
    noisy.terms.append(Push())
    if method not in ("semi_implicit", "ballistic", "rk4"):
        method = noisy.step
    rates = Rates(noisy, many, n, method)
    y = noisy.initial(many, step)
    # of each sampled sequence
    sigma, kept = (
        torch.tensor(values, dtype=y.dtype).repeat_interleave(samples * len(batch))[:, None]
        for values in ([o.sigma for o in noises], [math.exp(-step / o.tau) for o in noises])
    )
    kick = sigma * torch.sqrt(1 - kept**2)

    def normal() -> Tensor:
        shape = samples * len(batch), y.shape[1]
        return torch.randn(shape, generator=generator, dtype=y.dtype).repeat(len(noises), 1)

    y[..., -1] = sigma * normal()

    still = torch.ones_like(y[0, 0])
    still[-1] = 0.0

    def change(step: Tensor, y: Tensor) -> Tensor:
        found: Tensor = rates(step, y)
        if STAGES[method] == "rk4":
            second = rates(step + 0.5, y + still * found / 2)
            third = rates(step + 0.5, y + still * second / 2)
            last = rates(step + 1, y + still * third)
            found = found + still * ((found + 2 * second + 2 * third + last) / 6 - found)
        # exact for an autoregressive process
        found[..., -1] = (kept - 1) * y[..., -1] + kick * normal()
        return found

    times = n * torch.arange(batch.n_samples, dtype=y.dtype)
    grid = {"grid_constructor": whole_steps}
    states = odeint(change, y, times, method="euler", options=grid)
    x, v = noisy.observe(states, many)
    check_finite(Trajectory(x, v), many)
    each = samples * len(batch)
    parts = zip(
        x.split(each, 1), [None] * len(noises) if v is None else v.split(each, 1), strict=True
    )
    return [Trajectory(*part) for part in parts]


def numbered(names: tuple[str, ...], samples: int) -> tuple[str, ...]:
    """Names of sampled sequences: ``NAME~1`` is the first sample of ``NAME``."""
    return tuple(f"{name}~{s + 1}" for s in range(samples) for name in names)


def _give_drivers(
    system: System, many: Batch, names: tuple[str, ...], rng: np.random.Generator
) -> None:
    """Give everybody a number, in effects that differ by driver or person.

    Gait is known or not: nobody's is drawn.
    """
    for term in system.terms:
        if isinstance(term, IndividualEffect):
            people = {}
            for i, name in enumerate(many.names):
                own = term.people.get(names[i % len(names)])
                if own is None and isinstance(term, GaitSway):
                    continue
                people[name] = own or drawn(term, [()] * many.agent.shape[1], rng).tolist()
            term.people = people
