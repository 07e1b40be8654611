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
from nnode.model.names import check_symbols
from nnode.model.steps import STAGES, stepped
from nnode.model.system import System, Traffic, with_parameters
from nnode.model.tangent import with_tangents
from nnode.model.terms import LaneDynamics
from nnode.model.text import plain
from nnode.simulation.kernels.loops import Loop
from nnode.simulation.kernels.runs import (
    Plan,
    Simulate,
    compiled,
    fill,
    head,
    seeds,
    shared_out,
)

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
class LaneSource:
    """Source code of a model.

    Attributes:
        lane: flat, with the rates of a step.
        stages: ``euler`` or ``rk4``.
        per_simulation: whether every simulation has separate parameters.
        stride: numbers between two rows.
        forward_only: without the gradient.
    """

    kind: ClassVar[str] = "lane"
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
    def _simulation_parameters(self) -> list[str]:
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
            *self._simulation_parameters,
            *(f"G_{p}" for p in self._simulation_parameters),
        ]

    def text(self) -> str:
        """The module's source.

        Raises:
            ConfigError: a name in the formulas is not a valid symbol.
        """
        check_symbols([*self.rows, *self.parameters, *self.lane.symbols])
        weights, times = TABLEAUS[self.stages]
        formula = [f"d{s}/dt = {plain(rate)}" for s, rate in self.lane.rates.items()]
        text = head(
            "lane",
            [*formula, f"leader: {plain(self.lane.leader)}"],
            CHUNK,
            [f"_{row} = np.uint64({i * self.stride})" for i, row in enumerate(self.rows)],
            stride=self.stride,
            states=len(self.states),
            rows=len(self.rows),
            weights=weights,
            times=times,
        )
        load, spread, collect = (
            [line.format(row, i) for i, row in enumerate(rows)]
            for line, rows in (
                ("load(buffer[_{}:], fields[{}], low, width, w)", self.fields),
                (
                    "spread(buffer[_{}:], every_q[:, {}], low, width, w, agents)",
                    self._simulation_parameters,
                ),
                (
                    "    collect(buffer[_G_{}:], grad_q[:, {}], low, width, w, agents)",
                    self._simulation_parameters,
                ),
            )
        )
        text += fill("lane", "rows") + self._gather() + self._rates()
        text += fill(
            "lane",
            "simulate",
            measured=self.measured,
            speeds=self.lane.order > 1,
            fields=[*load, *spread],
        )
        if self.forward_only:
            return text
        short = ["if step % per == 0:  # sums of single precision are kept short", *collect]
        return (
            text
            + self._vjp()
            + fill("lane", "gradient", scatter=self._scatter(), collect=short if collect else [])
        )

    def _gather(self) -> str:
        """The function that gathers values of the vehicles ahead; finite values without one."""
        body = [f"zero, safe = real(0, buffer[0]), real({SAFE!r}, buffer[0])"]
        for s, j in self.lane.ahead:
            base, mask = (s, "behind") if j == 1 else (f"{s}_1", "second")
            body += [
                f"source = buffer[_{s} + np.uint64(lo + {j} * w):]",
                f"target = buffer[_{s}_{j} + np.uint64(lo):]",
            ]
            if s in self.lane.linear:
                # conditions do not depend on tangents, so unused values do no harm
                body.append("copy(target, source, n)")
                continue
            away = "own[k] + safe" if s == "x" else "own[k]"
            body += [
                f"own, mask = buffer[_{base} + np.uint64(lo):], buffer[_{mask} + np.uint64(lo):]",
                "for k in range(n):",
                f"    target[k] = source[k] if mask[k] > zero else {away}",
            ]
        for s, ahead in self.lane.chained.items():
            body.append(
                f"copy(buffer[_{ahead} + np.uint64(lo):], buffer[_R_{s} + np.uint64(lo + w):], n)"
            )
        return _function("gather(buffer, lo, n, w)", *body, "return")

    def _rates(self) -> str:
        text = self.loop.function("follow", self.follower) + self.loop.function("first", self.first)
        arguments = "q, t, dt, drives, total)"
        last = f"first(buffer, (agents - 1) * w, {{}}, {arguments}"
        body = [
            "n = padded((agents - 1) * w)",
            "gather(buffer, 0, n, w)",
            f"follow(buffer, 0, n, {arguments}",
            last.format("padded(w)"),
        ]
        if self.recursive:
            body = [
                last.format("w"),
                "for i in range(agents - 2, -1, -1):",
                "    gather(buffer, i * w, w, w)",
                f"    follow(buffer, i * w, w, {arguments}",
            ]
        return text + _function("rates(buffer, q, t, dt, drives, w, agents, total)", *body)

    def _vjp(self) -> str:
        """The functions from adjoints A of increments to D, the adjoints of their inputs."""
        # a state's adjoint is read once, so its row can be overwritten
        rows = {f"A_{s}": s for s in self.states}
        rows |= {f"D_{i}": i for i in self.inputs if i not in self.states}
        grads = {f"G_{p}": p for p in self._simulation_parameters}
        kept = [f"A_{s}" for s in self.states] if self.stages != "rk4" else []

        def weight(row: str) -> str:
            return "RBAR" if row == "R_x" else f"A_{row[2:]}"

        text = self.loop.vjp(
            "follow_vjp", seeds(self.follower, weight), {**rows, **grads}, [*kept, *grads]
        )
        # the first row depends only on a leader's speed
        first_rows = [
            f"A_{s}" for s in self.states if not kept or s in symbols(self.first.values())
        ]
        text += self.loop.vjp(
            "first_vjp",
            seeds(self.first, weight),
            {**{row: row[2:] for row in first_rows}, **grads},
            [*(row for row in first_rows if row in kept), *grads],
        )
        arguments = "q, t, dt, drives, total)"
        if self.recursive:
            body = [
                "rates(buffer, q, t, dt, drives, w, agents, total)",
                "buffer[_RBAR:_RBAR + S] = 0",
                "for i in range(agents - 1):",
                f"    follow_vjp(buffer, i * w, w, {arguments}",
                "    copy(buffer[_RBAR + np.uint64((i + 1) * w):], "
                "buffer[_D_dx_1 + np.uint64(i * w):], w)",
                f"first_vjp(buffer, (agents - 1) * w, w, {arguments}",
            ]
        else:
            # followers' rows are computed in whole chunks, which reach into the first row; if they
            # overwrite adjoints, rows I store those of the first row in the meantime
            move = "copy(buffer[_{} + at:], buffer[_{} + at:], w)"
            waiting = [(row, f"I_{row[2:]}") for row in first_rows if row not in kept]
            body = [
                "n, at = padded((agents - 1) * w), np.uint64((agents - 1) * w)",
                "gather(buffer, 0, n, w)",
                *(move.format(place, row) for row, place in waiting),
                f"follow_vjp(buffer, 0, n, {arguments}",
                *(move.format(row, place) for row, place in waiting),
                f"first_vjp(buffer, (agents - 1) * w, padded(w), {arguments}",
            ]
        return text + _function("vjp(buffer, q, t, dt, drives, w, agents, total)", *body)

    def _scatter(self) -> list[str]:
        """Lines that add adjoints of gathered states to the adjoints of the vehicles ahead."""
        body = []
        for s, j in reversed(self.lane.ahead):
            if j == 2:
                body += [
                    f"share, other = buffer[_D_{s}_2:], buffer[_D_{s}_1:]",
                    "mask = buffer[_second:]",
                    "for k in range((agents - 1) * w):",
                    "    other[k] = other[k] + (zero if mask[k] > zero else share[k])",
                    "    share[k] = share[k] if mask[k] > zero else zero",
                ]
            body += [
                f"target, share = buffer[_A_{s} + np.uint64({j} * w):], buffer[_D_{s}_{j}:]",
                f"for k in range(max(agents - {j}, 0) * w):",
                "    target[k] = target[k] + share[k]",
            ]
        return body


