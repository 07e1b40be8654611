"""Follow-the-leader models in compiled code: blocks of simulations, threads, runs side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nnode.data.sequence import Batch
from nnode.models.system import System, Traffic
from nnode.solvers.fused._generate import compiled
from nnode.solvers.fused._plan import Plan, run_all
from nnode.solvers.fused._rows import CHUNK
from nnode.solvers.fused.lanes import SimulateLanes, lane_layout, pays
from nnode.solvers.fused.laws import kernel_of

#: Bytes of one row: a handful of rows are to stay in the first-level cache.
_ROW_BYTES = 4800


def supports(system: System, batch: Batch) -> bool:
    """Whether the compiled code covers this model: one term, and it has a kernel."""
    if type(system) is not Traffic or len(system.terms) != 1:
        return False
    if system.leader == "measured" and batch.x.requires_grad:
        return False  # measured positions are constants here
    known = kernel_of(system.terms[0]) is not None  # type: ignore[arg-type]
    return known and batch.x.device.type == "cpu"


def _layout(
    runs: int, simulations: int, agents: int, itemsize: int, threads: int
) -> tuple[tuple[np.ndarray, ...], int, int]:
    """Cut ``runs`` times ``simulations`` into blocks; jobs by thread, row size, blocks."""
    most = max(1, _ROW_BYTES // (itemsize * agents))
    blocks = -(-simulations // most)
    if runs < threads:
        # a block narrower than a chunk of vectors would only compute padding
        useful = max(1, (agents - 1) * simulations // CHUNK)
        blocks = max(blocks, min(threads, useful))
    width = -(-simulations // blocks)
    rows = [
        (run, low, min(width, simulations - low))
        for run in range(runs)
        for low in range(0, simulations, width)
    ]
    table = np.array([(*row, slot) for slot, row in enumerate(rows)], dtype=np.int64)
    followers = -(-(agents - 1) * width // CHUNK) * CHUNK
    size = -(-(followers + width) // CHUNK) * CHUNK
    shares = np.array_split(table, min(threads, len(table)))
    return tuple(np.ascontiguousarray(share) for share in shares), size, len(table)


class _Simulate(torch.autograd.Function):
    """Euler's method and the exact gradient of what it computes."""

    @staticmethod
    def forward(
        ctx: Any, plan: Plan, x0: Tensor, v0: Tensor, offset: Tensor, shares: Tensor
    ) -> Tensor:
        values = [np.ascontiguousarray(t.detach().numpy()) for t in (x0, v0, offset, shares)]
        keep = any(ctx.needs_input_grad)
        # NumPy asks for huge pages, which are far faster to touch for the first time
        states = np.empty((plan.slots, plan.steps if keep else 0, plan.size), values[0].dtype)
        out = torch.empty((len(v0), plan.samples, *x0.shape), dtype=x0.dtype)
        run = compiled(plan.kernel).forward

        def call(jobs: np.ndarray) -> None:
            run(
                jobs,
                plan.per,
                plan.dt,
                values[0],
                plan.number,
                plan.end,
                plan.measured,
                *values[1:],
                states,
                out.numpy(),
            )

        run_all(call, plan.jobs)
        ctx.plan, ctx.states, ctx.shares = plan, states, values[3]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        plan: Plan = ctx.plan
        grad_out = np.ascontiguousarray(grads[0].numpy())
        runs, _, simulations, agents = grad_out.shape
        grad_x0 = np.zeros((runs, simulations, agents), grad_out.dtype)
        # sums over all steps are kept in float64 whatever the precision of the states
        grad_shares = np.zeros((plan.slots, *ctx.shares.shape[1:]))
        grad_rest = np.zeros((plan.slots, 2))
        run = compiled(plan.kernel).backward

        def call(jobs: np.ndarray) -> None:
            run(
                jobs,
                plan.per,
                plan.dt,
                plan.number,
                plan.end,
                len(plan.measured) == 0,
                ctx.shares,
                ctx.states,
                grad_out,
                grad_x0,
                grad_shares,
                grad_rest,
            )

        run_all(call, plan.jobs)
        owner = np.concatenate([share[:, 0] for share in plan.jobs])

        def total(values: np.ndarray) -> Tensor:
            found = np.zeros((runs, *values.shape[1:]))
            np.add.at(found, owner, values)
            return torch.from_numpy(found).to(grads[0].dtype)

        rest = total(grad_rest)
        return None, plan.start(grad_x0.sum(0)), rest[:, 0], rest[:, 1], total(grad_shares)


def simulate(
    system: System,
    batch: Batch,
    substeps: int,
    threads: int = 1,
    parameters: Mapping[str, Tensor] | None = None,
) -> Tensor:
    """Simulate R runs of a follow-the-leader model that :func:`supports` accepts.

    Args:
        substeps: Euler steps in a sampling interval.
        threads: at most so many threads work on it.
        parameters: the system's parameters by name, each with a leading axis of R runs;
            None makes one run with the system's own.

    Returns:
        ``(K, R, B, N, 1)`` states at the samples, m.
    """
    assert isinstance(system, Traffic)
    term, dtype = system.terms[0], batch.x.dtype
    kernel = kernel_of(term)  # type: ignore[arg-type]
    assert kernel is not None
    if parameters is None:
        own = {name: p[None] for name, p in term.named_parameters()}
    else:
        own = {name: parameters[f"terms.0.{name}"] for name, _ in term.named_parameters()}
    offset, shares = (t.to(dtype) for t in kernel.pack(own))
    v0 = own["v0"].to(dtype)
    x0 = system.initial(batch)[..., 0]
    simulations, agents = x0.shape
    jobs, size, slots = _layout(len(v0), simulations, agents, x0.element_size(), threads)
    measured = batch.x.detach()[..., 0] if system.leader == "measured" else x0.new_empty(0, 0, 0)
    last = batch.valid.any(-1).sum(0) - 1
    plan = Plan(
        kernel=kernel,
        jobs=jobs,
        size=size,
        slots=slots,
        steps=substeps * (batch.n_samples - 1),
        per=substeps,
        dt=x0.new_tensor(batch.dt / substeps).numpy()[()],
        number=batch.agent.sum(1).numpy(),
        end=(substeps * last).numpy(),
        measured=np.ascontiguousarray(measured.numpy()),
        samples=batch.n_samples,
    )
    if pays(len(v0), simulations, agents):
        jobs, size, slots = lane_layout(len(v0) * simulations, agents, threads)
        plan = replace(plan, jobs=jobs, size=size, slots=slots)
        out: Tensor = SimulateLanes.apply(plan, x0, v0, offset, shares)
    else:
        out = _Simulate.apply(plan, x0, v0, offset, shares)
    return out.transpose(0, 1)[..., None]
