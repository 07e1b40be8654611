"""The noise is an autoregressive process and is recovered from its samples."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from nnode.app.python.inputs import model_options
from nnode.data.sequence import Batch, collate
from nnode.errors import ConfigError, DataError
from nnode.generate.fit import fit_noise
from nnode.generate.noise import (
    SLOWEST,
    DifferentDrivers,
    Noise,
    allows_driver_differences,
    constant_speed,
    free_running,
    sample,
)
from nnode.generate.scores import band
from nnode.model import System, Traffic, build_model
from nnode.model.laws import make_law
from nnode.model.term import State, Term
from nnode.simulation import Solver, TorchdiffeqSolver
from tests.app.following import TRUE, platoon
from tests.builders import lane, straight
from tests.simulation.fused.compare import RungeKutta

STEP = 0.1
DOMAINS = ("traffic", "crowd")


def model(domain: str, *effects: dict[str, object], **options: object) -> System:
    """The IDM with the platoons' parameters, or the social force."""
    law = "idm" if domain == "traffic" else "sf"
    options = {"desired": "direction", **options} if domain == "crowd" else options
    system = build_model({**model_options(law, "measured"), **options, "effects": list(effects)})
    if domain == "traffic":
        for name, value in TRUE.items():
            getattr(system.terms[0], name).data.fill_(value)
    return free_running(system)


def measured(
    domain: str, number: int, seconds: float, agents: int | None = None, seed: int = 0
) -> Batch:
    """Platoons of three vehicles, or four people abreast who keep different speeds."""
    rng, sequences = np.random.default_rng(seed), []
    for i in range(number):
        if domain == "traffic":
            x, v = platoon(rng, agents or 3, seconds)
            sequences.append(lane(x, STEP, v=v, name=f"s{i}", length=4.5))
        else:
            speed = 1.3 + 0.1 * rng.normal(size=agents or 4)
            abreast = np.stack([0 * speed, 1.5 * np.arange(len(speed))], -1)
            v = np.stack([speed, 0 * speed], -1)
            samples = round(seconds / STEP) + 1
            sequences.append(straight(abreast, v, samples, STEP, name=f"s{i}"))
    return collate(sequences)


def free(domain: str, values: torch.Tensor) -> np.ndarray:
    """Values of simulated agents: all but the leaders, which are last."""
    return values[:, :, slice(-1) if domain == "traffic" else slice(None)].numpy()


@pytest.mark.parametrize("domain", DOMAINS)
def test_noise_is_autoregressive_for_any_step(domain: str) -> None:
    noise, batch = Noise(0.4, 2.0), measured(domain, 1, 20.0, agents=2)
    if domain == "traffic":
        batch = replace(batch, v=0 * batch.v + 20.0)  # no vehicle stops
    for dt in (0.1, 0.05):
        v = sample(constant_speed(domain), batch, noise, 2000, seed=1, dt=dt).v
        assert v is not None
        push = free(domain, torch.diff(v, dim=0)) / STEP
        # variance of the noise's mean over 0.1 s, relative to sigma²
        steps = round(STEP / dt)
        decay = math.exp(-dt / noise.tau)
        share = sum(decay ** abs(i - j) for i in range(steps) for j in range(steps)) / steps**2
        size = noise.sigma * math.sqrt(share)
        np.testing.assert_allclose(push.std((0, 1, 2)), size, rtol=0.02)
        correlation = (push[20:] * push[:-20]).mean((0, 1, 2)) / push.var((0, 1, 2))
        np.testing.assert_allclose(correlation, math.exp(-1.0) / share, atol=0.03)
        if domain == "crowd":  # components are independent
            assert abs((push[..., 0] * push[..., 1]).mean()) < 0.02 * size**2


def test_noise_does_not_reverse_a_vehicle() -> None:
    options = {**model_options("lin", "measured"), "v0": 2.0}
    # the gaps are too large for the law to stop a vehicle
    batch = measured("traffic", 4, 20.0)
    batch = replace(batch, x=batch.x + 1000.0 * torch.arange(3)[:, None])
    x = sample(free_running(build_model(options)), batch, Noise(3.0, 1.0), 5, seed=0, dt=0.1).x
    steps = np.diff(free("traffic", x), axis=0)
    assert steps.min() >= -1e-12
    assert (steps == 0).mean() > 0.1


class ZeroTerm(Term):
    """A term in Python code, which has no formula."""

    name = "zero"

    def forward(self, state: State) -> torch.Tensor:
        return torch.zeros_like(state.x)


