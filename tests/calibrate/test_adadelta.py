"""NoisyAdadelta against a scalar loop and torch's ADADELTA, and the statistics of its noise."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor, nn

from nnode.calibrate.optimizers.adadelta import NoisyAdadelta


def parameter(*values: float) -> nn.Parameter:
    return nn.Parameter(torch.tensor(values, dtype=torch.float64))


def scalar_adadelta(u: float, gradients: list[float], rho: float, eps: float) -> list[float]:
    """Section 4.2 for one weight, with the current gradient in E[g²], without noise."""
    mean_g2 = mean_d2 = 0.0
    path = []
    for g in gradients:
        mean_g2 = rho * mean_g2 + (1 - rho) * g**2
        step = -math.sqrt(mean_d2 + eps) / (math.sqrt(mean_g2) + eps) * g
        mean_d2 = rho * mean_d2 + (1 - rho) * step**2
        u += step
        path.append(u)
    return path


def descend(optimizer: torch.optim.Optimizer, p: nn.Parameter, gradients: np.ndarray) -> Tensor:
    path = []
    for g in gradients:
        p.grad = torch.as_tensor(g, dtype=p.dtype).reshape(p.shape)
        optimizer.step()
        path.append(p.detach().clone())
    return torch.stack(path)


def path_of(gradients: np.ndarray, *start: float, **options: Any) -> Tensor:
    """The path without noise."""
    p = parameter(*start)
    return descend(NoisyAdadelta([p], eta1=0.0, **options), p, gradients)


GRADIENTS = np.random.default_rng(0).normal(3.0, 20.0, (60, 3))
START = [1.0, -2.0, 30.0]


@pytest.mark.parametrize(("rho", "eps"), [(0.95, 1e-6), (0.5, 1e-2)])
def test_noiseless_steps_equal_a_scalar_loop(rho: float, eps: float) -> None:
    path = path_of(GRADIENTS, *START, rho=rho, eps=eps)
    for i, start in enumerate(START):
        expected = scalar_adadelta(start, list(GRADIENTS[:, i]), rho, eps)
        np.testing.assert_allclose(path[:, i], expected, rtol=1e-13)


def test_lr_scales_the_step() -> None:
    full, half = (path_of(GRADIENTS[:1, :1], 0.0, lr=lr) for lr in (1.0, 0.5))
    torch.testing.assert_close(half, 0.5 * full)


def test_steps_equal_torch_adadelta_for_vanishing_eps() -> None:
    # torch uses sqrt(E[g²] + eps), the paper sqrt(E[g²]) + eps; with eps = 1e-30 and
    # E[g²] >> 1e-15 both equal sqrt(E[g²]) to the last digit
    path, p = path_of(GRADIENTS, *START, rho=0.9, eps=1e-30), parameter(*START)
    expected = descend(torch.optim.Adadelta([p], lr=1.0, rho=0.9, eps=1e-30), p, GRADIENTS)
    torch.testing.assert_close(path, expected, rtol=1e-12, atol=0)


def noise_of_step(n: int, k: int, **options: Any) -> np.ndarray:
    """The n noise values that are added to a zero gradient in step k."""
    p = nn.Parameter(torch.zeros(n, dtype=torch.float64))
    optimizer = NoisyAdadelta([p], **options)
    for _ in range(k + 1):
        square = optimizer.state[p].get("square", torch.zeros(n)).clone()
        before = p.detach().clone()
        p.grad = torch.zeros_like(p)
        optimizer.step()
    rho = options.get("rho", 0.95)
    size = ((optimizer.state[p]["square"] - rho * square) / (1 - rho)).clamp(min=0).sqrt()
    return (size * torch.sign(before - p.detach())).numpy()


@pytest.mark.parametrize("k", [0, 1, 7])
@pytest.mark.parametrize(("eta1", "eta2"), [(1.0, 0.55), (4.0, 1.5), (0.3, 0.0)])
def test_noise_is_normal_with_decaying_variance(k: int, eta1: float, eta2: float) -> None:
    n = 20_000
    noise = noise_of_step(n, k, eta1=eta1, eta2=eta2, seed=2)
    variance = eta1 / (1 + k) ** eta2
    # the sample variance of n normal numbers has a relative standard error of sqrt(2 / n)
    assert np.mean(noise**2) == pytest.approx(variance, rel=5 * math.sqrt(2 / n))
    assert stats.kstest(noise, stats.norm(0, math.sqrt(variance)).cdf).pvalue > 1e-3


def test_noise_is_reported() -> None:
    p = parameter(1.0)
    optimizer = NoisyAdadelta([p], eta1=4.0, eta2=0.5)
    descend(optimizer, p, GRADIENTS[:9, :1])
    assert optimizer.noise == pytest.approx(math.sqrt(4.0 / 9**0.5))


def test_weights_get_independent_noise() -> None:
    first, second = np.split(noise_of_step(20_000, 0), 2)
    assert abs(np.corrcoef(first, second)[0, 1]) < 5 / math.sqrt(10_000)


def test_noise_depends_on_the_seed_and_not_on_the_precision() -> None:
    first, repeated, other = (noise_of_step(50, 1, seed=s) for s in (3, 3, 4))
    np.testing.assert_array_equal(first, repeated)
    assert not np.allclose(first, other)
    p, q = (nn.Parameter(torch.zeros(50, dtype=dtype)) for dtype in (torch.float32, torch.float64))
    single, double = (descend(NoisyAdadelta([x], seed=3), x, np.zeros((1, 50))) for x in (p, q))
    torch.testing.assert_close(single.double(), double, rtol=1e-6, atol=0)


def stored(state: dict[str, Any]) -> dict[str, Any]:
    """The state after a round trip through a file without code."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_resume_is_bit_identical(dtype: torch.dtype) -> None:
    p = nn.Parameter(torch.tensor(START, dtype=dtype))
    optimizer = NoisyAdadelta([p], seed=5)
    descend(optimizer, p, GRADIENTS[:20])
    q = nn.Parameter(p.detach().clone())
    resumed = NoisyAdadelta([q], lr=0.3, eta1=9.0, seed=77)
    resumed.load_state_dict(stored(optimizer.state_dict()))
    assert torch.equal(descend(optimizer, p, GRADIENTS[20:]), descend(resumed, q, GRADIENTS[20:]))
    assert resumed.noise == optimizer.noise


