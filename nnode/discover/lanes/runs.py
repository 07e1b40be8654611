"""R runs of one model side by side: by its formula, or by PyTorch where a term is code."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch
from nnode.discover.lanes.bent import motion_of
from nnode.discover.lanes.motion import Leaders, Motion
from nnode.model.scene import Scene
from nnode.model.system import System, initial_with


class Runs(Protocol):
    """States and their rates are arrays of whatever kind."""

    def start(self, batch: Batch) -> Any:
        """At the first sample."""
        ...

    def rate(self, t: float, y: Any) -> Any:
        """Time derivative of the states at time ``t`` (s)."""
        ...

    def states(self, found: list[Any]) -> Tensor:
        """``(R, K, B, N, W)`` of K times."""
        ...


def side_by_side(system: System, rows: Tensor, scene: Scene) -> Runs:
    """Runs of a model with parameters ``(R, K)``, see
    :class:`~nnode.calibrate.parameters.ParameterVector`."""
    motion = motion_of(system, scene, ParameterVector(system).runs(rows))
    if motion is None:
        return _ByCode(system, rows, scene)
    return _ByFormula(system, rows, motion, Leaders(scene))


@torch.no_grad()
def _starts(system: System, rows: Tensor, batch: Batch) -> Tensor:
    """``(R, B, N, W)`` states at the start; what terms remember depends on the parameters."""
    if not system.memory:
        y = system.initial(batch)
        return y.expand(len(rows), *y.shape)
    every = ParameterVector(system).runs(rows)
    return torch.stack(
        [
            initial_with(system, {name: p[r] for name, p in every.items()}, batch)
            for r in range(len(rows))
        ]
    )


class _ByFormula:
    """States are ``(M, N, R, B)``; see :class:`Motion`."""

    def __init__(self, system: System, rows: Tensor, motion: Motion, leaders: Leaders) -> None:
        self._system, self._rows, self._motion, self._leaders = system, rows, motion, leaders

    def start(self, batch: Batch) -> np.ndarray:
        y = _starts(self._system, self._rows, batch).permute(3, 2, 0, 1)
        return np.ascontiguousarray(y.numpy())

    def rate(self, t: float, y: np.ndarray) -> np.ndarray:
        motion = self._motion
        place, speed = self._leaders.at(t)
        y = motion.placed(y, place, speed)
        found = motion.rates(y, motion.given(t, y, speed))
        if motion.measured:
            # a leader's state is never read: its place is known at every time
            np.copyto(found, 0.0, where=motion.leads)
        return found

    def states(self, found: list[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.stack(found)).permute(3, 0, 4, 2, 1).contiguous()


class _ByCode:
    """States are ``(R, B, N, W)``."""

    def __init__(self, system: System, rows: Tensor, scene: Scene) -> None:
        self._system, self._scene = system, scene
        self._parameters = ParameterVector(system).runs(rows)
        self._rows = rows

    def start(self, batch: Batch) -> Tensor:
        return _starts(self._system, self._rows, batch).clone()

    @torch.no_grad()
    def rate(self, t: float, y: Tensor) -> Tensor:
        time = torch.tensor(t, dtype=torch.float64)

        def one(parameters: dict[str, Tensor], y: Tensor) -> Tensor:
            found: Tensor = functional_call(self._system, parameters, (time, y, self._scene))
            return found

        found: Tensor = torch.func.vmap(one)(self._parameters, y)
        return found

    def states(self, found: list[Tensor]) -> Tensor:
        return torch.stack(found, 1)
