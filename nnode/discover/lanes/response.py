"""How simulated platoons respond to small changes, without simulating each of them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.func import functional_call, jvp, vmap

from nnode.data.sequence import Batch
from nnode.discover.residuals.engine import trained
from nnode.models.system import System, initial_with


class Response:
    """The linearised equations along the paths of one run.

    With A the derivative of the rates with respect to the states, a change s of the rates moves
    the states by d' = A d + s, d = 0 at the start. The trapezoidal rule solves this at the
    sampling times; rates at all times come from one call.

    Args:
        system: the model, with the run's parameters.
        batch: the sequences.
        states: ``(K, B, N, W)`` of the run at the sampling times.
    """

    def __init__(self, system: System, batch: Batch, states: Tensor) -> None:
        self.system, self.batch, self.states = system, batch, states
        self.scene = system.scene(batch)
        self.time = batch.dt * torch.arange(len(states), dtype=torch.float64)
        k, b, n, w = states.shape
        rates = self._rates_of(system)
        ways = torch.eye(n * w, dtype=torch.float64).reshape(n * w, 1, 1, n, w)

        def along(way: Tensor) -> Tensor:
            found: Tensor = jvp(rates, (states,), (way.expand(states.shape),))[1]
            return found

        matrix = vmap(along)(ways).reshape(n * w, k, b, n * w).permute(1, 2, 3, 0)
        half, one = batch.dt / 2, torch.eye(n * w, dtype=torch.float64)
        self._factors = torch.linalg.lu_factor(one - half * matrix[1:])
        self._before = one + half * matrix[:-1]

    def rates(self, system: System) -> Tensor:
        """``(K, B, N, W)`` rates of a model of the same states along the run."""
        with torch.no_grad():
            found: Tensor = self._rates_of(system)(self.states)
        return found

    def moved(self, source: Tensor, start: Tensor | None = None) -> Tensor:
        """``(C, K, B, N)`` m: positions moved by changes of the rates.

        Args:
            source: ``(C, K, B, N, W)`` changes of the rates, m/s for positions.
            start: ``(C, B, N, W)`` changes of the states at the start, by default none.
        """
        c, k, b, n, w = source.shape
        flat = source.reshape(c, k, b, n * w).permute(1, 2, 3, 0)
        forced = (self.batch.dt / 2) * (flat[1:] + flat[:-1])
        state = flat.new_zeros(b, n * w, c)
        if start is not None:
            state = start.reshape(c, b, n * w).permute(1, 2, 0).contiguous()
        found = [state]
        lu, pivots = self._factors
        for step in range(k - 1):
            right = self._before[step] @ state + forced[step]
            state = torch.linalg.lu_solve(lu[step], pivots[step], right)
            found.append(state)
        moved = torch.stack(found).reshape(k, b, n, w, c)[..., 0, :]
        return moved.permute(3, 0, 1, 2)

    def parameters(self) -> Tensor:
        """``(C, K, B, N)`` m per unit of each parameter that is calibrated."""
        own = {name: p.detach() for name, p in trained(self.system).items()}
        sources, starts = [], []
        for name, value in own.items():
            for i in range(value.numel()):
                along = torch.zeros(value.numel(), dtype=torch.float64)
                along[i] = 1.0
                change = {n: torch.zeros_like(v) for n, v in own.items()}
                change[name] = along.reshape(value.shape)
                sources.append(jvp(self._of_parameters, (own,), (change,))[1])
                starts.append(jvp(self._start, (own,), (change,))[1])
        return self.moved(torch.stack(sources), torch.stack(starts))

    def _rates_of(self, system: System) -> Callable[[Tensor], Tensor]:
        def one(t: Tensor, y: Tensor) -> Tensor:
            found: Tensor = system(t, y, self.scene)
            return found

        every = vmap(one)
        return lambda states: every(self.time, states)

    def _of_parameters(self, parameters: dict[str, Tensor]) -> Tensor:
        def one(t: Tensor, y: Tensor) -> Tensor:
            found: Tensor = functional_call(self.system, parameters, (t, y, self.scene))
            return found

        found: Tensor = vmap(one)(self.time, self.states)
        return found

    def _start(self, parameters: dict[str, Tensor]) -> Tensor:
        return initial_with(self.system, parameters, self.batch)
