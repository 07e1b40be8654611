"""The calibrated parameters of a model as one vector."""

from __future__ import annotations

import copy
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from nnode.model.system import System
from nnode.model.term import Interval


class ParameterVector:
    """The parameters of a model that need a gradient, as a vector of K numbers.

    Vectors are float64 for every precision of the model.

    Args:
        system: the model.
        places: parameter's name and index in the flattened parameter for each of the K numbers;
            None takes all, in the order of ``system.named_parameters()``.

    Attributes:
        parameters: name to parameter that needs a gradient.
        names: the parameter's name for each of the K numbers.
    """

    def __init__(self, system: System, places: Iterable[tuple[str, int]] | None = None) -> None:
        self.system = system
        self.parameters = {n: p for n, p in system.named_parameters() if p.requires_grad}
        every = [(name, k) for name, p in self.parameters.items() for k in range(p.numel())]
        number = {place: i for i, place in enumerate(every)}
        self.places = every if places is None else list(places)
        self.names = [name for name, _ in self.places]
        self._order = [number[place] for place in self.places]

    @property
    def row(self) -> Tensor:
        """``(K,)`` values."""
        return self._flat()[self._order]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """``(K,)`` lower and upper bounds of the admissible set; infinite without a bound."""
        limits, free = self.system.bounds(), Interval()
        intervals = [limits.get(name, free) for name in self.names]
        return np.array([b.low for b in intervals]), np.array([b.high for b in intervals])

    def runs(self, rows: Tensor | np.ndarray) -> dict[str, Tensor]:
        """Name to the parameter's values with a leading axis of R runs, in the model's precision.

        Args:
            rows: ``(R, K)``. Numbers that are not in the vector keep the model's values.
        """
        rows = torch.as_tensor(rows)
        flat = self._flat().repeat(len(rows), 1)
        flat[:, self._order] = rows.to(flat)
        parts = flat.split([p.numel() for p in self.parameters.values()], 1)
        return {
            name: part.reshape(-1, *p.shape).to(p.dtype)
            for (name, p), part in zip(self.parameters.items(), parts, strict=True)
        }

    @torch.no_grad()
    def fill_(self, row: Tensor | np.ndarray) -> System:
        """Write a vector ``(K,)`` into the model and return it."""
        for name, value in self.runs(torch.as_tensor(row)[None]).items():
            self.parameters[name].copy_(value[0])
        return self.system

    def _flat(self) -> Tensor:
        values = [p.detach().double().flatten() for p in self.parameters.values()]
        return torch.cat(values) if values else torch.zeros(0, dtype=torch.float64)


def with_parameters(system: System, row: Tensor | np.ndarray) -> System:
    """A copy of a model whose parameters that need a gradient are a vector ``(K,)``."""
    return ParameterVector(copy.deepcopy(system)).fill_(row)
