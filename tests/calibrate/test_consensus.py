"""Consensus-based optimisation on costs whose minima are known."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from nnode.calibrate.optimizers.consensus import ConsensusBased

MINIMUM = torch.tensor([0.7, -0.4], dtype=torch.float64)
BAD_START = (3.6, -3.5)
#: spread and diffusion strong enough for a cost with many minima
WIDE = {"particles": 60, "spread": 1.0, "sigma": 2.0}


def rastrigin(p: Tensor) -> Tensor:
    """Minimum 0 at MINIMUM, with a local minimum near every whole-numbered step from it."""
    away = p - MINIMUM.to(p)
    return (away**2 + 10 * (1 - torch.cos(2 * math.pi * away))).sum()


def parameter(*values: float) -> nn.Parameter:
    return nn.Parameter(torch.tensor(values, dtype=torch.float64))


def minimise(
    optimizer: torch.optim.Optimizer, cost: Callable[[], Tensor], steps: int
) -> list[float]:
    def closure() -> Tensor:
        optimizer.zero_grad()
        value = cost()
        if torch.is_grad_enabled():
            value.backward()
        return value.detach()

    return [float(optimizer.step(closure)) for _ in range(steps)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_finds_the_global_minimum_where_adam_does_not(seed: int) -> None:
    p, q = parameter(*BAD_START), parameter(*BAD_START)
    minimise(torch.optim.Adam([q], lr=0.05), lambda: rastrigin(q), 500)
    costs = minimise(ConsensusBased([p], **WIDE, seed=seed), lambda: rastrigin(p), 150)
    assert rastrigin(q.detach()) > 5.0
    assert rastrigin(p.detach()) < 1e-2
    torch.testing.assert_close(p.detach(), MINIMUM, atol=0.02, rtol=0)
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] == rastrigin(p).item()


def test_the_start_itself_is_a_particle() -> None:
    p = parameter(*MINIMUM.tolist())
    assert minimise(ConsensusBased([p]), lambda: rastrigin(p), 1) == [0.0]
    assert torch.equal(p, MINIMUM)


def test_parameters_of_several_shapes() -> None:
    matrix = nn.Parameter(torch.full((2, 2), 4.0, dtype=torch.float64))
    number = nn.Parameter(torch.tensor(4.0, dtype=torch.float64))
    goal = torch.tensor([[1.0, 2.0], [3.0, 4.0]])

    def cost() -> Tensor:
        return (matrix - goal).square().sum() + (number + 1).square()

    optimizer = ConsensusBased([matrix, number], particles=80, spread=1.0, seed=0)
    minimise(optimizer, cost, 150)
    torch.testing.assert_close(matrix.detach(), goal.double(), atol=0.1, rtol=0)
    assert number.item() == pytest.approx(-1.0, abs=0.1)


def step_by_hand(x: np.ndarray, costs: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """One step of the dynamics with lambda = sigma = 1, dt = 0.1 (Pinnau et al. 2017)."""
    alpha = 30.0 / (np.median(costs) - costs.min())
    weights = np.exp(-alpha * (costs - costs.min()))
    mean = (weights[:, None] * x).sum(0) / weights.sum()
    drift = x - mean
    return x - 0.1 * drift + math.sqrt(0.1) * drift * noise


@pytest.mark.parametrize("offset", [0.0, 1e9])
def test_a_step_is_the_published_one(offset: float) -> None:
    # the weights depend on differences of the costs: a large common part changes nothing
    p = parameter(*BAD_START)
    optimizer = ConsensusBased([p], particles=7, sigma=1.0, seed=3)
    state = optimizer.state_dict()
    x = state["x"].numpy()
    costs = np.array([float(rastrigin(torch.from_numpy(row))) for row in x])
    generator = torch.Generator()
    generator.set_state(state["generator"])
    noise = torch.randn(x.shape, generator=generator, dtype=torch.float64).numpy()
    minimise(optimizer, lambda: rastrigin(p) + offset, 1)
    moved = optimizer.state_dict()["x"].numpy()
    expected = step_by_hand(x, costs, noise)
    np.testing.assert_allclose(moved, expected, rtol=1e-4 if offset else 1e-12)


@pytest.mark.parametrize("value", [float("inf"), float("nan")])
def test_particles_without_a_cost_do_not_count(value: float) -> None:
    p = parameter(*BAD_START)

    def cost() -> Tensor:
        inside = p[0] < 3.8
        return rastrigin(p) if inside else torch.tensor(value)

    optimizer = ConsensusBased([p], **WIDE, seed=0)
    costs = minimise(optimizer, cost, 150)
    assert all(math.isfinite(c) for c in costs)
    assert torch.isfinite(optimizer.state_dict()["x"]).all()
    assert rastrigin(p.detach()) < 1e-2


def test_particles_stay_together_where_nothing_has_a_cost() -> None:
    p = parameter(*BAD_START)
    optimizer = ConsensusBased([p], particles=20, sigma=0.0, seed=0)
    before = optimizer.state_dict()["x"].numpy()
    minimise(optimizer, lambda: torch.tensor(float("inf")), 1)
    after = optimizer.state_dict()["x"].numpy()
    # equal weights, no diffusion: everyone moves a tenth of the way to the mean
    np.testing.assert_allclose(after, before + 0.1 * (before.mean(0) - before), rtol=1e-12)
    assert torch.equal(p.detach(), torch.tensor(BAD_START, dtype=torch.float64))


def test_particles_of_equal_cost_drift_to_their_mean() -> None:
    p = parameter(*BAD_START)
    optimizer = ConsensusBased([p], particles=20, sigma=0.0, seed=0)
    before = optimizer.state_dict()["x"].numpy()
    minimise(optimizer, lambda: torch.tensor(45.3), 1)
    after = optimizer.state_dict()["x"].numpy()
    np.testing.assert_allclose(after, before + 0.1 * (before.mean(0) - before), rtol=1e-12)


def test_every_evaluated_particle_is_admissible() -> None:
    p = parameter(*BAD_START)
    seen = []

    @torch.no_grad()
    def project() -> None:
        p.clamp_(min=0.0)

    def cost() -> Tensor:
        seen.append(p.detach().clone())
        return rastrigin(p)

    minimise(ConsensusBased([p], **WIDE, project=project, seed=0), cost, 100)
    assert torch.stack(seen).min() == 0.0
    # the best admissible second coordinate is the border, not MINIMUM's -0.4
    least = min(float(rastrigin(torch.tensor([0.7, y]))) for y in np.linspace(0, 3, 3001))
    assert rastrigin(p).item() == pytest.approx(least, abs=0.05)


def stored(state: dict[str, Any]) -> dict[str, Any]:
    """The state after a round trip through a file that may hold nothing but data."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_resumed_run_continues_bit_for_bit(dtype: torch.dtype) -> None:
    p = nn.Parameter(torch.tensor(BAD_START, dtype=dtype))
    optimizer = ConsensusBased([p], particles=15, seed=5)
    minimise(optimizer, lambda: rastrigin(p), 8)
    q = nn.Parameter(p.detach().clone())
    resumed = ConsensusBased([q], particles=15, seed=77)
    resumed.load_state_dict(stored(optimizer.state_dict()))
    assert minimise(optimizer, lambda: rastrigin(p), 8) == minimise(
        resumed, lambda: rastrigin(q), 8
    )
    assert torch.equal(p, q)
    ours, theirs = optimizer.state_dict(), resumed.state_dict()
    assert torch.equal(ours["x"], theirs["x"])


def test_a_kept_state_does_not_change_with_the_run() -> None:
    p = parameter(*BAD_START)
    optimizer = ConsensusBased([p], particles=15)
    kept = optimizer.state_dict()
    copy = kept["x"].clone()
    minimise(optimizer, lambda: rastrigin(p), 3)
    assert torch.equal(kept["x"], copy)


def test_it_needs_a_closure() -> None:
    with pytest.raises(ValueError, match="closure"):
        ConsensusBased([parameter(1.0)]).step()


@pytest.mark.parametrize(
    "bad",
    [
        {"particles": 1},
        {"spread": 0.0},
        {"alpha": -1.0},
        {"drift": 0.0},
        {"sigma": -0.1},
        {"dt": 0.0},
        {"dt": float("nan")},
    ],
    ids=str,
)
def test_values_outside_their_range_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        ConsensusBased([parameter(1.0)], **bad)
