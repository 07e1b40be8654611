"""The network of Definition 2, against its formula written out in numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from nnode.model import FeedForward


def by_definition(x: np.ndarray, weights: list[np.ndarray]) -> list[float]:
    """Definition 2 unit by unit; ``weights[l][j, k]`` leads from unit j (0: bias) to unit k."""
    a = [1.0, *x]
    for w in weights[:-1]:
        a = [1.0] + [
            np.log(1 + np.exp(sum(w[j, k] * a[j] for j in range(len(a)))))
            for k in range(w.shape[1])
        ]
    w = weights[-1]
    return [sum(w[j, k] * a[j] for j in range(len(a))) for k in range(w.shape[1])]


def weight_matrices(network: FeedForward) -> list[np.ndarray]:
    """The paper's matrices: the bias unit's row on top of the neurons' rows."""
    return [
        np.vstack([layer.bias.detach().numpy(), layer.weight.detach().numpy().T])
        for layer in network.layers
    ]


@pytest.mark.parametrize("sizes", [(1, 4, 1), (4, 4, 2), (4, 5, 2), (3, 2, 6, 2), (2, 1)])
def test_forward_is_definition_2(sizes: tuple[int, ...]) -> None:
    network = FeedForward(sizes, torch.Generator().manual_seed(3))
    inputs = np.random.default_rng(0).normal(0, 3, (5, 7, sizes[0]))
    out = network(torch.from_numpy(inputs)).detach().numpy()
    weights = weight_matrices(network)
    expected = [[by_definition(x, weights) for x in row] for row in inputs]
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-8)


def test_initial_weights_are_uniform_on_minus_one_to_one() -> None:
    network = FeedForward((20, 60, 20), torch.Generator().manual_seed(11))
    for layer in network.layers:
        for weight in (layer.weight, layer.bias):
            sample = weight.detach().numpy().ravel()
            assert stats.kstest(sample, stats.uniform(-1, 2).cdf).pvalue > 1e-3
    everything = torch.cat([p.flatten() for p in network.parameters()]).detach().numpy()
    assert stats.kstest(everything, stats.uniform(-1, 2).cdf).pvalue > 1e-3
    assert np.unique(everything).size == everything.size


def test_weights_are_drawn_in_double_precision_whatever_the_default() -> None:
    usual = FeedForward((1, 4, 1), torch.Generator().manual_seed(5)).layers[0].weight
    torch.set_default_dtype(torch.float64)
    try:
        double = FeedForward((1, 4, 1), torch.Generator().manual_seed(5)).layers[0].weight
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(usual, double)
    assert not torch.equal(usual, usual.float().double())


@pytest.mark.parametrize("sizes", [(1,), (1, 0, 1), ()])
def test_impossible_layers_are_refused(sizes: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="at least two layers"):
        FeedForward(sizes)