def test_descent_into_the_minimum_of_a_quadratic() -> None:
    target = torch.tensor([3.0, -1.0], dtype=torch.float64)
    stiffness = torch.tensor([1.0, 50.0], dtype=torch.float64)
    p = parameter(0.0, 0.0)
    optimizer = NoisyAdadelta([p], eps=1e-4, seed=0)
    costs = []

    def closure() -> Tensor:
        optimizer.zero_grad()
        cost = 0.5 * (stiffness * (p - target) ** 2).sum()
        cost.backward()
        return cost

    for _ in range(3000):
        cost = optimizer.step(closure)
        assert cost is not None
        costs.append(cost.item())
    assert costs[0] == pytest.approx(0.5 * (9 + 50))
    assert np.mean(costs[-100:]) < 0.03 * costs[0]


def test_parameter_without_gradient_is_unchanged() -> None:
    p, q = parameter(1.0), parameter(2.0)
    optimizer = NoisyAdadelta([p, q])
    p.grad = torch.ones_like(p)
    optimizer.step()
    assert p.item() != 1.0
    assert q.item() == 2.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lr", 0.0),
        ("lr", math.nan),
        ("rho", 1.0),
        ("rho", 0.0),
        ("eps", 0.0),
        ("eta1", -1.0),
        ("eta2", -0.1),
    ],
)
def test_options_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        NoisyAdadelta([parameter(1.0)], **{name: value})