def _function(signature: str, *body: str) -> str:
    return fill("lane", "function", signature=signature, body=list(body))


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
    source = LaneSource(lane, stages, per_simulation, _stride(size), forward_only=bool(tangents))
    numbers = [len(source.states) * steps * agents * w for *_, w, _ in blocks]
    places = np.cumsum([0, *numbers])

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
        jobs=shared_out(
            [
                (low, width, w, place, slot, run)
                for slot, ((low, width, w, run), place) in enumerate(
                    zip(blocks, places[:-1], strict=True)
                )
            ],
            threads,
        ),
        constants=(
            substeps,
            x.new_tensor(batch.dt / substeps).numpy()[()],
            x.new_tensor(float(not system.leader_measured)).numpy()[()],
            np.stack(fields) if fields else np.zeros((0, 1, 1), x.numpy().dtype),
            tiled(batch.agent.sum(1)),
            tiled(substeps * (batch.valid.any(-1).sum(0) - 1)),
            np.ascontiguousarray(path.numpy()),
        ),
        stored=int(places[-1]),
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


def _stride(size: int) -> int:
    """The distance of rows for ``size`` numbers and their padding."""
    for stride in _STRIDES:
        if size + _BEHIND <= stride:
            return stride
    return size + _BEHIND + 80 - size % 64
