"""The calibrated parameters of a model as one vector."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from nnode.model.system import System
from nnode.model.term import Interval


class ParameterVector:
    """The parameters of a model that need a gradient, one number after the other.

    Vectors are in float64, whatever the precision of the model.

    Args:
        system: the model.
        places: of each of the K numbers the parameter's name and the place in the flattened
            parameter; None: all of them, in the order of ``system.named_parameters()``.

    Attributes:
        parameters: those that need a gradient, by name.
        names: K names, of the parameter that each number belongs to.
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
        """``(K,)`` their values."""
        return self._flat()[self._order]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """``(K,)`` lower and upper ends of what is admissible; infinite where it is open."""
        limits, free = self.system.bounds(), Interval()
        known = [limits.get(name, free) for name in self.names]
        return np.array([b.low for b in known]), np.array([b.high for b in known])

    def runs(self, rows: Tensor | np.ndarray) -> dict[str, Tensor]:
        """Rows ``(R, K)`` as parameters by name, each with a leading axis of R runs, in the
        model's precision. Numbers that are not in the vector are the model's own."""
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
        own = [p.detach().double().flatten() for p in self.parameters.values()]
        return torch.cat(own) if own else torch.zeros(0, dtype=torch.float64)
