"""The noise of drivers and people: an Ornstein-Uhlenbeck process on speeds or accelerations."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np
import torch
from torch import Tensor
from torchdiffeq import odeint

from nnode.data.sequence import Batch
from nnode.errors import ConfigError
from nnode.exchange.drivers import drawn
from nnode.model import Crowd, Traffic
from nnode.model.effects.base import IndividualEffect
from nnode.model.effects.lane import DriverHeterogeneity
from nnode.model.expression import Expr, substitute, symbol
from nnode.model.formula import effect_increment, lane_of
from nnode.model.laws import law_from
from nnode.model.scene import Scene
from nnode.model.steps import STAGES
from nnode.model.system import System
from nnode.model.term import State, Term
from nnode.model.terms import LaneDynamics, Rule
from nnode.simulation.base import Trajectory, check_finite, substeps
from nnode.simulation.ode import Rates, whole_steps

#: Smallest random factor on a measured preferred speed.
SLOWEST = 0.1


@dataclass(frozen=True)
class Noise:
    """Noise of drivers and people, and of measurements.

    Sampled at steps dt, the noise of a driver is an autoregressive process of first order with the
    factor exp(-dt/tau).

    Attributes:
        sigma: standard deviation of the noise, m/s (first order) or m/s² (second order); for
            people of each of two components.
        tau: correlation time of the noise, s.
        measurement: variance of the white error of measured positions, m², of each component.
        drivers: relative standard deviation of the pace (first order) or time gap (second order)
            between drivers, for models without ``driver_heterogeneity``; for people of the
            preferred speed.
        parameters: address of a parameter of the law, such as ``idm.T``, to the standard deviation
            of its logarithm between drivers.
    """

    sigma: float
    tau: float
    measurement: float = 0.0
    drivers: float = 0.0
    parameters: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        smallest = min(self.sigma, self.measurement, self.drivers, *self.parameters.values())
        if not (smallest >= 0 and self.tau > 0):
            raise ConfigError(f"{self}: expected sizes from 0 on and a positive time")


class Push(Term):
    """The noise of each vehicle, a state that is added to the rate by the law and all effects.

    The state is constant by its formula. :func:`sample` updates it after each step. The noise may
    stop a vehicle, but vehicles do not drive backwards.

    Args:
        factors: address of a parameter to the drivers' factors ``(B, N)`` on it, for
            :class:`DifferentDrivers`.
    """

    name = "noise"
    rules: ClassVar[dict[int, Rule]] = {
        1: Rule(rate="max(W + push, min(W, 0*W))", states={"push": ("m/s", "0*push/tau", "0*W")}),
        # the method of stepping keeps speeds at least 0
        2: Rule(rate="W + push", states={"push": ("m/s^2", "0*push/tau", "0*W")}),
    }
    source = "Uhlenbeck & Ornstein 1930; in car following: Treiber, Kesting & Helbing 2006"

    def __init__(self, factors: Mapping[str, Tensor] | None = None) -> None:
        super().__init__()
        self.declare("tau", 1.0, unit="s")
        self.factors = factors or {}

    def forward(self, state: State) -> Tensor:
        return effect_increment(self, state)

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        return dict(self.factors)


class DifferentDrivers(Traffic):
    """A lane behind a measured leader, whose drivers have parameters of their own.

    Args:
        terms: the law, its effects and the noise, all with formulas.
        factors: see :class:`Push`.
    """

    def __init__(self, terms: Iterable[Term], factors: Mapping[str, Tensor]) -> None:
        super().__init__([*terms, Push(factors)], leader="measured")

    @cached_property
    def formula(self) -> LaneDynamics:
        lane, place = lane_of(self.term_list), len(self.terms) - 1
        assert lane is not None
        scaled, inputs = dict[str, Expr](), dict(lane.inputs)
        for address in cast(Push, self.terms[place]).factors:
            name = address.replace(".", "__", 1)
            scaled[name] = symbol(name) * symbol(f"factor_{name}")
            inputs[f"factor_{name}"] = (place, address)
        rates, starts = (
            {state: substitute(formula, scaled) for state, formula in formulas.items()}
            for formulas in (lane.rates, lane.starts)
        )
        return replace(lane, rates=rates, starts=starts, inputs=inputs)


def constant_speed(domain: str = "traffic") -> System:
    """Baseline: every follower, or every person, keeps the first measured speed."""
    if domain == "crowd":
        return Crowd([])
    law = law_from("constant_speed", {"parameters": {"change": "0 m/s^2"}, "rate": {"v": "change"}})
    return Traffic([law], leader="measured")


def allows_driver_differences(system: System, batch: Batch) -> bool:
    """Whether the model allows differences between drivers or people, and has none yet."""
    if any(isinstance(term, IndividualEffect) for term in system.terms):
        return False
    if isinstance(system, Crowd):
        scene, y = system.scene(batch), system.initial(batch)
        faster = _with_speed_factor(scene, torch.tensor(1.1))
        rates = [system(torch.zeros(()), y, each) for each in (scene, faster)]
        return not torch.equal(*rates)
    assert isinstance(system, Traffic)
    trial = copy.deepcopy(system)
    trial.terms.append(DriverHeterogeneity())
    try:
        return trial.formula is not None or trial.order == 1
    except ConfigError:  # a law without a time gap
        return False


def free_running(system: System) -> System:
    """A copy of a model in which all agents are simulated, except the measured first vehicle."""
    model = copy.deepcopy(system).double()
    if isinstance(model, Traffic):
        model.leader = "measured"
    if isinstance(model, Crowd):
        model.neighbours = "simulated"
    return model


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
    """Sampled motion from the measured start, with independent noise for each agent.

    The noise starts in its stationary distribution. Numbers of drivers (``driver_heterogeneity``)
    and people (``walker_heterogeneity``) that the model does not know are drawn from their
    distribution.

    Args:
        system: model of :func:`free_running`.
        batch: B sequences.
        noise: the noise; its measurement error is not added.
        samples: S, the number of samples.
        seed: seed of all random numbers; independent batches need different seeds.
        dt: step, s; None takes the model's default.
        method: method of stepping, ``semi_implicit``, ``ballistic`` or ``rk4``; for others, the
            model's method. The noise is constant during a step, also between the stages of
            ``rk4``, so that the motion without noise is that of the solver.

    Returns:
        ``(K, S * B, N, D)``, sample by sample.

    Raises:
        SimulationError: a state is not finite.
        ConfigError: the step does not divide the sampling interval.
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
    """The results of :func:`sample` for several noises, with the same random numbers.

    Vehicles are simulated at once for all noises if these only differ in size and correlation time.
    Noises with ``parameters`` are sampled alone.
    """
    alike = len({noise.drivers for noise in noises}) == 1
    drawn_each = any(isinstance(term, IndividualEffect) for term in system.terms)
    if len(noises) > 1 and (isinstance(system, Crowd) or not alike or drawn_each):
        options: dict[str, Any] = {"seed": seed, "dt": dt, "method": method}
        return [sample_each(system, batch, [noise], samples, **options)[0] for noise in noises]
    rng = np.random.default_rng(seed)
    copies = samples * len(noises)
    repeated = batch.select([b for _ in range(copies) for b in range(len(batch))])
    repeated = replace(repeated, names=numbered(batch.names, copies))
    if isinstance(system, Crowd):
        moving = copy.deepcopy(system)
        _assign_drivers(moving, repeated, batch.names, rng)
        (noise,) = noises
        return [_sample_people(moving, repeated, noise, rng, dt)]
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    n = substeps(batch.dt, dt, system)
    step = batch.dt / n
    noisy = _with_noise(system, noises[0], repeated, batch.names, rng)
    if method not in ("semi_implicit", "ballistic", "rk4"):
        method = noisy.step
    rates = Rates(noisy, repeated, n, method)
    y = noisy.initial(repeated, step)
    each = samples * len(batch)
    # values for each sampled sequence
    sigma, kept = (
        torch.tensor(values, dtype=y.dtype).repeat_interleave(each)[:, None]
        for values in ([o.sigma for o in noises], [math.exp(-step / o.tau) for o in noises])
    )
    kick = sigma * torch.sqrt(1 - kept**2)

    def normal() -> Tensor:
        drawn_once = torch.randn(each, y.shape[1], generator=generator, dtype=y.dtype)
        return drawn_once.repeat(len(noises), 1)

    y[..., -1] = sigma * normal()
    state_mask = torch.ones_like(y[0, 0])
    state_mask[-1] = 0.0

    def change(step: Tensor, y: Tensor) -> Tensor:
        rate: Tensor = rates(step, y)
        if STAGES[method] == "rk4":
            second = rates(step + 0.5, y + state_mask * rate / 2)
            third = rates(step + 0.5, y + state_mask * second / 2)
            last = rates(step + 1, y + state_mask * third)
            rate = rate + state_mask * ((rate + 2 * second + 2 * third + last) / 6 - rate)
        # the exact step of the autoregressive process
        rate[..., -1] = (kept - 1) * y[..., -1] + kick * normal()
        return rate

    x, v = noisy.observe(_integrate(change, y, n, batch.n_samples), repeated)
    check_finite(Trajectory(x, v), repeated)
    speeds = [None] * len(noises) if v is None else v.split(each, 1)
    return [Trajectory(*part) for part in zip(x.split(each, 1), speeds, strict=True)]


