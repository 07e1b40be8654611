"""Simulations of lanes in compiled code.

The simulation of a lane and its exact gradient are generated as source text. A block of ``width``
simulations is one row of numbers: vehicle i of simulation b has the index ``i * w + b``, with
w >= width. The values of the vehicles ahead are the same row shifted by w, so that every loop runs
over contiguous numbers. With separate arrays, the compiler could not exclude that they overlap.
Therefore all rows of a block are in one buffer, at distances that are compile-time constants.

An increment of a state is

    I = move * (the formula for followers, the leader's speed for leaders),

and every step of every method adds increments. The gradient is generated from this formula. If a
formula contains the speed of the vehicle ahead, vehicles are computed one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model.expression import Expr, apply, const, symbol, symbols
from nnode.model.formula import inputs_of, starts_of
from nnode.model.lane_rates import SAFE
from nnode.model.steps import STAGES, stepped
from nnode.model.system import System, Traffic, with_parameters
from nnode.model.tangent import with_tangents
from nnode.model.terms import LaneDynamics
from nnode.simulation.kernels.loops import Loop
from nnode.simulation.kernels.runs import Plan, Simulate, Source, compiled, shared_out

#: Weights and times of the stages of a method.
TABLEAUS = {
    "euler": ((1.0,), (0.0,)),
    "rk4": ((1 / 6, 1 / 3, 1 / 3, 1 / 6), (0.0, 0.5, 0.5, 1.0)),
}
#: Rows are computed in multiples of this, four of the widest vectors of float32.
CHUNK = 64
#: Bytes of one row, so that a few rows fit the first-level cache.
_ROW_BYTES = 4800
#: Rows of vehicles that are computed one after the other have a multiple of this length.
_PITCH = 16
#: Number of gaps from which one run uses vector instructions efficiently.
_ENOUGH = 512
#: Padding at the end of a row.
_BEHIND = 2 * CHUNK
#: Distances of rows. With powers of two, rows would compete for the same lines of the cache.
_STRIDES = (1424, 5200, 20800, 83200)


@dataclass(frozen=True)
class LaneSource(Source):
    """Source code of a model.

    Attributes:
        lane: flat, with the rates of a step.
        stages: ``euler`` or ``rk4``.
        per_simulation: whether every simulation has separate parameters.
        stride: numbers between two rows.
        forward_only: without the gradient.
    """

    kind: ClassVar[str] = "lane"
    chunk: ClassVar[int] = CHUNK
    safe: ClassVar[float] = SAFE
    tableaus: ClassVar = TABLEAUS
    lane: LaneDynamics
    stages: str = "euler"
    per_simulation: bool = False
    stride: int = 1424
    forward_only: bool = False

    @cached_property
    def states(self) -> list[str]:
        return list(self.lane.rates)

    @cached_property
    def parameters(self) -> list[str]:
        return list(self.lane.owned)

    @property
    def simulation_parameters(self) -> list[str]:
        """Parameters that are rows of the buffer."""
        return self.parameters if self.per_simulation else []

    @cached_property
    def recursive(self) -> bool:
        return bool(self.lane.chained)

    @cached_property
    def fields(self) -> list[str]:
        """Vehicles' properties from the data."""
        return [
            name for name in [*self.lane.inputs, "start", "length_1"] if name in self.lane.symbols
        ]

    @cached_property
    def measured(self) -> bool:
        """Whether the measured speed of leaders is needed."""
        return "measured" in self.lane.symbols or self.recursive

    @cached_property
    def inputs(self) -> list[str]:
        """Rows that carry derivatives."""
        ahead = [f"{s}_{j}" for s, j in self.lane.ahead]
        return [*self.states, *ahead, *self.lane.chained.values()]

    @cached_property
    def loop(self) -> Loop:
        return Loop([] if self.per_simulation else self.parameters)

    @cached_property
    def follower(self) -> dict[str, Expr]:
        """Row to formula for all vehicles except the first row."""
        behind, move = symbol("behind"), symbol("move")
        speed, rows = self._leader(), {}
        for s, rate in self.lane.rates.items():
            every = apply("choose", behind, rate, speed if s == "x" else self._lead(s))
            if s in self.lane.chained:
                rows[f"R_{s}"] = every
            rows[f"I_{s}"] = move * every
        return rows

    @cached_property
    def first(self) -> dict[str, Expr]:
        """Row to formula for the first row, which has no followers."""
        speed, move = self._leader(), symbol("first_move")
        rows = {f"I_{s}": const(0) for s in self.states}
        rows["I_x"] = move * speed
        rows |= {f"I_{s}": move * self._lead(s) for s in self.lane.leader_rates}
        return rows | {f"R_{s}": speed if s == "x" else self._lead(s) for s in self.lane.chained}

    def _lead(self, state: str) -> Expr:
        """Rate of a leader's state other than its position."""
        rate = self.lane.leader_rates.get(state, const(0))
        return apply("choose", symbol("drives"), rate, const(0)) if self.recursive else rate

    def _leader(self) -> Expr:
        """Speed of a leader, which does not move a leader with measured positions."""
        if not self.recursive:
            return self.lane.leader
        return apply("choose", symbol("drives"), self.lane.leader, symbol("measured"))

    @cached_property
    def rows(self) -> list[str]:
        """All rows: states first, then groups with one row for every state."""
        every = list(self.states)
        back = () if self.forward_only else ("A", *(f"Y{i}" for i in range(4)))
        for group in ("I", "E", "B", "S", *back):
            every += [f"{group}_{s}" for s in self.states]
        every += [f"{s}_{j}" for s, j in self.lane.ahead]
        every += ["behind", "second", "move", "first_move", "measured"]
        every += [*self.lane.chained.values(), *(f"R_{s}" for s in self.lane.chained)]
        every += self.fields
        if not self.forward_only:
            every += ["RBAR", *(f"D_{i}" for i in self.inputs if i not in self.states)]
        return [
            *every,
            *self.simulation_parameters,
            *(f"G_{p}" for p in self.simulation_parameters),
        ]

    @property
    def names(self) -> list[str]:
        return [*self.rows, *self.parameters, *self.lane.symbols]

    @property
    def overwritten(self) -> list[str]:
        """States whose adjoints the gradient replaces; it adds to those of one stage."""
        return self.states if self.stages == "rk4" else []

    def vjps(self) -> str:
        """Source of the functions from adjoints A of increments to D, the adjoints of inputs."""
        # a state's adjoint is read once, so its row can be overwritten
        states = {f"A_{s}": s for s in self.states}
        inputs = {f"D_{i}": i for i in self.inputs if i not in self.states}
        gradients = {f"G_{p}": p for p in self.simulation_parameters}
        # the first row depends only on a leader's speed
        used = {*symbols(self.first.values()), *self.overwritten}
        first = {row: s for row, s in states.items() if s in used}
        text = ""
        for name, increments, of_states, others in (
            ("follow", self.follower, states, inputs),
            ("first", self.first, first, {}),
        ):
            outputs = {
                "RBAR" if row == "R_x" else f"A_{row[2:]}": formula
                for row, formula in increments.items()
            }
            onto = [*([] if self.overwritten else of_states), *gradients]
            text += self.loop.vjp(
                f"{name}_vjp", outputs, {**of_states, **others, **gradients}, onto
            )
        return text


