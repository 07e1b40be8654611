"""What lanes and crowds share: modules from templates, blocks, threads, and gradients."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from string import Template
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nnode.model.expression import Expr, symbol
from nnode.simulation.kernels import functions
from nnode.simulation.kernels.cache import digest, keep

#: Compiled into every module besides its own text.
COMPILED_IN = (functions,)


class Source(Protocol):
    """What a module is generated from; equal sources are one module."""

    @property
    def kind(self) -> str:
        """The first part of the module's name."""

    def text(self) -> str:
        """The module's source."""


@cache
def compiled(source: Source) -> ModuleType:
    """The module of a source.

    Raises:
        ConfigError: a name in the formulas that is no symbol, or the cache folder cannot be
            written.
    """
    text = source.text().encode()
    return keep(f"nnode_{source.kind}_{digest(text, COMPILED_IN)}", text)


# -- text ------------------------------------------------------------------------------------------


@cache
def _sections(name: str) -> Mapping[str, str]:
    """The sections of a template file, each after a line ``# == title``."""
    folder = files("nnode.simulation.kernels") / "templates"
    text = (folder / f"{name}.py.txt").read_text("utf-8")
    parts = re.split(r"^# == (.*)\n", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def fill(name: str, section: str, /, **values: Any) -> str:
    """A section of a template file with values in place of ``$names``; lists of lines have the
    indentation of the place where they stand."""

    def inserted(found: re.Match[str]) -> str:
        rows = values[found[2]]
        return "".join(f"{found[1]}{row}\n" for row in rows) if type(rows) is list else found[0]

    text = re.sub(r"^( *)\$(\w+)\n", inserted, _sections(name)[section], flags=re.MULTILINE)
    return Template(text).substitute(values)


def head(
    name: str, formula: Sequence[str], chunk: int, places: list[str], /, **constants: Any
) -> str:
    """The beginning of a module: its formula in words, imports and constants."""
    own = fill(name, "constants", places=places, **constants)
    return fill("shared", "head", formula="\n".join(formula), chunk=chunk, constants=own)


def seeds(formulas: Mapping[str, Expr], weight: Callable[[str], str]) -> dict[Expr, Expr]:
    """Formulas of rows to the symbols of the rows of their weights, of which one formula may have
    several; numbers have no gradient."""
    weights: dict[Expr, Expr] = {}
    for row, node in formulas.items():
        if not node.is_number():
            own = symbol(weight(row))
            weights[node] = weights[node] + own if node in weights else own
    return weights


# -- runs ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plan:
    """Everything of a simulation that carries no gradient.

    Attributes:
        module: the compiled functions ``forward`` and ``backward``.
        jobs: for every thread its blocks, rows of: first simulation, simulations, their distance
            or number of people, place in the stored states, row of the gradient's sums, run, and
            what else a block of the kind has.
        constants: what the compiled functions take between jobs and parameters.
        stored: numbers of stored states.
        samples: K.
        owner: row of parameters that a row of the gradient's sums belongs to.
        padding: ``(B, N)`` True for whoever stays where he is; None: there is nobody.
    """

    module: Any
    jobs: Sequence[np.ndarray]
    constants: Sequence[Any]
    stored: int
    samples: int
    owner: np.ndarray
    padding: np.ndarray | None = None


def shared_out(blocks: Iterable[Sequence[int]], threads: int) -> list[np.ndarray]:
    """Jobs of every thread. Blocks that come sorted by size are dealt out in turn, so that every
    thread has its share of large ones."""
    table = np.array(list(blocks), dtype=np.int64)
    number = min(threads, len(table))
    return [np.ascontiguousarray(table[i::number]) for i in range(number)]


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="nnode-fused")


def _run(function: Callable[..., None], plan: Plan, *arrays: np.ndarray) -> None:
    """Run a compiled function, which releases Python's lock, on the jobs of every thread."""

    def call(jobs: np.ndarray) -> None:
        function(jobs, *plan.constants, *arrays)

    first, *others = plan.jobs
    waiting = [_pool(len(others)).submit(call, jobs) for jobs in others]
    call(first)
    for other in waiting:
        other.result()


class Simulate(torch.autograd.Function):
    """A method's steps and the exact gradient of what it computes.

    From the start ``(M, B, N)`` and parameters ``(R, P)`` to states ``(M, K, B, N)``.
    """

    @staticmethod
    def forward(ctx: Any, plan: Plan, y0: Tensor, q: Tensor) -> Tensor:
        start, values = (np.ascontiguousarray(t.detach().numpy()) for t in (y0, q))
        # NumPy asks for huge pages, which are far faster to touch for the first time
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
        # sums over all steps are kept in float64 whatever the precision of the states
        sums = np.zeros((len(plan.owner), ctx.values.shape[1]))
        _run(plan.module.backward, plan, ctx.values, ctx.states, grad_out, grad_y0, sums)
        if plan.padding is not None:
            grad_y0[:, plan.padding] = grad_out[:, :, plan.padding].sum(1)
        grad_q = np.zeros(ctx.values.shape)
        np.add.at(grad_q, plan.owner, sums)
        return None, torch.from_numpy(grad_y0), torch.from_numpy(grad_q).to(grads[0].dtype)
