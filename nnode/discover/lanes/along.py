"""Models at the states of one run, at all its sampling times at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call, vmap

from nnode.discover.lanes.bent import motion_of
from nnode.discover.lanes.motion import Leaders, Motion
from nnode.discover.lanes.side_by_side import AtSamples
from nnode.model.scene import Scene
from nnode.model.system import System
from nnode.model.term import State


class Along:
    """States of a run.

    Args:
        scene: the surroundings.
        states: ``(K, B, N, W)`` at the sampling times.
    """

    def __init__(self, scene: Scene, states: Tensor) -> None:
        self.scene, self.states = scene, states
        self.time = scene.dt * torch.arange(len(states), dtype=torch.float64)
        self._place, self._speed = Leaders(scene).samples

    def given(self, motion: Motion) -> tuple[np.ndarray, dict[str, Any]]:
        """States ``(M, N, K, B)``, and what a model's formulas name."""
        y = np.ascontiguousarray(self.states.permute(3, 2, 0, 1).numpy())
        y = motion.placed(y, self._place, self._speed)
        return y, motion.given(self.time.numpy()[:, None], y, self._speed)

    def rates(self, system: System) -> Tensor:
        """``(K, B, N, W)`` rates of a model of these states."""
        motion = motion_of(system, self.scene)
        if motion is None:
            with torch.no_grad():
                return self.by_code(system)(self.states)
        with np.errstate(all="ignore"):
            found = motion.rates(*self.given(motion))
        if motion.measured:
            np.copyto(found, 0.0, where=motion.leads)
        return torch.from_numpy(found).permute(2, 3, 1, 0)

    def by_code(
        self, system: System, parameters: dict[str, Tensor] | None = None
    ) -> Callable[[Tensor], Tensor]:
        """The rates as a function of the states, by PyTorch."""

        def one(t: Tensor, y: Tensor) -> Tensor:
            found: Tensor = functional_call(system, parameters or {}, (t, y, self.scene))
            return found

        return lambda states: vmap(one)(self.time, states)

    def state(self, system: System) -> State:
        """All times as simulations side by side, ``(K B, N, 1)``; measured leaders drive."""
        every = AtSamples.along(self.scene)
        lead = every.leader[..., None]
        x, rate = (one[..., :1].flatten(0, 1) for one in (self.states, self.rates(system)))
        x = torch.where(lead, every.measured[0], x)
        speed = torch.where(lead, every.measured_rate[0], rate)
        time = self.time[:, None].expand(-1, len(self.scene.agent)).flatten()
        return State(time, x, speed if system.order > 1 else None, every, rate=speed)
