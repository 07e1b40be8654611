"""Many short runs with parameters of their own in one row of numbers.

Where a run alone fills few vector registers, its loops are all overhead. Here lane
``run * B + b`` is simulation b of a run, and blocks of lanes are computed together; every
lane carries its own parameters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nnode.solvers.fused._generate import compiled
from nnode.solvers.fused._plan import Plan, run_all
from nnode.solvers.fused._rows import APART, CHUNK

#: Gaps of one run from which it fills the registers by itself.
_ENOUGH = 512


def pays(runs: int, simulations: int, agents: int) -> bool:
    """Whether lanes are the faster arrangement of these runs, and fit."""
    return runs > 1 and (agents - 1) * simulations < _ENOUGH and agents * CHUNK <= APART


def lane_layout(lanes: int, agents: int, threads: int) -> tuple[tuple[np.ndarray, ...], int, int]:
    """Cut lanes into blocks; jobs by thread, row size, blocks."""
    blocks = -(-lanes // CHUNK)
    table = np.array([(0, block * CHUNK, CHUNK, block) for block in range(blocks)], dtype=np.int64)
    shares = np.array_split(table, min(threads, blocks))
    return tuple(np.ascontiguousarray(share) for share in shares), agents * CHUNK, blocks


class SimulateLanes(torch.autograd.Function):
    """As the function for runs of their own, with the same arguments and results."""

    @staticmethod
    def forward(
        ctx: Any, plan: Plan, x0: Tensor, v0: Tensor, offset: Tensor, shares: Tensor
    ) -> Tensor:
        runs, (simulations, agents) = len(v0), x0.shape
        lanes, room = runs * simulations, plan.slots * CHUNK

        def wide(values: np.ndarray, fill: float | None = None) -> np.ndarray:
            """Lanes on the first axis, filled up to whole blocks."""
            if fill is None:
                extra = values[-1:].repeat(room - lanes, axis=0)
            else:
                extra = np.full((room - lanes, *values.shape[1:]), fill, values.dtype)
            return np.ascontiguousarray(np.concatenate([values, extra]))

        def tiled(values: np.ndarray) -> np.ndarray:
            return np.tile(values, (runs,) + (1,) * (values.ndim - 1))

        def own(values: Tensor) -> np.ndarray:
            return wide(values.detach().numpy().repeat(simulations, axis=0))

        keep = any(ctx.needs_input_grad)
        starts = wide(tiled(x0.detach().numpy()))
        number = wide(tiled(plan.number))
        end = wide(tiled(plan.end), -1)  # what fills the last block never moves
        measured = plan.measured
        if len(measured):
            measured = wide(tiled(measured.swapaxes(0, 1))).swapaxes(0, 1)
        measured = np.ascontiguousarray(measured)
        law = np.ascontiguousarray(np.moveaxis(own(shares), 0, -1))
        states = np.empty((plan.slots, plan.steps if keep else 0, plan.size), starts.dtype)
        out = np.empty((1, plan.samples, room, agents), starts.dtype)
        rest, run = (own(v0), own(offset)), compiled(plan.kernel).forward_lanes

        def call(jobs: np.ndarray) -> None:
            run(jobs, plan.per, plan.dt, starts, number, end, measured, *rest, law, states, out)

        run_all(call, plan.jobs)
        ctx.plan, ctx.states, ctx.law = plan, states, law
        ctx.number, ctx.end, ctx.runs = number, end, runs
        found = out[0, :, :lanes].reshape(plan.samples, runs, simulations, agents)
        return torch.from_numpy(np.ascontiguousarray(found.swapaxes(0, 1)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        plan: Plan = ctx.plan
        runs, samples, simulations, agents = grads[0].shape
        lanes, room = runs * simulations, plan.slots * CHUNK
        arrived = grads[0].numpy()
        grad_out = np.zeros((1, samples, room, agents), arrived.dtype)
        grad_out[0, :, :lanes] = arrived.swapaxes(0, 1).reshape(samples, lanes, agents)
        grad_x0 = np.zeros((1, room, agents), arrived.dtype)
        # sums over all steps are kept in float64 whatever the precision of the states
        grad_law, grad_rest = np.zeros(ctx.law.shape), np.zeros((2, room))
        run = compiled(plan.kernel).backward_lanes

        def call(jobs: np.ndarray) -> None:
            run(
                jobs,
                plan.per,
                plan.dt,
                ctx.number,
                ctx.end,
                len(plan.measured) == 0,
                ctx.law,
                ctx.states,
                grad_out,
                grad_x0,
                grad_law,
                grad_rest,
            )

        run_all(call, plan.jobs)

        def total(values: np.ndarray) -> Tensor:
            """Lanes on the last axis to runs on the first."""
            by_run = values[..., :lanes].reshape(*values.shape[:-1], runs, simulations).sum(-1)
            moved = np.ascontiguousarray(np.moveaxis(by_run, -1, 0))
            return torch.from_numpy(moved).to(grads[0].dtype)

        rest = total(grad_rest)
        by_run = grad_x0[0, :lanes].reshape(runs, simulations, agents).sum(0)
        return None, plan.start(by_run), rest[:, 0], rest[:, 1], total(grad_law)
