"""People: the push has two components, and is found again in what was sampled with it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nnode.app.python.inputs import model_options
from nnode.data.sequence import Batch, collate
from nnode.errors import DataError
from nnode.generate.fit import fit_noise
from nnode.generate.noise import (
    Noise,
    allows_driver_differences,
    constant_speed,
    free_running,
    sample,
)
from nnode.generate.people import SLOWEST
from nnode.generate.scores import band, nearest
from nnode.model import Crowd, System, build_model
from nnode.simulation import TorchdiffeqSolver
from tests.builders import straight

STEP = 0.1


def walking(*effects: dict[str, object], desired: str = "direction") -> System:
    return free_running(
        build_model({**model_options("sf"), "desired": desired, "effects": list(effects)})
    )


def groups(number: int, seconds: float, people: int = 4, seed: int = 0) -> Batch:
    """People abreast who walk straight on at speeds of their own."""
    rng, found = np.random.default_rng(seed), []
    abreast = np.stack([np.zeros(people), 1.5 * np.arange(people)], -1)
    for i in range(number):
        speed = 1.3 + 0.1 * rng.normal(size=people)
        v = np.stack([speed, 0 * speed], -1)
        found.append(straight(abreast, v, round(seconds / STEP) + 1, STEP, name=f"s{i}"))
    return collate(found)


def test_both_components_are_autoregressive_in_any_step() -> None:
    noise, batch = Noise(0.4, 2.0), groups(1, 20.0, people=2)
    for dt in (0.1, 0.05):
        v = sample(constant_speed("crowd"), batch, noise, 2000, seed=1, dt=dt).v
        assert v is not None
        push = torch.diff(v, dim=0).numpy() / STEP
        # the mean of a push over a step of 0.1 s
        steps = round(STEP / dt)
        kept = math.exp(-dt / noise.tau)
        same = sum(kept ** abs(i - j) for i in range(steps) for j in range(steps)) / steps**2
        size = noise.sigma * math.sqrt(same)
        np.testing.assert_allclose(push.std((0, 1, 2)), size, rtol=0.02)
        later = (push[20:] * push[:-20]).mean((0, 1, 2)) / push.var((0, 1, 2))
        np.testing.assert_allclose(later, math.exp(-1.0) / same, atol=0.03)
        assert abs((push[..., 0] * push[..., 1]).mean()) < 0.02 * size**2


def test_no_noise_is_the_solver_s_motion() -> None:
    batch, model = groups(3, 8.0), walking()
    plain = TorchdiffeqSolver("euler", dt=0.05)(model, batch)
    found = sample(model, batch, Noise(0.0, 1.0), 2, seed=0, dt=0.05)
    torch.testing.assert_close(found.x[:, :3], plain.x)
    torch.testing.assert_close(found.x[:, 3:], plain.x)


def test_who_is_asked_for_a_pace() -> None:
    batch = groups(2, 8.0)
    assert allows_driver_differences(walking(), batch)
    assert not allows_driver_differences(walking(desired="last"), batch)
    assert not allows_driver_differences(constant_speed("crowd"), batch)
    differ = walking({"name": "walker_heterogeneity", "sigma": 0.3})
    assert not allows_driver_differences(differ, batch)


def test_paces_are_drawn_around_the_measured_ones() -> None:
    batch = groups(2, 20.0)
    x = sample(walking(), batch, Noise(0.0, 1.0, 0.0, 0.2), 500, seed=0).x.unflatten(1, (500, 2))
    speed = (x[-1] - x[-50])[..., 0] / (49 * STEP)  # tau of the relaxation is half a second
    share = (speed / batch.v[0, :, :, 0]).numpy()
    assert share.mean() == pytest.approx(1.0, abs=0.01)
    assert share.std() == pytest.approx(0.2, rel=0.03)
    assert share.min() > SLOWEST - 1e-6


def test_a_sequence_that_has_ended_stands_still() -> None:
    long, short = groups(1, 8.0), groups(1, 8.0, seed=1)
    valid = torch.cat([long.valid, short.valid], 1)
    valid[40:, 1] = False
    batch = replace(long.select([0, 0]), valid=valid, names=("a", "b"))
    x = sample(walking(), batch, Noise(0.5, 1.0), 1, seed=0).x
    assert float((x[41:, 1] - x[40, 1]).abs().max()) < 0.2  # what is left of a step
    assert torch.equal(x[41:, 1], x[41:42, 1].expand(40, -1, -1))
    assert float((x[80, 0] - x[40, 0]).abs().max()) > 1.0


@pytest.mark.parametrize("noise", [Noise(0.4, 1.5, 0.0001), Noise(0.3, 0.8, 0.0, 0.15)])
def test_noise_is_found_again(noise: Noise) -> None:
    batch = groups(40, 12.0, seed=3)
    truth = sample(walking(), batch, noise, 1, seed=3)
    assert truth.v is not None
    error = noise.measurement**0.5 * np.random.default_rng(3).normal(size=truth.x.shape)
    error[0] = 0.0
    seen = replace(batch, x=truth.x + torch.from_numpy(error), v=truth.v, preferred=batch.v[0])
    found = fit_noise(walking(), [seen], np.arange(40), seed=2)
    assert found.sigma is not None
    assert found.tau is not None
    assert found.drivers is not None
    assert found.sigma[0] < noise.sigma < found.sigma[1]
    assert found.tau[0] < noise.tau < found.tau[1]
    if noise.drivers:
        assert found.drivers[0] < noise.drivers < found.drivers[1]
    else:
        assert found.noise.drivers < 0.05
    assert found.noise.measurement == pytest.approx(noise.measurement, rel=0.1, abs=1e-6)


def test_bands_cover_what_was_sampled_from_the_model_itself() -> None:
    noise, samples, number = Noise(0.3, 1.5, 0.0, 0.1), 39, 60
    batch = groups(number, 8.0, people=2, seed=1)
    truth = sample(walking(), batch, noise, 1, seed=7).x
    drawn = sample(walking(), batch, noise, samples, seed=8).x.unflatten(1, (samples, number))
    inside = []
    for k in (20, 50, 80):
        low, high = band(drawn[k, :, :, 0].numpy(), 0.95)
        value = truth[k, :, 0].numpy()
        inside.append((low <= value) & (value <= high))
    # of 60 independent people, components and times taken as one another's copies at worst
    assert abs(np.mean(inside) - 0.95) < 3 * math.sqrt(0.95 * 0.05 / number)


def test_the_nearest_other() -> None:
    x = np.array([[[0.0, 0.0], [3.0, 4.0], [0.0, 1.0]]])
    np.testing.assert_allclose(nearest(x), [[1.0, np.hypot(3, 3), 1.0]])
    assert nearest(x[:, :1]).shape == (1, 0)


def test_what_is_refused() -> None:
    with pytest.raises(DataError, match=r"people|more than 0\.75 s"):
        fit_noise(walking(), [groups(2, 0.6)], np.arange(2))
    assert isinstance(free_running(build_model({**model_options("sf")})), Crowd)