def _integrate(
    change: Callable[[Tensor, Tensor], Tensor], start: Tensor, n: int, samples: int
) -> Tensor:
    """States at the sampling times, by n steps of ``change`` in a sampling interval."""
    times = n * torch.arange(samples, dtype=start.dtype)
    options = {"grid_constructor": whole_steps}
    return cast(Tensor, odeint(change, start, times, method="euler", options=options))


def _sample_people(
    system: Crowd, batch: Batch, noise: Noise, rng: np.random.Generator, dt: float | None
) -> Trajectory:
    """Sampled motion of people in Euler's steps.

    Args:
        batch: the sequences, repeated for every sample.
    """
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    n = substeps(batch.dt, dt, system)
    step = batch.dt / n
    kept = math.exp(-step / noise.tau)
    kick = noise.sigma * math.sqrt(1 - kept**2)
    rates = Rates(system, batch, n, system.step)
    if noise.drivers:
        factors = 1 + noise.drivers * rng.normal(size=(*batch.agent.shape, 1))
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

    start = torch.cat([y, noise.sigma * normal()], -1)
    states = _integrate(change, start, n, batch.n_samples)[..., :width]
    return check_finite(Trajectory(*system.observe(states, batch)), batch)


def _with_speed_factor(scene: Scene, factor: Tensor) -> Scene:
    """The scene with preferred speeds multiplied by a factor."""
    return replace(scene, preferred=factor * scene.preferred)


