"""Lanes in compiled code: blocks of simulations, threads, runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from types import ModuleType
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nnode.data.sequence import Batch
from nnode.model.formula import inputs_of, starts_of
from nnode.model.lane_dynamics import LaneDynamics
from nnode.model.steps import STAGES, stepped
from nnode.model.system import System, Traffic, initial_with
from nnode.model.tangent import with_tangents
from nnode.model.term import Term
from nnode.simulate.kernels import functions
from nnode.simulate.kernels.cache import digest, keep
from nnode.simulate.kernels.lanes import rows as lane_rows
from nnode.simulate.kernels.lanes.source import LaneSource
from nnode.simulate.kernels.threads import run_all

#: Bytes of one row: a handful of rows are to stay in the first-level cache.
_ROW_BYTES = 4800
#: Rows of vehicles that are computed one behind the other are a multiple of this.
_PITCH = 16
#: Gaps of one run from which it fills the registers by itself.
_ENOUGH = 512
#: Numbers of a row that no vehicle needs, behind the last one.
_BEHIND = 2 * lane_rows.CHUNK
#: Distances of rows; not powers of two: rows would compete for the same lines of the cache.
_STRIDES = (1424, 5200, 20800, 83200)
#: Compiled into every module besides its own text.
_COMPILED_IN = (lane_rows, functions)


@cache
def compiled(source: LaneSource) -> ModuleType:
    """The module of a source.

    Raises:
        ConfigError: the cache folder cannot be written.
    """
    text = source.text()
    return keep(f"nnode_lane_{digest(text.encode(), list(_COMPILED_IN))}", text.encode())


@dataclass(frozen=True)
class Plan:
    """Everything of a simulation that carries no gradient."""

    source: LaneSource
    module: ModuleType
    jobs: tuple[np.ndarray, ...]  # for every thread rows of first, width, distance, slot, run
    slots: int
    size: int
    per: int
    steps: int
    samples: int
    dt: Any
    drives: Any
    fields: np.ndarray
    number: np.ndarray
    end: np.ndarray
    path: np.ndarray


def supports(system: System, batch: Batch) -> LaneDynamics | None:
    """The formula of a model that is simulated in compiled code; None: it is not."""
    if batch.x.device.type != "cpu" or type(system) is not Traffic:
        return None
    if system.leader == "measured" and batch.x.requires_grad:
        return None  # measured positions are constants here
    lane = system.lane
    return lane if lane is not None and lane.is_formula else None


class _Simulate(torch.autograd.Function):
    """A method's steps and the exact gradient of what it computes."""

    @staticmethod
    def forward(ctx: Any, plan: Plan, y0: Tensor, q: Tensor) -> Tensor:
        start, values = (np.ascontiguousarray(t.detach().numpy()) for t in (y0, q))
        keeps = any(ctx.needs_input_grad)
        number = len(plan.source.states)
        # NumPy asks for huge pages, which are far faster to touch for the first time
        states = np.empty((plan.slots, plan.steps if keeps else 0, number, plan.size), start.dtype)
        out = np.empty((number, plan.samples, *start.shape[1:]), start.dtype)

        def call(jobs: np.ndarray) -> None:
            plan.module.forward(
                jobs, plan.per, plan.dt, plan.drives, start, plan.fields, plan.number, plan.end,
                plan.path, values, states, out,
            )  # fmt: skip

        run_all(call, plan.jobs)
        ctx.plan, ctx.states, ctx.values = plan, states, values
        return torch.from_numpy(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        plan: Plan = ctx.plan
        arrived = np.ascontiguousarray(grads[0].numpy())
        number, _, simulations, agents = arrived.shape
        grad_y0 = np.zeros((number, simulations, agents), arrived.dtype)
        runs, parameters = ctx.values.shape
        own = plan.source.own
        # sums over all steps are kept in float64 whatever the precision of the states
        grad_q = np.zeros((runs if own else plan.slots, parameters))

        def call(jobs: np.ndarray) -> None:
            plan.module.backward(
                jobs, plan.per, plan.dt, plan.drives, plan.fields, plan.number, plan.end, plan.path,
                ctx.values, ctx.states, arrived, grad_y0, grad_q,
            )  # fmt: skip

        run_all(call, plan.jobs)
        found = grad_q
        if not own:
            owner = np.concatenate([share[:, 4] for share in plan.jobs])
            found = np.zeros((runs, parameters))
            np.add.at(found, owner, grad_q)
        return None, torch.from_numpy(grad_y0), torch.from_numpy(found).to(grads[0].dtype)


def simulate(
    system: System,
    lane: LaneDynamics,
    batch: Batch,
    substeps: int,
    threads: int = 1,
    parameters: Mapping[str, Tensor] | None = None,
    method: str | None = None,
) -> Tensor:
    """Simulate R runs of a lane.

    Args:
        lane: of the system.
        substeps: steps in a sampling interval.
        threads: at most so many threads work on it.
        parameters: the system's parameters by name, each with a leading axis of R runs;
            None makes one run with the system's own.
        method: of :data:`nnode.model.steps.METHODS`; None: the law's own.

    Returns:
        ``(K, R, B, N, M)`` states at the samples; it can be differentiated by the parameters
        and the start.
    """
    dtype = batch.x.dtype
    if parameters is None:
        parameters = {name: p[None] for name, p in system.named_parameters()}
    q = _row(lane, parameters).to(dtype)
    runs = len(q)
    y0 = starts(system, lane, batch, parameters, batch.dt / substeps)
    simulations, agents = y0.shape[2:4]
    own = runs > 1 and (agents - 1) * simulations < _ENOUGH
    lanes = runs * simulations
    y0 = y0.reshape(len(lane.rates), lanes, agents)
    if own:
        q = q.repeat_interleave(simulations, 0)
    plan = planned(system, lane, batch, substeps, threads, runs, own=own, method=method)
    out: Tensor = _Simulate.apply(plan, y0, q)
    return out.reshape(len(out), batch.n_samples, runs, simulations, agents).permute(1, 2, 3, 4, 0)


def tangents(
    system: Traffic,
    lane: LaneDynamics,
    batch: Batch,
    substeps: int,
    names: Sequence[str],
    threads: int = 1,
    each: Tensor | None = None,
    method: str | None = None,
    given: Sequence[str] | None = None,
) -> tuple[Tensor, Tensor]:
    """Simulate a lane, and the derivatives of its states by parameters, exact for the method.

    Args:
        names: P symbols among ``lane.owned``.
        each: ``(B, G)`` values of parameters for every sequence, ``(1, G)`` for all; None: the
            system's own.
        given: symbols of the parameters in ``each``; None: those of ``names``.

    Returns:
        ``(K, B, N, M)`` states and ``(P, K, B, N, M)`` their derivatives. A measured leader's
        are 0.

    Raises:
        ValueError: the start of an added state depends on parameters, but is no formula.
    """
    added = list(lane.rates)[lane.order :]
    if any(state not in lane.starts for state in added):
        raise ValueError("tangents need a start of every added state that is a formula")
    x, terms = batch.x, cast(list[Term], list(system.terms))
    own = {name: p.detach()[None] for name, p in system.named_parameters()}
    q = _row(lane, own).to(x.dtype)
    every = with_tangents(stepped(lane, method or system.step), tuple(names))
    if each is not None:
        q = q.repeat(len(each), 1)
        q[:, [list(lane.owned).index(s) for s in given or names]] = each.to(x.dtype)
    known = {}
    if every.starts:
        scene = replace(system.scene(batch), step=batch.dt / substeps)
        values = dict(zip(lane.owned, q.T[..., None], strict=True))
        known = starts_of(terms, every, x[0], batch.v[0], scene, values)
    zero = torch.zeros_like(x[0, ..., 0])
    known = {"x": x[0, ..., 0], "v": batch.v[0, ..., 0], **known}
    y0 = torch.stack([known.get(state, zero) for state in every.rates])
    plan = planned(
        system, lane, batch, substeps, threads, 1,
        own=len(q) > 1, method=method, tangents=tuple(names),
    )  # fmt: skip
    with torch.no_grad():
        out: Tensor = _Simulate.apply(plan, y0, q)
    states = out.reshape(1 + len(names), len(lane.rates), *out.shape[1:])
    states = states.permute(0, 2, 3, 4, 1)
    return states[0], states[1:]


def _row(lane: LaneDynamics, parameters: Mapping[str, Tensor]) -> Tensor:
    """``(R, P)`` the parameters' symbols, in few operations: each is one more on the way back."""
    first: dict[str, int] = {}
    parts, total = [], 0
    for name, _, axes in lane.owned.values():
        if name not in first:
            value = parameters[name]
            parts.append(value[..., None] if axes is None else value.flatten(value.ndim - axes))
            first[name], total = total, total + parts[-1].shape[-1]
    flat = torch.cat(parts, -1)
    places = [first[name] + place for name, place, _ in lane.owned.values()]
    return flat if places == list(range(total)) else flat[..., places]


def starts(
    system: System, lane: LaneDynamics, batch: Batch, parameters: Mapping[str, Tensor], step: float
) -> Tensor:
    """``(M, R, B, N)`` states at the start; a leader that is measured carries no gradient."""
    runs = len(next(iter(parameters.values())))
    if len(lane.rates) == lane.order:
        y = system.initial(batch)[None].expand(runs, -1, -1, -1)
    else:
        every = [{name: value[r] for name, value in parameters.items()} for r in range(runs)]
        y = torch.stack([initial_with(system, own, batch, step) for own in every])
    y = y.to(batch.x.dtype).permute(3, 0, 1, 2)
    if isinstance(system, Traffic) and system.leader == "measured":
        last = torch.arange(y.shape[-1]) == (batch.agent.sum(1) - 1)[:, None]
        y = torch.where(last, y.detach(), y)
    return y


def planned(
    system: System,
    lane: LaneDynamics,
    batch: Batch,
    substeps: int,
    threads: int,
    runs: int,
    *,
    own: bool = False,
    method: str | None = None,
    tangents: tuple[str, ...] = (),
) -> Plan:
    """How runs of a batch are computed.

    Args:
        runs: R; simulation b of run r is number ``r * B + b``.
        own: whether every simulation has parameters of its own.
        tangents: parameters by whose symbols tangents are wanted; there is no gradient then.
    """
    assert isinstance(system, Traffic)
    x = batch.x.detach()
    samples, simulations, agents = x.shape[:3]
    method = method or system.step
    lane, kind = stepped(lane, method), STAGES[method]
    if tangents:
        lane = with_tangents(lane, tangents)
    rough = LaneSource(lane, kind, own)
    groups = [(0, runs * simulations)] if own else [(r, simulations) for r in range(runs)]
    jobs, size, slots = _layout(groups, agents, x.element_size(), threads, rough.recursive)
    source = LaneSource(lane, kind, own, _stride(size), forward_only=bool(tangents))
    last = batch.valid.any(-1).sum(0) - 1

    def tiled(values: Tensor) -> np.ndarray:
        return np.tile(values.numpy(), (runs,) + (1,) * (values.ndim - 1))

    given: dict[str, Tensor] = {}
    if source.fields:
        given = inputs_of(cast(list[Term], list(system.terms)), lane, system.scene(batch))
        given["start"] = batch.start[:, None].expand(-1, agents)
    fields = [tiled(given[name].to(x.dtype)) for name in source.fields]
    path = x.new_empty(2, 0, 0)
    if system.leader == "measured" or source.measured:
        lead = (batch.agent.sum(1) - 1)[None, None, :, None].expand(2, samples, -1, 1)
        both = torch.stack([x[..., 0], batch.v.detach()[..., 0]])
        path = both.gather(3, lead)[..., 0].repeat(1, 1, runs)
    return Plan(
        source=source,
        module=compiled(source),
        jobs=jobs,
        slots=slots,
        size=size,
        per=substeps,
        steps=substeps * (samples - 1),
        samples=samples,
        dt=x.new_tensor(batch.dt / substeps).numpy()[()],
        drives=x.new_tensor(float(system.leader == "constant")).numpy()[()],
        fields=np.stack(fields) if fields else np.zeros((0, 1, 1), x.numpy().dtype),
        number=tiled(batch.agent.sum(1)),
        end=tiled(substeps * last),
        path=np.ascontiguousarray(path.numpy()),
    )


def _layout(
    groups: Sequence[tuple[int, int]], agents: int, itemsize: int, threads: int, recursive: bool
) -> tuple[tuple[np.ndarray, ...], int, int]:
    """Cut groups (run, number of simulations) into blocks; jobs by thread, row size, blocks."""
    most = max(1, _ROW_BYTES // (itemsize * agents))
    if recursive:
        most = max(_PITCH, most // _PITCH * _PITCH)
    rows, first = [], 0
    widest = 1
    for run, simulations in groups:
        blocks = -(-simulations // most)
        if len(groups) < threads:
            # a block narrower than a chunk of vectors would only compute padding
            useful = max(1, (agents - 1) * simulations // lane_rows.CHUNK)
            blocks = max(blocks, min(threads, useful))
        width = -(-simulations // blocks)
        w = -(-width // _PITCH) * _PITCH if recursive else width
        widest = max(widest, w)
        rows += [
            (first + low, min(width, simulations - low), w, run)
            for low in range(0, simulations, width)
        ]
        first += simulations
    table = np.array([(*row[:3], slot, row[3]) for slot, row in enumerate(rows)], dtype=np.int64)
    shares = np.array_split(table, min(threads, len(table)))
    return tuple(np.ascontiguousarray(share) for share in shares), agents * widest, len(table)


def _stride(size: int) -> int:
    """The distance of rows that hold so many numbers and what loops add to them."""
    for stride in _STRIDES:
        if size + _BEHIND <= stride:
            return stride
    return size + _BEHIND + 80 - size % 64
