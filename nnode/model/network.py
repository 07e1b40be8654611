"""The feed-forward network of Definition 2 of Göttlich & Totzeck."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from nnode.errors import ConfigError
from nnode.model.expression import Expr, apply, symbol

#: Largest number of neurons of a layer. The paper's networks have 10. Formulas contain every
#: neuron.
NEURONS = 1000


class FeedForward(nn.Module):
    """Feed-forward network with softplus hidden layers and identity output.

    Input and hidden layers carry a bias unit, the output layer none: each layer of weights
    therefore has a bias. Softplus is log(1 + exp(x)). All weights start independent and
    uniform on [-1, 1], in float64.

    Args:
        sizes: neurons per layer without bias units, input first, e.g. ``(4, 4, 2)``.
        generator: source of the initial weights; None takes torch's global generator.

    Shapes:
        ``(..., sizes[0])`` to ``(..., sizes[-1])``; ``sum((n_l + 1) * n_{l+1})`` weights.

    Source:
        Göttlich & Totzeck, Definition 2 and section 5.4 (initial weights).
    """

    def __init__(self, sizes: tuple[int, ...], generator: torch.Generator | None = None) -> None:
        super().__init__()
        if len(sizes) < 2 or min(sizes) < 1:
            raise ValueError(f"a network needs at least two layers of one neuron, got {sizes}")
        if max(sizes) > NEURONS:
            raise ConfigError(
                f"a network with {max(sizes)} neurons in a layer is too large, expected at most "
                f"{NEURONS}"
            )
        self.sizes = tuple(sizes)
        self.layers = nn.ModuleList(
            nn.Linear(n_in, n_out, dtype=torch.float64) for n_in, n_out in pairwise(sizes)
        )
        for weight in self.parameters():
            # drawn in float64, so that a seed gives the same start in every precision
            draw = torch.rand(weight.shape, generator=generator, dtype=torch.float64)
            weight.data.copy_(2 * draw - 1)

    @torch.no_grad()
    def zero_output_(self) -> None:
        """Set the weights of the last layer to 0, so that the output is 0."""
        for weight in self.layers[-1].parameters():
            weight.zero_()

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers[:-1]:
            x = nn.functional.softplus(layer(x))
        out: Tensor = self.layers[-1](x)
        return out

    def written(
        self, inputs: Sequence[Expr], label: str, path: str
    ) -> tuple[list[Expr], dict[str, Any]]:
        """The outputs as formulas, neuron by neuron.

        Args:
            inputs: formulas of the inputs.
            label: prefix of the symbols of weights.
            path: prefix of the network in the model's named parameters.

        Returns:
            The outputs; and the weights' symbols to parameter name, index in the flattened
            parameter, and number of the parameter's axes.
        """
        owned: dict[str, Any] = {}
        values = list(inputs)
        for i, (n_in, n_out) in enumerate(pairwise(self.sizes)):
            last, layer = i == len(self.layers) - 1, []
            for u in range(n_out):
                total = symbol(f"{label}_b{i}_{u}")
                owned[f"{label}_b{i}_{u}"] = (f"{path}layers.{i}.bias", u, 1)
                for k in range(n_in):
                    weight = f"{label}_w{i}_{u}_{k}"
                    owned[weight] = (f"{path}layers.{i}.weight", u * n_in + k, 2)
                    total = total + symbol(weight) * values[k]
                layer.append(total if last else apply("softplus", total))
            values = layer
        return values, owned