def numbered(names: tuple[str, ...], samples: int) -> tuple[str, ...]:
    """Names of sampled sequences: ``NAME~1`` is the first sample of ``NAME``."""
    return tuple(f"{name}~{s + 1}" for s in range(samples) for name in names)


def _with_noise(
    system: System, noise: Noise, repeated: Batch, names: tuple[str, ...], rng: np.random.Generator
) -> Traffic:
    """A model of a lane with pushes, and with drivers who differ as the noise says.

    Args:
        repeated: the sampled sequences. names: of the measured ones.
    """
    noisy = copy.deepcopy(system)
    assert isinstance(noisy, Traffic)
    if noise.drivers:
        noisy.terms.append(DriverHeterogeneity(sigma=noise.drivers))
    _assign_drivers(noisy, repeated, names, rng)
    factors = {
        address: torch.from_numpy(np.exp(deviation * rng.normal(size=repeated.agent.shape)))
        for address, deviation in noise.parameters.items()
    }
    if factors:
        return DifferentDrivers(noisy.term_list, factors)
    noisy.terms.append(Push())
    return noisy


def _assign_drivers(
    system: System, repeated: Batch, names: tuple[str, ...], rng: np.random.Generator
) -> None:
    """Assign numbers to all agents in effects that differ between agents. Unknown numbers are
    drawn."""
    for term in system.terms:
        if isinstance(term, IndividualEffect):
            people = {}
            for i, name in enumerate(repeated.names):
                numbers = term.people.get(names[i % len(names)])
                people[name] = numbers or drawn(term, [()] * repeated.agent.shape[1], rng).tolist()
            term.people = people
