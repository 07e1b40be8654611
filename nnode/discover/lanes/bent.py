"""A lane's formula with a curve on top of it: the flexible fit of what a formula leaves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from nnode.discover.lanes.motion import Motion, Slopes, Values, formula_of
from nnode.discover.lanes.side_by_side import AtSamples, repeated
from nnode.discover.residuals.variables import Curve
from nnode.model.scene import Scene
from nnode.model.system import System, Traffic
from nnode.model.term import State


class Bent(Motion):
    """A motion whose last term is a curve, which acts on all followers.

    Args:
        base: the model without it.
        every: the surroundings of all simulations, see :mod:`nnode.discover.lanes.side_by_side`.

    Attributes:
        scale: of the curve, a number or ``(R, 1)``.
    """

    def __init__(
        self,
        base: System,
        curve: Curve,
        scene: Scene,
        every: Callable[[], Scene],
        parameters: Mapping[str, Tensor] | None = None,
    ) -> None:
        super().__init__(base, scene, parameters)
        self.curve, self.name, self.every = curve, f"terms.{len(base.terms)}.scale", every()
        scale = (parameters or {}).get(self.name, curve.scale.detach())
        self.scale = scale.numpy()[..., None] if scale.ndim else np.float64(scale.item())

    def rates(self, y: np.ndarray, given: Values) -> np.ndarray:
        found = super().rates(y, given)
        value = self.seen(*self.simulations(y, found), given["t"])[1]
        bend = self.curve.variable.curve(value, self.curve.amounts.numpy())[0]
        found[self.top, :-1] += np.where(self.follows, self.scale * bend[:-1], 0.0)
        return found

    def simulations(self, y: np.ndarray, rates: np.ndarray) -> tuple[Tensor, Tensor]:
        """Places and speeds ``(S, N, 1)`` of all simulations."""
        x, rate = (torch.from_numpy(one.reshape(len(one), -1)) for one in (y[0], rates[0]))
        return x.T[..., None], rate.T[..., None]

    def seen(self, x: Tensor, rate: Tensor, t: Any) -> tuple[Tensor, np.ndarray]:
        """What the curve depends on: ``(S, N)``, and the same as ``(N, L, B)``."""
        sequences = self.follows.shape[2]
        # one time for all runs, or one for each simulation
        time = torch.as_tensor(t, dtype=torch.float64)
        if time.ndim:
            time = time.expand(-1, sequences).flatten()
        speed = rate if self.top else None
        state = State(time, x, speed, self.every, rate=rate)
        found = self.curve.variable.value(state)
        return found, found.detach().numpy().T.reshape(x.shape[1], -1, sequences)


def motion_of(
    system: System, scene: Scene, parameters: Mapping[str, Tensor] | None = None
) -> Motion | None:
    """A model's right-hand side in NumPy; None where a term is code.

    Args:
        parameters: of R runs, by name; None: of one run at all sampling times.
    """
    if formula_of(system) is not None:
        return Motion(system, scene, parameters)
    last = system.terms[-1] if len(system.terms) else None
    if type(system) is not Traffic or not isinstance(last, Curve):
        return None
    base = Traffic(cast(Any, list(system.terms)[:-1]), system.leader)
    if formula_of(base) is None:
        return None
    if parameters is None:
        return Bent(base, last, scene, lambda: AtSamples.along(scene))
    runs = len(next(iter(parameters.values())))
    return Bent(base, last, scene, lambda: repeated(scene, runs), parameters)


class Bend:
    """What a curve adds to the linearised equations along a run.

    Args:
        y, rates: ``(M, N, K, B)`` states, and rates without the curve.
        slopes: without the curve.

    Attributes:
        height: ``(N, K, B)`` of the curve, 0 for leaders.
        matrix: ``(M, N, M, N, K, B)`` derivatives of all rates by all states.
    """

    def __init__(self, motion: Bent, y: np.ndarray, rates: np.ndarray, t: Any, slopes: Slopes):
        x, rate = (one.clone().requires_grad_() for one in motion.simulations(y, rates))
        with torch.enable_grad():
            value, now = motion.seen(x, rate, t)
            sums = value.sum(0).unbind()
        height, slope = motion.curve.variable.curve(now, motion.curve.amounts.numpy())
        n = len(height)
        follows = np.concatenate([motion.follows, np.zeros_like(motion.follows[:1])])
        self.height = np.where(follows, height, 0.0)
        steep = np.where(follows, motion.scale * slope, 0.0)
        #: of each vehicle's curve by everybody's places and speeds
        self._by = np.zeros((2, n, n, *y.shape[2:]))
        for i in range(n) if value.requires_grad else ():
            both = torch.autograd.grad(sums[i], (x, rate), retain_graph=True, allow_unused=True)
            for part, found in zip(self._by, both, strict=True):
                if found is not None:
                    part[i] = steep[i] * found[..., 0].numpy().T.reshape(y.shape[1:])
        self.matrix = whole(slopes, y.shape)
        top = motion.top
        self.matrix[top] += np.einsum("ijkb,jqmkb->iqmkb", self._by[1], self.matrix[0])
        self.matrix[top, :, 0] += self._by[0]

    def passed_on(self, source: np.ndarray) -> np.ndarray:
        """``(N, K, B)`` what changes of the formula's speeds do by way of the curve."""
        found: np.ndarray = np.einsum("ijkb,jkb->ikb", self._by[1], source)
        return found


def whole(slopes: Slopes, shape: tuple[int, ...]) -> np.ndarray:
    """``(M, N, M, N, K, B)`` derivatives of all rates by all states.

    Args:
        shape: of the states, ``(M, N, K, B)``.
    """
    m, n = shape[:2]
    found = np.zeros((m, n, m, n, *shape[2:]))
    for i in range(n - 2, -1, -1):
        for part, ahead in ((slopes.own, 0), (slopes.first, 1), (slopes.second, 2)):
            for (p, q), slope in part.items():
                if i + ahead < n:
                    found[p, i, q, i + ahead] += slope[i]
        for p, slope in slopes.chain.items():
            found[p, i] += slope[i] * found[0, i + 1]
    return found
