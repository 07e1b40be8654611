"""The noise is an autoregressive process, and is estimated from what was sampled with it."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

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
    """The IDM that the platoons drive by, or a law of people."""
    law = "idm" if domain == "traffic" else "sf"
    options = {"desired": "direction", **options} if domain == "crowd" else options
    built = build_model({**model_options(law, "measured"), **options, "effects": list(effects)})
    if domain == "traffic":
        for name, value in TRUE.items():
            getattr(built.terms[0], name).data.fill_(value)
    return free_running(built)


def measured(
    domain: str, number: int, seconds: float, agents: int | None = None, seed: int = 0
) -> Batch:
    """Platoons of three vehicles, or four people abreast who walk straight on at speeds of their
    own."""
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
    """Of agents who are simulated: all but the leaders, who stand last."""
    return values[:, :, slice(-1) if domain == "traffic" else slice(None)].numpy()


@pytest.mark.parametrize("domain", DOMAINS)
def test_the_push_is_autoregressive_in_any_step(domain: str) -> None:
    noise, batch = Noise(0.4, 2.0), measured(domain, 1, 20.0, agents=2)
    if domain == "traffic":
        batch = replace(batch, v=0 * batch.v + 20.0)  # nobody comes to a stop
    for dt in (0.1, 0.05):
        v = sample(constant_speed(domain), batch, noise, 2000, seed=1, dt=dt).v
        assert v is not None
        push = free(domain, torch.diff(v, dim=0)) / STEP
        # the mean of a push over a step of 0.1 s
        steps = round(STEP / dt)
        kept = math.exp(-dt / noise.tau)
        same = sum(kept ** abs(i - j) for i in range(steps) for j in range(steps)) / steps**2
        size = noise.sigma * math.sqrt(same)
        np.testing.assert_allclose(push.std((0, 1, 2)), size, rtol=0.02)
        later = (push[20:] * push[:-20]).mean((0, 1, 2)) / push.var((0, 1, 2))
        np.testing.assert_allclose(later, math.exp(-1.0) / same, atol=0.03)
        if domain == "crowd":  # components are independent
            assert abs((push[..., 0] * push[..., 1]).mean()) < 0.02 * size**2


def test_a_push_stops_a_vehicle_and_does_not_turn_it() -> None:
    options = {**model_options("lin", "measured"), "v0": 2.0}
    # gaps at which the law by itself stops nobody
    batch = measured("traffic", 4, 20.0)
    batch = replace(batch, x=batch.x + 1000.0 * torch.arange(3)[:, None])
    x = sample(free_running(build_model(options)), batch, Noise(3.0, 1.0), 5, seed=0, dt=0.1).x
    steps = np.diff(free("traffic", x), axis=0)
    assert steps.min() >= -1e-12
    assert (steps == 0).mean() > 0.1


class Nothing(Term):
    """A term that is Python code, so that the model has no formula."""

    name = "nothing"

    def forward(self, state: State) -> torch.Tensor:
        return torch.zeros_like(state.x)


def test_a_model_that_is_code_is_sampled_as_its_formula() -> None:
    batch, noise = measured("traffic", 3, 10.0), Noise(0.5, 2.0, 0.0, 0.1)
    by_formula = Traffic([make_law("lin", v0=25.0, L=6.0, L_min=0.0)], "measured")
    by_code = Traffic([make_law("lin", v0=25.0, L=6.0, L_min=0.0), Nothing()], "measured")
    assert by_code.formula is None
    assert allows_driver_differences(by_code, batch)
    one, two = (sample(m, batch, noise, 3, seed=0, dt=0.05).x for m in (by_formula, by_code))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-9)


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
def test_noise_is_found_again(domain: str, noise: Noise, number: int, seconds: float) -> None:
    led = domain == "traffic"  # leaders are exact
    seed = 5 if led else 3
    batch = measured(domain, number, seconds, seed=seed)
    sampled = sample(model(domain), batch, noise, 1, seed=seed)
    assert sampled.v is not None
    error = noise.measurement**0.5 * np.random.default_rng(seed).normal(size=sampled.x.shape)
    error[0] = 0.0
    if led:
        error[:, :, -1] = 0.0
    given = {} if led else {"preferred": batch.v[0]}
    measured_batch = replace(batch, x=sampled.x + torch.from_numpy(error), v=sampled.v, **given)
    fitted = fit_noise(model(domain), [measured_batch], np.arange(number), seed=2)
    assert fitted.sigma is not None
    assert fitted.tau is not None
    assert fitted.drivers is not None
    assert fitted.sigma[0] < noise.sigma < fitted.sigma[1]
    assert fitted.tau[0] < noise.tau < fitted.tau[1]
    # the size is well known, its time from so few agents to a factor
    assert fitted.sigma[1] < 1.5 * fitted.sigma[0]
    assert 0.5 < fitted.noise.tau / noise.tau < 2
    if noise.drivers:
        assert fitted.drivers[0] < noise.drivers < fitted.drivers[1]
    else:
        assert fitted.noise.drivers < 0.05
    wanted = noise.measurement * (2 / 3 if led else 1.0)
    assert fitted.noise.measurement == pytest.approx(wanted, rel=0.1, abs=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(("domain", "drivers"), [("traffic", 0.0), ("crowd", 0.1)])
def test_bands_cover_what_was_sampled_from_the_model_itself(domain: str, drivers: float) -> None:
    noise = Noise(0.3, 1.5, 0.0, drivers)
    samples, number = 39, 60
    batch = measured(domain, number, 8.0, agents=2, seed=1)
    truth, drawn = (
        free(domain, sample(model(domain), batch, noise, copies, seed=seed).x)
        for copies, seed in ((1, 7), (samples, 8))
    )
    inside = []
    for k in (20, 50, 80):
        low, high = band(drawn[k].reshape(samples, number, *drawn.shape[2:]), 0.95)
        inside.append((low <= truth[k]) & (truth[k] <= high))
    # of independent sequences; agents, components and times taken as one another's copies at worst
    assert abs(np.mean(inside) - 0.95) < 3 * math.sqrt(0.95 * 0.05 / number)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("domain", "solver", "how"),
    [
        ("traffic", RungeKutta(), {}),
        ("traffic", TorchdiffeqSolver("ballistic"), {"method": "ballistic"}),
        ("crowd", TorchdiffeqSolver("euler", dt=0.05), {"dt": 0.05}),
    ],
)
def test_no_noise_is_the_solver_s_motion(domain: str, solver: Solver, how: dict[str, str]) -> None:
    batch, system = measured(domain, 3, 8.0), model(domain)
    plain = solver(system, batch)
    twice = sample(system, batch, Noise(0.0, 1.0), 2, seed=0, **how)
    torch.testing.assert_close(twice.x, torch.cat([plain.x, plain.x], 1))


def test_the_same_seed_gives_the_same_samples() -> None:
    batch, noise = measured("traffic", 2, 5.0), Noise(0.3, 1.0)
    one, two, three = (sample(model("traffic"), batch, noise, 2, seed=s).x for s in (1, 1, 2))
    assert torch.equal(one, two)
    assert not torch.equal(one, three)


def test_unknown_drivers_are_drawn_and_known_ones_are_kept() -> None:
    batch = measured("traffic", 2, 20.0)
    people = {"s0": [0.0, 0.0, 0.0]}
    differ = model("traffic", {"name": "driver_heterogeneity", "sigma": 0.3, "people": people})
    x = sample(differ, batch, Noise(0.0, 1.0), 50, seed=0).x.unflatten(1, (50, 2))
    spread = x[-1, :, :, 0, 0].std(0)
    assert float(spread[0]) == 0.0
    assert float(spread[1]) > 1.0


def test_drivers_with_parameters_of_their_own_move_by_these() -> None:
    zone = {"name": "speed_zone", "alpha": 0.7, "a": 50.0, "b": 200.0}
    system, batch = model("traffic", zone, {"name": "reaction_delay"}), measured("traffic", 2, 10.0)
    factors = {"idm.T": 1.3, "idm.v0": 0.9}
    every = {name: torch.full((2, 3), factor) for name, factor in factors.items()}
    solver = TorchdiffeqSolver("ballistic")
    moved = solver(DifferentDrivers(system.term_list, every).double(), batch)
    for name, factor in factors.items():
        getattr(system.terms[0], name.removeprefix("idm.")).data.mul_(factor)
    torch.testing.assert_close(moved.x, solver(system, batch).x)


@pytest.mark.thorough
def test_parameters_are_drawn_for_each_driver() -> None:
    batch, noise = measured("traffic", 1, 20.0), Noise(0.0, 1.0, parameters={"idm.T": 0.2})
    system = model("traffic")
    x = sample(system, batch, noise, 400, seed=0).x[..., 0]
    # the response of the first follower's position to the logarithm of T
    ends = []
    for factor in (0.99, 1.01):
        changed = copy.deepcopy(system)
        changed.terms[0].T.data.mul_(factor)
        ends.append(sample(changed, batch, Noise(0.0, 1.0), 1, seed=0).x[-1, 0, :2, 0])
    response = (ends[1] - ends[0]).abs() / 0.02
    assert float(x[-1, :, 1].std()) == pytest.approx(0.2 * float(response[1]), rel=0.1)
    # the second follower's differs by what both drivers do
    assert float(x[-1, :, 0].std()) < 0.2 * float(response[0])


@pytest.mark.thorough
def test_paces_are_drawn_around_the_measured_ones() -> None:
    batch = measured("crowd", 2, 20.0)
    x = sample(model("crowd"), batch, Noise(0.0, 1.0, 0.0, 0.2), 500, seed=0).x
    x = x.unflatten(1, (500, 2))
    speed = (x[-1] - x[-50])[..., 0] / (49 * STEP)  # tau of the relaxation is half a second
    share = (speed / batch.v[0, :, :, 0]).numpy()
    assert share.mean() == pytest.approx(1.0, abs=0.01)
    assert share.std() == pytest.approx(0.2, rel=0.03)
    assert share.min() > SLOWEST - 1e-6


def test_who_is_asked_for_a_pace() -> None:
    batch, differ = measured("crowd", 2, 8.0), {"name": "walker_heterogeneity", "sigma": 0.3}
    assert allows_driver_differences(model("crowd"), batch)
    assert not allows_driver_differences(model("crowd", desired="last"), batch)
    assert not allows_driver_differences(model("crowd", differ), batch)
    for domain in DOMAINS:
        assert not allows_driver_differences(constant_speed(domain), measured(domain, 1, 5.0))


def test_a_sequence_that_has_ended_stands_still() -> None:
    long, short = measured("crowd", 1, 8.0), measured("crowd", 1, 8.0, seed=1)
    valid = torch.cat([long.valid, short.valid], 1)
    valid[40:, 1] = False
    batch = replace(long.select([0, 0]), valid=valid, names=("a", "b"))
    x = sample(model("crowd"), batch, Noise(0.5, 1.0), 1, seed=0).x
    assert float((x[41:, 1] - x[40, 1]).abs().max()) < 0.2  # what is left of a step
    assert torch.equal(x[41:, 1], x[41:42, 1].expand(40, -1, -1))
    assert float((x[80, 0] - x[40, 0]).abs().max()) > 1.0


@pytest.mark.parametrize(
    ("domain", "seconds", "shortest"), [("traffic", 2.0, "3"), ("crowd", 0.6, r"0\.75")]
)
def test_bad_input_is_refused(domain: str, seconds: float, shortest: str) -> None:
    with pytest.raises(DataError, match=f"more than {shortest} s"):
        fit_noise(model(domain), [measured(domain, 2, seconds)], np.arange(2))
    with pytest.raises(ConfigError, match="positive time"):
        Noise(0.1, 0.0)