def supports(system: System, batch: Batch) -> LaneDynamics | None:
    """The formula of a model that compiled code covers; None for other models."""
    if batch.x.device.type != "cpu" or type(system) is not Traffic:
        return None
    if system.leader_measured and batch.x.requires_grad:
        return None  # compiled code has no gradient by measured positions
    lane = system.formula
    return lane if lane is not None and lane.is_formula else None


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
        lane: the system's formula.
        substeps: steps in a sampling interval.
        threads: largest number of threads.
        parameters: name to values of the system's parameters with a leading axis of R runs; None
            for one run with the system's values.
        method: one of :data:`nnode.model.steps.METHODS`; None takes the law's method.

    Returns:
        ``(K, R, B, N, M)`` states at the samples, differentiable with respect to the parameters
        and the start.
    """
    assert isinstance(system, Traffic)
    if parameters is None:
        parameters = {name: p[None] for name, p in system.named_parameters()}
    q = _row(lane, parameters).to(batch.x.dtype)
    runs = len(q)
    if len(lane.rates) == lane.order:
        y0 = system.initial(batch)[None].expand(runs, -1, -1, -1)
    else:
        every = [{name: value[r] for name, value in parameters.items()} for r in range(runs)]
        step = batch.dt / substeps
        y0 = torch.stack([with_parameters(system, values).initial(batch, step) for values in every])
    y0 = y0.to(batch.x.dtype).permute(3, 0, 1, 2)
    simulations, agents = y0.shape[2:]
    if system.leader_measured:  # the start of a measured leader has no gradient
        last = torch.arange(agents) == (batch.agent.sum(1) - 1)[:, None]
        y0 = torch.where(last, y0.detach(), y0)
    per_simulation = runs > 1 and (agents - 1) * simulations < _ENOUGH
    if per_simulation:
        q = q.repeat_interleave(simulations, 0)
    plan = _planned(system, lane, batch, substeps, threads, runs, per_simulation, method)
    out: Tensor = Simulate.apply(plan, y0.reshape(len(y0), -1, agents), q)
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
    """Simulate a lane and the derivatives of its states by parameters, exact for the method.

    Args:
        names: P symbols among ``lane.owned``.
        each: ``(B, G)`` values of parameters for every sequence, or ``(1, G)`` for all; None takes
            the system's values.
        given: symbols of the parameters in ``each``; None takes ``names``.

    Returns:
        ``(K, B, N, M)`` states and their derivatives ``(P, K, B, N, M)``, which are 0 for a
        measured leader.
    """
    x, terms = batch.x, system.term_list
    q = _row(lane, {name: p.detach()[None] for name, p in system.named_parameters()}).to(x.dtype)
    every = with_tangents(stepped(lane, method or system.step), tuple(names))
    if each is not None:
        q = q.repeat(len(each), 1)
        q[:, [list(lane.owned).index(s) for s in given or names]] = each.to(x.dtype)
    start = {"x": x[0, ..., 0], "v": batch.v[0, ..., 0]}
    if every.starts:
        scene = replace(system.scene(batch), step=batch.dt / substeps)
        values = dict(zip(lane.owned, q.T, strict=True))
        start |= starts_of(terms, every, x[0], batch.v[0], scene, values)
    zero = torch.zeros_like(start["x"])
    y0 = torch.stack([start.get(state, zero) for state in every.rates])
    plan = _planned(
        system, lane, batch, substeps, threads, 1, len(q) > 1, method, tangents=tuple(names)
    )
    with torch.no_grad():
        out: Tensor = Simulate.apply(plan, y0, q)
    states = out.reshape(1 + len(names), len(lane.rates), *out.shape[1:])
    states = states.permute(0, 2, 3, 4, 1)
    return states[0], states[1:]


def _row(lane: LaneDynamics, parameters: Mapping[str, Tensor]) -> Tensor:
    """``(R, P)`` values of the parameters' symbols, in few operations for a fast gradient."""
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


