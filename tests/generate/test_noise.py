"""The push is an autoregressive process, and is found again in what was sampled with it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from nnode.app.python.inputs import model_options
from nnode.data.sequence import Batch, collate
from nnode.errors import ConfigError, DataError
from nnode.generate.fit import fit_noise
from nnode.generate.noise import (
    Noise,
    allows_driver_differences,
    constant_speed,
    free_running,
    sample,
)
from nnode.generate.scores import band
from nnode.model import Traffic, build_model
from nnode.model.laws import make_law
from nnode.model.term import State, Term
from nnode.simulation import TorchdiffeqSolver
from tests.app.following import TRUE, platoon
from tests.builders import lane
from tests.simulation.fused.compare import RungeKutta

STEP = 0.1


def idm(*effects: dict[str, object]) -> Traffic:
    model = build_model({**model_options("idm", "measured"), "effects": list(effects)})
    for name, value in TRUE.items():
        getattr(model.terms[0], name).data.fill_(value)
    return free_running(model)


def platoons(number: int, seconds: float, cars: int = 3, seed: int = 0) -> Batch:
    rng, found = np.random.default_rng(seed), []
    for i in range(number):
        x, v = platoon(rng, cars, seconds)
        found.append(lane(x, STEP, v=v, name=f"s{i}", length=4.5))
    return collate(found)


def test_the_push_is_autoregressive_in_any_step() -> None:
    noise = Noise(0.4, 2.0)
    batch = platoons(1, 20.0, cars=2)
    batch = replace(batch, v=0 * batch.v + 20.0)
    for dt in (0.1, 0.05):
        v = sample(constant_speed(), batch, noise, 3000, seed=1, dt=dt).v
        assert v is not None
        push = torch.diff(v[:, :, 0, 0], dim=0).numpy() / 0.1
        # the mean of a push over a step of 0.1 s
        rate, span = 1 / noise.tau, 0.1
        steps = round(span / dt)
        kept = math.exp(-dt * rate)
        same = sum(kept ** abs(i - j) for i in range(steps) for j in range(steps)) / steps**2
        assert push.std() == pytest.approx(noise.sigma * math.sqrt(same), rel=0.02)
        later = (push[20:] * push[:-20]).mean() / push.var()
        assert later == pytest.approx(math.exp(-2.0 * rate) / same, abs=0.03)


def test_a_push_stops_a_vehicle_and_does_not_turn_it() -> None:
    options = {**model_options("lin", "measured"), "v0": 2.0}
    # gaps at which the law by itself stops nobody
    batch = platoons(4, 20.0)
    batch = replace(batch, x=batch.x + 1000.0 * torch.arange(3)[:, None])
    x = sample(free_running(build_model(options)), batch, Noise(3.0, 1.0), 5, seed=0, dt=0.1).x
    steps = torch.diff(x[:, :, :2, 0], dim=0)
    assert float(steps.min()) >= -1e-12
    assert float((steps == 0).double().mean()) > 0.1


class Nothing(Term):
    """A term that is Python code, so that the model has no formula."""

    name = "nothing"

    def forward(self, state: State) -> torch.Tensor:
        return torch.zeros_like(state.x)


def test_a_model_that_is_code_is_sampled_as_its_formula() -> None:
    batch, noise = platoons(3, 10.0), Noise(0.5, 2.0, 0.0, 0.1)
    by_formula = Traffic([make_law("lin", v0=25.0, L=6.0, L_min=0.0)], "measured")
    by_code = Traffic([make_law("lin", v0=25.0, L=6.0, L_min=0.0), Nothing()], "measured")
    assert by_code.formula is None
    assert allows_driver_differences(by_code, batch)
    one, two = (sample(m, batch, noise, 3, seed=0, dt=0.05).x for m in (by_formula, by_code))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-9)


@cache
def sampled(noise: Noise, number: int, seed: int) -> Batch:
    """Platoons that drive with a noise."""
    batch = platoons(number, 60.0, seed=seed)
    found = sample(idm(), batch, noise, 1, seed=seed)
    assert found.v is not None
    error = noise.measurement**0.5 * np.random.default_rng(seed).normal(size=found.x.shape)
    error[0] = 0.0
    error[:, :, -1] = 0.0
    return replace(batch, x=found.x + torch.from_numpy(error), v=found.v)


@pytest.mark.parametrize(
    "noise",
    [
        pytest.param(Noise(0.3, 1.5, 0.0025), marks=pytest.mark.thorough),
        Noise(0.2, 2.0, 0.0, 0.2),
    ],
)
def test_noise_is_found_again(noise: Noise) -> None:
    batch = sampled(noise, 24, 5)
    found = fit_noise(idm(), [batch], np.arange(24), seed=2)
    assert found.sigma is not None
    assert found.tau is not None
    assert found.drivers is not None
    assert found.sigma[0] < noise.sigma < found.sigma[1]
    assert found.tau[0] < noise.tau < found.tau[1]
    # the size is well known, its time from so few vehicles to a factor
    assert found.sigma[1] < 1.5 * found.sigma[0]
    assert 0.5 < found.noise.tau / noise.tau < 2
    if noise.drivers:
        assert found.drivers[0] < noise.drivers < found.drivers[1]
    else:
        assert found.noise.drivers < 0.05
    # leaders are exact: one vehicle in three
    assert found.noise.measurement == pytest.approx(noise.measurement * 2 / 3, rel=0.1, abs=1e-6)


def test_bands_cover_what_was_sampled_from_the_model_itself() -> None:
    noise, samples = Noise(0.3, 1.5), 39
    batch = platoons(60, 30.0, cars=2, seed=1)
    truth = sample(idm(), batch, noise, 1, seed=7).x
    drawn = sample(idm(), batch, noise, samples, seed=8).x.unflatten(1, (samples, 60))
    inside = 0
    for k in (50, 150, 300):
        low, high = band(drawn[k, :, :, 0, 0].numpy(), 0.95)
        value = truth[k, :, 0, 0].numpy()
        inside += int(((low <= value) & (value <= high)).sum())
    # of 60 independent vehicles at three times; taken as one another's copies at worst
    assert abs(inside / 180 - 0.95) < 3 * math.sqrt(0.95 * 0.05 / 60)


def test_no_noise_is_the_solver_s_motion() -> None:
    batch = platoons(3, 20.0)
    model = idm()
    assert model.step == "rk4"
    plain = RungeKutta()(model, batch)
    found = sample(model, batch, Noise(0.0, 1.0), 2, seed=0)
    torch.testing.assert_close(found.x[:, :3], plain.x)
    torch.testing.assert_close(found.x[:, 3:], plain.x)
    plain = TorchdiffeqSolver("ballistic")(model, batch)
    found = sample(model, batch, Noise(0.0, 1.0), 1, seed=0, method="ballistic")
    torch.testing.assert_close(found.x, plain.x)


def test_the_same_seed_gives_the_same_samples() -> None:
    batch, noise = platoons(2, 5.0), Noise(0.3, 1.0)
    one, two, three = (sample(idm(), batch, noise, 2, seed=s).x for s in (1, 1, 2))
    assert torch.equal(one, two)
    assert not torch.equal(one, three)


def test_unknown_drivers_are_drawn_and_known_ones_are_kept() -> None:
    batch = platoons(2, 20.0)
    people = {"s0": [0.0, 0.0, 0.0]}
    model = idm({"name": "driver_heterogeneity", "sigma": 0.3, "people": people})
    x = sample(model, batch, Noise(0.0, 1.0), 200, seed=0).x.unflatten(1, (200, 2))
    spread = x[-1, :, :, 0, 0].std(0)
    assert float(spread[0]) == 0.0
    assert float(spread[1]) > 1.0


def test_bad_input_is_refused() -> None:
    with pytest.raises(ConfigError, match="positive time"):
        Noise(0.1, 0.0)
    assert not allows_driver_differences(constant_speed(), platoons(1, 5.0))
    with pytest.raises(DataError, match="more than 3 s"):
        fit_noise(idm(), [platoons(2, 2.0)], np.arange(2))
