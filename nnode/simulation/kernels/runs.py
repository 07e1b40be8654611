"""Shared parts of lanes and crowds: modules from templates, blocks, threads, and gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import torch
from jinja2 import Environment, PackageLoader, StrictUndefined
from torch import Tensor
from torch.autograd.function import once_differentiable

from nnode.model.expression import symbol
from nnode.model.names import check_symbols
from nnode.model.text import plain
from nnode.simulation.kernels import functions
from nnode.simulation.kernels.cache import digest, keep

#: Modules that are compiled into every generated module.
COMPILED_IN = (functions,)


_TEMPLATES = Environment(
    loader=PackageLoader("nnode.simulation.kernels"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters["plain"] = plain
_TEMPLATES.globals |= {"symbol": symbol, "zip": zip}


class Source:
    """The data of a generated module, whose template is named after its kind. Equal sources give
    one module."""

    kind: ClassVar[str]

    @property
    def names(self) -> Iterable[str]:
        """All names of formulas in the module."""
        raise NotImplementedError

    def text(self) -> str:
        """The module's source.

        Raises:
            ConfigError: a name in the formulas is not a valid symbol.
        """
        check_symbols(self.names)
        return _TEMPLATES.get_template(f"{self.kind}.py.j2").render(source=self) + "\n"


@cache
def compiled(source: Source) -> ModuleType:
    """The module of a source.

    Raises:
        ConfigError: a name in the formulas is not a valid symbol, or the cache folder cannot be
            written.
    """
    text = source.text().encode()
    return keep(f"nnode_{source.kind}_{digest(text, COMPILED_IN)}", text)


@dataclass(frozen=True)
class Plan:
    """The arguments of a simulation that have no gradient.

    Attributes:
        module: the compiled functions ``forward`` and ``backward``.
        jobs: blocks of every thread, with the columns: first simulation, number of simulations,
            their distance or the number of people, index in the stored states, row of the
            gradient's sums, run, and further columns of the kind of source.
        constants: arguments of the compiled functions between jobs and parameters.
        stored: number of stored values of states.
        samples: K.
        owner: row of the parameters for every row of the gradient's sums.
        padding: ``(B, N)`` True for padding, which does not move; None for none.
    """

    module: Any
    jobs: Sequence[np.ndarray]
    constants: Sequence[Any]
    stored: int
    samples: int
    owner: np.ndarray
    padding: np.ndarray | None = None


def shared_out(blocks: Iterable[Sequence[int]], threads: int) -> list[np.ndarray]:
    """Jobs of every thread. Blocks are assigned in turn, so that every thread gets large ones if
    they are sorted by size."""
    table = np.array(list(blocks), dtype=np.int64)
    number = min(threads, len(table))
    return [np.ascontiguousarray(table[i::number]) for i in range(number)]


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="nnode-fused")


def _run(function: Callable[..., None], plan: Plan, *arrays: np.ndarray) -> None:
    """Run a compiled function on the jobs of every thread. It releases Python's global lock."""

    def call(jobs: np.ndarray) -> None:
        function(jobs, *plan.constants, *arrays)

    first, *others = plan.jobs
    waiting = [_pool(len(others)).submit(call, jobs) for jobs in others]
    call(first)
    for other in waiting:
        other.result()


class Simulate(torch.autograd.Function):
    """A compiled simulation and its exact gradient.

    It maps the start ``(M, B, N)`` and parameters ``(R, P)`` to states ``(M, K, B, N)``.
    """

    @staticmethod
    def forward(ctx: Any, plan: Plan, y0: Tensor, q: Tensor) -> Tensor:
        start, values = (np.ascontiguousarray(t.detach().numpy()) for t in (y0, q))
        # NumPy requests huge pages, whose first access is much faster
        states = np.empty(plan.stored if any(ctx.needs_input_grad) else 0, start.dtype)
        out = np.empty((len(start), plan.samples, *start.shape[1:]), start.dtype)
        if plan.padding is not None:
            out[:] = start[:, None]
        _run(plan.module.forward, plan, values, start, states, out)
        ctx.plan, ctx.states, ctx.values = plan, states, values
        return torch.from_numpy(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        plan: Plan = ctx.plan
        grad_out = np.ascontiguousarray(grads[0].numpy())
        grad_y0 = np.zeros((len(grad_out), *grad_out.shape[2:]), grad_out.dtype)
        # sums over all steps are float64 for every precision of the states
        sums = np.zeros((len(plan.owner), ctx.values.shape[1]))
        _run(plan.module.backward, plan, ctx.values, ctx.states, grad_out, grad_y0, sums)
        if plan.padding is not None:
            grad_y0[:, plan.padding] = grad_out[:, :, plan.padding].sum(1)
        grad_q = np.zeros(ctx.values.shape)
        np.add.at(grad_q, plan.owner, sums)
        return None, torch.from_numpy(grad_y0), torch.from_numpy(grad_q).to(grads[0].dtype)