def _planned(
    system: Traffic,
    lane: LaneDynamics,
    batch: Batch,
    substeps: int,
    threads: int,
    runs: int,
    per_simulation: bool,
    method: str | None,
    tangents: tuple[str, ...] = (),
) -> Plan:
    """The plan of the runs of a batch. Sequence b of run r is simulation ``r * B + b``.

    Args:
        per_simulation: whether every simulation has separate parameters.
        tangents: symbols of parameters by which tangents are simulated, without a gradient.
    """
    x = batch.x.detach()
    samples, simulations, agents = x.shape[:3]
    method = method or system.step
    lane, stages = stepped(lane, method), STAGES[method]
    if tangents:
        lane = with_tangents(lane, tangents)
    number = runs * simulations
    groups = [(0, number)] if per_simulation else [(r, simulations) for r in range(runs)]
    steps = substeps * (samples - 1)
    blocks = _blocks(groups, agents, x.element_size(), threads, bool(lane.chained))
    size = agents * max(w for *_, w, _ in blocks)
    length = size + _BEHIND
    stride = next((s for s in _STRIDES if length <= s), length + 80 - size % 64)
    source = LaneSource(lane, stages, per_simulation, stride, forward_only=bool(tangents))
    jobs, stored = [], 0
    for slot, (low, width, w, run) in enumerate(blocks):
        jobs.append((low, width, w, stored, slot, run))
        stored += len(source.states) * steps * agents * w

    def tiled(values: Tensor) -> np.ndarray:
        return np.tile(values.numpy(), (runs,) + (1,) * (values.ndim - 1))

    inputs: dict[str, Tensor] = {}
    if source.fields:
        inputs = inputs_of(system.term_list, lane, system.scene(batch))
        inputs["start"] = batch.start[:, None].expand(-1, agents)
    fields = [tiled(inputs[name].to(x.dtype)) for name in source.fields]
    path = x.new_empty(2, 0, 0)
    if system.leader_measured or source.measured:
        lead = (batch.agent.sum(1) - 1)[None, None, :, None].expand(2, samples, -1, 1)
        path = torch.stack([x[..., 0], batch.v.detach()[..., 0]]).gather(3, lead)
        path = path[..., 0].repeat(1, 1, runs)
    return Plan(
        module=compiled(source),
        jobs=shared_out(jobs, threads),
        constants=(
            substeps,
            x.new_tensor(batch.dt / substeps).numpy()[()],
            x.new_tensor(float(not system.leader_measured)).numpy()[()],
            np.stack(fields) if fields else np.zeros((0, 1, 1), x.numpy().dtype),
            tiled(batch.agent.sum(1)),
            tiled(substeps * (batch.valid.any(-1).sum(0) - 1)),
            np.ascontiguousarray(path.numpy()),
        ),
        stored=stored,
        samples=samples,
        owner=np.arange(number) if per_simulation else np.array([run for *_, run in blocks]),
    )


def _blocks(
    groups: Sequence[tuple[int, int]], agents: int, itemsize: int, threads: int, recursive: bool
) -> list[tuple[int, int, int, int]]:
    """Cut groups (run, number of simulations) into blocks: first simulation, number of
    simulations, distance of vehicles, run."""
    most = max(1, _ROW_BYTES // (itemsize * agents))
    if recursive:
        most = max(_PITCH, most // _PITCH * _PITCH)
    blocks, first = [], 0
    for run, simulations in groups:
        number = -(-simulations // most)
        if len(groups) < threads:
            # a narrower block than a chunk would compute mostly padding
            useful = max(1, (agents - 1) * simulations // CHUNK)
            number = max(number, min(threads, useful))
        width = -(-simulations // number)
        w = -(-width // _PITCH) * _PITCH if recursive else width
        blocks += [
            (first + low, min(width, simulations - low), w, run)
            for low in range(0, simulations, width)
        ]
        first += simulations
    return blocks
