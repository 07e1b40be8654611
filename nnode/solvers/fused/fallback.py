"""Exact discrete gradients of any model, for terms that have no compiled kernel.

The states are computed once, without a graph. Backwards, the right-hand side is evaluated for
many steps in one batched call; its Jacobian comes row by row, each row for all these steps and
simulations at once; what is left per step is a small matrix product. Where the Jacobian would
be larger than worth it (a crowd), each step is differentiated by itself instead.

In a lane it costs hundreds of times as much as compiled code, which the solver says.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nnode.data.sequence import Batch
from nnode.models.formula import rule_of
from nnode.models.system import System, Traffic
from nnode.models.term import Term
from nnode.solvers.rates import Rates

#: Jacobians of one batched call may hold so many numbers.
_ROOM = 16_000_000
#: Largest Jacobian of one step, in numbers, that pays.
_WORTH = 100_000


class _Problem:
    """The right-hand side per step, and what else does not change."""

    def __init__(self, system: System, batch: Batch, substeps: int) -> None:
        self.rate, self.per = Rates(system, batch, substeps), substeps
        self.samples = batch.n_samples
        self.steps = substeps * (batch.n_samples - 1)

    def rates(self, steps: Tensor, y: Tensor) -> Tensor:
        """The rate of many steps in one call: ``(S,)`` and ``(S, B, N, order * D)``."""
        rate, system = self.rate, self.rate.system
        if not (isinstance(system, Traffic) and system.leader == "measured"):
            return torch.func.vmap(rate)(steps, y)
        places = torch.stack([rate.scene.measured_at(step * rate.dt) for step in steps])

        def one(step: Tensor, y: Tensor, place: Tensor) -> Tensor:
            change = rate.dt * system.rates_behind(step * rate.dt, y, rate.scene, place)
            return rate.until_the_end(step, change)

        return torch.func.vmap(one)(steps, y, places)


class _Simulate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, problem: _Problem, y0: Tensor, *parameters: Tensor) -> Tensor:
        keep = any(ctx.needs_input_grad)
        steps = torch.arange(problem.steps + 1, dtype=y0.dtype, device=y0.device)
        y = y0.detach().clone()
        states = y.new_empty(problem.steps if keep else 0, *y.shape)
        out = y.new_empty(problem.samples, *y.shape)
        out[0] = y
        for s in range(problem.steps):
            if keep:
                states[s] = y
            y = y + problem.rate(steps[s], y)
            if (s + 1) % problem.per == 0:
                out[(s + 1) // problem.per] = y
        # refuses a backward pass after the parameters have been changed in place
        ctx.save_for_backward(steps, states, *parameters)
        ctx.problem = problem
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        problem: _Problem = ctx.problem
        steps, states, *parameters = ctx.saved_tensors
        wanted = [p for p, need in zip(parameters, ctx.needs_input_grad[2:], strict=True) if need]
        totals = [torch.zeros_like(p) for p in wanted]
        adjoint = torch.zeros_like(grads[0][0])
        _, simulations, agents, width = states.shape
        row = simulations * (agents * width) ** 2
        chunk = max(1, _ROOM // max(row, 1)) if row <= _WORTH else 1
        high = problem.steps
        while high > 0:
            low = max(0, high - chunk)
            adjoint = _pull(
                problem, steps[low:high], states[low:high], low, grads[0], adjoint, wanted, totals
            )
            high = low
        found = iter(totals)
        shares = [next(found) if need else None for need in ctx.needs_input_grad[2:]]
        return None, adjoint + grads[0][0], *shares


def _pull(
    problem: _Problem,
    steps: Tensor,
    states: Tensor,
    low: int,
    grad_out: Tensor,
    adjoint: Tensor,
    wanted: Sequence[Tensor],
    totals: Sequence[Tensor],
) -> Tensor:
    """Adjoint before the steps ``low`` ...; adds the parameters' gradients to ``totals``."""

    def arrived(s: int, adjoint: Tensor) -> Tensor:
        """The adjoint after step s, with what is observed there."""
        end = s + 1
        return adjoint + grad_out[end // problem.per] if end % problem.per == 0 else adjoint

    with torch.enable_grad():
        y = states.detach().requires_grad_()
        alone = len(states) == 1
        rate = problem.rate(steps[0], y[0])[None] if alone else problem.rates(steps, y)
    if alone:
        weights = arrived(low, adjoint)[None]
        inputs = [y, *wanted]
        grad_y, *shares = torch.autograd.grad(
            rate, inputs, weights, allow_unused=True, materialize_grads=True
        )
        adjoint = weights[0] + grad_y[0]
    else:
        count, simulations, agents, width = y.shape
        size = agents * width
        one = torch.zeros_like(rate)
        rows: list[Tensor] = []
        for i in range(agents):
            for c in range(width):
                one[:, :, i, c] = 1
                rows += torch.autograd.grad(rate, y, one, retain_graph=True)
                one[:, :, i, c] = 0
        jacobian = torch.stack(rows, -1).reshape(count, simulations, size, size)
        weights = torch.empty_like(states)
        for s in range(count - 1, -1, -1):
            weights[s] = arrived(low + s, adjoint)
            change = torch.bmm(jacobian[s], weights[s].reshape(simulations, size, 1))
            adjoint = weights[s] + change.reshape(simulations, agents, width)
        shares = list(
            torch.autograd.grad(rate, wanted, weights, allow_unused=True, materialize_grads=True)
            if wanted
            else ()
        )
    for total, share in zip(totals, shares, strict=True):
        total += share
    return adjoint


def reason(system: System) -> str:
    """Why compiled code is not used, in words: terms that it does not cover, by their names."""
    terms = cast(list[Term], list(system.terms))
    names = ", ".join(t.name for t in terms if rule_of(t) is None or (t.memory and t.rule is None))
    if names:
        return f"it does not cover {names}"
    alone = "models that begin with a law of the gap, without people who meet themselves and others"
    return f"it covers {alone} on the CPU, without a gradient by what was measured"


def simulate(system: System, batch: Batch, substeps: int, parameters: Sequence[Tensor]) -> Tensor:
    """Simulate any model with Euler's method; the gradient is that of the discrete scheme.

    Terms must be written in operations that ``torch.func.vmap`` knows.

    Args:
        substeps: Euler steps in a sampling interval.
        parameters: the tensors that the system computes with and that want a gradient.

    Returns:
        ``(K, B, N, order * D)`` states at the samples.
    """
    problem = _Problem(system, batch, substeps)
    y: Tensor = _Simulate.apply(problem, system.initial(batch), *parameters)
    return y
