"""The feed-forward network of Definition 2 of Göttlich & Totzeck."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn


class FeedForward(nn.Module):
    """Feed-forward network with softplus hidden layers and identity output.

    Input and hidden layers carry a bias unit, the output layer none: each layer of weights
    therefore has a bias. Softplus is log(1 + exp(x)). All weights start independent and
    uniform on [-1, 1], in float64.

    Args:
        sizes: neurons per layer without bias units, input first, e.g. ``(4, 4, 2)``.
        generator: source of the initial weights; None draws from torch's global one.

    Shapes:
        ``(..., sizes[0])`` to ``(..., sizes[-1])``; ``sum((n_l + 1) * n_{l+1})`` weights.

    Source:
        Göttlich & Totzeck, Definition 2 and section 5.4 (initial weights).
    """

    def __init__(self, sizes: tuple[int, ...], generator: torch.Generator | None = None) -> None:
        super().__init__()
        if len(sizes) < 2 or min(sizes) < 1:
            raise ValueError(f"a network needs at least two layers of one neuron, got {sizes}")
        self.sizes = tuple(sizes)
        self.layers = nn.ModuleList(
            nn.Linear(n_in, n_out, dtype=torch.float64) for n_in, n_out in pairwise(sizes)
        )
        self.reset_parameters(generator)

    @torch.no_grad()
    def reset_parameters(self, generator: torch.Generator | None = None) -> None:
        """Draw all weights anew, uniform on [-1, 1]."""
        for weight in self.parameters():
            # drawn in float64 so that a seed means the same start in every precision
            draw = torch.rand(weight.shape, generator=generator, dtype=torch.float64)
            weight.copy_(2 * draw - 1)

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers[:-1]:
            x = nn.functional.softplus(layer(x))
        out: Tensor = self.layers[-1](x)
        return out