def test_python_code_is_sampled_like_a_formula() -> None:
    batch, noise = measured("traffic", 3, 10.0), Noise(0.5, 2.0, 0.0, 0.1)
    by_formula = Traffic([make_law("lin", v0=25.0, L=6.0, L_min=0.0)], "measured")
    by_code = Traffic([make_law("lin", v0=25.0, L=6.0, L_min=0.0), ZeroTerm()], "measured")
    assert by_code.formula is None
    assert allows_driver_differences(by_code, batch)
    expected, x = (sample(m, batch, noise, 3, seed=0, dt=0.05).x for m in (by_formula, by_code))
    torch.testing.assert_close(x, expected, rtol=0, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("domain", "noise", "number", "seconds"),
    [
        ("traffic", Noise(0.3, 1.5, 0.0025), 24, 60.0),
        ("traffic", Noise(0.2, 2.0, 0.0, 0.2), 60, 24.0),
        ("crowd", Noise(0.4, 1.5, 0.0001), 40, 12.0),
        ("crowd", Noise(0.3, 0.8, 0.0, 0.15), 40, 12.0),
    ],
)
def test_noise_is_recovered(domain: str, noise: Noise, number: int, seconds: float) -> None:
    traffic = domain == "traffic"  # with exact leaders
    seed = 5 if traffic else 3
    batch = measured(domain, number, seconds, seed=seed)
    sampled = sample(model(domain), batch, noise, 1, seed=seed)
    assert sampled.v is not None
    error = noise.measurement**0.5 * np.random.default_rng(seed).normal(size=sampled.x.shape)
    error[0] = 0.0
    if traffic:
        error[:, :, -1] = 0.0
    preferred = {} if traffic else {"preferred": batch.v[0]}
    measured_batch = replace(batch, x=sampled.x + torch.from_numpy(error), v=sampled.v, **preferred)
    fitted = fit_noise(model(domain), [measured_batch], np.arange(number), seed=2)
    assert fitted.sigma is not None
    assert fitted.tau is not None
    assert fitted.drivers is not None
    assert fitted.sigma[0] < noise.sigma < fitted.sigma[1]
    assert fitted.tau[0] < noise.tau < fitted.tau[1]
    # sigma is precise; few agents determine tau only within a factor
    assert fitted.sigma[1] < 1.5 * fitted.sigma[0]
    assert 0.5 < fitted.noise.tau / noise.tau < 2
    if noise.drivers:
        assert fitted.drivers[0] < noise.drivers < fitted.drivers[1]
    else:
        assert fitted.noise.drivers < 0.05
    expected = noise.measurement * (2 / 3 if traffic else 1.0)
    assert fitted.noise.measurement == pytest.approx(expected, rel=0.1, abs=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(("domain", "drivers"), [("traffic", 0.0), ("crowd", 0.1)])
def test_bands_cover_samples_of_the_model(domain: str, drivers: float) -> None:
    noise = Noise(0.3, 1.5, 0.0, drivers)
    copies, number = 39, 60
    batch = measured(domain, number, 8.0, agents=2, seed=1)
    truth, samples = (
        free(domain, sample(model(domain), batch, noise, n, seed=seed).x)
        for n, seed in ((1, 7), (copies, 8))
    )
    inside = []
    for k in (20, 50, 80):
        low, high = band(samples[k].reshape(copies, number, *samples.shape[2:]), 0.95)
        inside.append((low <= truth[k]) & (truth[k] <= high))
    # conservative: only sequences count as independent
    assert abs(np.mean(inside) - 0.95) < 3 * math.sqrt(0.95 * 0.05 / number)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("domain", "solver", "options"),
    [
        ("traffic", RungeKutta(), {}),
        ("traffic", TorchdiffeqSolver("ballistic"), {"method": "ballistic"}),
        ("crowd", TorchdiffeqSolver("euler", dt=0.05), {"dt": 0.05}),
    ],
)
def test_zero_noise_gives_the_solver_s_paths(
    domain: str, solver: Solver, options: dict[str, Any]
) -> None:
    batch, system = measured(domain, 3, 8.0), model(domain)
    plain = solver(system, batch)
    samples = sample(system, batch, Noise(0.0, 1.0), 2, seed=0, **options)
    torch.testing.assert_close(samples.x, torch.cat([plain.x, plain.x], 1))


