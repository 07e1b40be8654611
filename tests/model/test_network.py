"""The network of Definition 2 against its formula in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from nnode.model import FeedForward


def by_definition(network: FeedForward, x: np.ndarray) -> np.ndarray:
    """Definition 2 for rows of inputs."""
    *hidden, (w, b) = [
        [p.detach().numpy() for p in (layer.weight, layer.bias)] for layer in network.layers
    ]
    for weight, bias in hidden:
        x = np.log(1 + np.exp(x @ weight.T + bias))
    return x @ w.T + b


@pytest.mark.parametrize("sizes", [(1, 4, 1), (4, 4, 2), (4, 5, 2), (3, 2, 6, 2), (2, 1)])
def test_forward(sizes: tuple[int, ...]) -> None:
    network = FeedForward(sizes, torch.Generator().manual_seed(3))
    x = np.random.default_rng(0).normal(0, 3, (5, 7, sizes[0]))
    output = network(torch.from_numpy(x)).detach()
    np.testing.assert_allclose(output, by_definition(network, x), rtol=0, atol=1e-8)


def test_initial_weights_are_uniform_on_minus_one_to_one() -> None:
    network = FeedForward((20, 60, 20), torch.Generator().manual_seed(11))
    for layer in network.layers:
        for weight in (layer.weight, layer.bias):
            sample = weight.detach().numpy().ravel()
            assert stats.kstest(sample, stats.uniform(-1, 2).cdf).pvalue > 1e-3
    everything = torch.cat([p.flatten() for p in network.parameters()]).detach().numpy()
    assert stats.kstest(everything, stats.uniform(-1, 2).cdf).pvalue > 1e-3
    assert np.unique(everything).size == everything.size


def test_weights_are_drawn_in_double_precision() -> None:
    """The default precision of PyTorch does not matter."""
    usual = FeedForward((1, 4, 1), torch.Generator().manual_seed(5)).layers[0].weight
    torch.set_default_dtype(torch.float64)
    try:
        double = FeedForward((1, 4, 1), torch.Generator().manual_seed(5)).layers[0].weight
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(usual, double)
    assert not torch.equal(usual, usual.float().double())


@pytest.mark.parametrize("sizes", [(1,), (1, 0, 1), ()])
def test_invalid_sizes(sizes: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="at least two layers"):
        FeedForward(sizes)