def test_seed_determines_samples() -> None:
    batch, noise = measured("traffic", 2, 5.0), Noise(0.3, 1.0)
    first, same, other = (sample(model("traffic"), batch, noise, 2, seed=s).x for s in (1, 1, 2))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_unknown_drivers_are_drawn_and_known_drivers_kept() -> None:
    batch = measured("traffic", 2, 20.0)
    people = {"s0": [0.0, 0.0, 0.0]}
    system = model("traffic", {"name": "driver_heterogeneity", "sigma": 0.3, "people": people})
    x = sample(system, batch, Noise(0.0, 1.0), 50, seed=0).x.unflatten(1, (50, 2))
    spread = x[-1, :, :, 0, 0].std(0)
    assert float(spread[0]) == 0.0
    assert float(spread[1]) > 1.0


def test_driver_specific_parameters_are_applied() -> None:
    zone = {"name": "speed_zone", "alpha": 0.7, "a": 50.0, "b": 200.0}
    system, batch = model("traffic", zone, {"name": "reaction_delay"}), measured("traffic", 2, 10.0)
    factors = {"idm.T": 1.3, "idm.v0": 0.9}
    drivers = {name: torch.full((2, 3), factor) for name, factor in factors.items()}
    solver = TorchdiffeqSolver("ballistic")
    paths = solver(DifferentDrivers(system.term_list, drivers).double(), batch)
    for name, factor in factors.items():
        getattr(system.terms[0], name.removeprefix("idm.")).data.mul_(factor)
    torch.testing.assert_close(paths.x, solver(system, batch).x)


@pytest.mark.thorough
def test_parameters_are_drawn_for_each_driver() -> None:
    batch, noise = measured("traffic", 1, 20.0), Noise(0.0, 1.0, parameters={"idm.T": 0.2})
    system = model("traffic")
    x = sample(system, batch, noise, 400, seed=0).x[..., 0]
    # the response of followers' final positions to the logarithm of T
    ends = []
    for factor in (0.99, 1.01):
        changed = copy.deepcopy(system)
        changed.terms[0].T.data.mul_(factor)
        ends.append(sample(changed, batch, Noise(0.0, 1.0), 1, seed=0).x[-1, 0, :2, 0])
    response = (ends[1] - ends[0]).abs() / 0.02
    assert float(x[-1, :, 1].std()) == pytest.approx(0.2 * float(response[1]), rel=0.1)
    # the second follower depends on two independent drivers
    assert float(x[-1, :, 0].std()) < 0.2 * float(response[0])


@pytest.mark.thorough
def test_desired_speeds_are_drawn_around_measured_ones() -> None:
    batch = measured("crowd", 2, 20.0)
    x = sample(model("crowd"), batch, Noise(0.0, 1.0, 0.0, 0.2), 500, seed=0).x
    x = x.unflatten(1, (500, 2))
    speed = (x[-1] - x[-50])[..., 0] / (49 * STEP)  # the relaxation time is 0.5 s
    share = (speed / batch.v[0, :, :, 0]).numpy()
    assert share.mean() == pytest.approx(1.0, abs=0.01)
    assert share.std() == pytest.approx(0.2, rel=0.03)
    assert share.min() > SLOWEST - 1e-6


def test_models_that_allow_driver_differences() -> None:
    batch, differ = measured("crowd", 2, 8.0), {"name": "walker_heterogeneity", "sigma": 0.3}
    assert allows_driver_differences(model("crowd"), batch)
    assert not allows_driver_differences(model("crowd", desired="last"), batch)
    assert not allows_driver_differences(model("crowd", differ), batch)
    for domain in DOMAINS:
        assert not allows_driver_differences(constant_speed(domain), measured(domain, 1, 5.0))


def test_agents_stand_still_after_the_end_of_a_sequence() -> None:
    long, short = measured("crowd", 1, 8.0), measured("crowd", 1, 8.0, seed=1)
    valid = torch.cat([long.valid, short.valid], 1)
    valid[40:, 1] = False
    batch = replace(long.select([0, 0]), valid=valid, names=("a", "b"))
    x = sample(model("crowd"), batch, Noise(0.5, 1.0), 1, seed=0).x
    assert float((x[41:, 1] - x[40, 1]).abs().max()) < 0.2  # the remainder of a step
    assert torch.equal(x[41:, 1], x[41:42, 1].expand(40, -1, -1))
    assert float((x[80, 0] - x[40, 0]).abs().max()) > 1.0


@pytest.mark.parametrize(
    ("domain", "seconds", "shortest"), [("traffic", 2.0, "3"), ("crowd", 0.6, r"0\.75")]
)
def test_short_sequences_and_zero_tau_are_refused(
    domain: str, seconds: float, shortest: str
) -> None:
    with pytest.raises(DataError, match=f"more than {shortest} s"):
        fit_noise(model(domain), [measured(domain, 2, seconds)], np.arange(2))
    with pytest.raises(ConfigError, match="positive time"):
        Noise(0.1, 0.0)
