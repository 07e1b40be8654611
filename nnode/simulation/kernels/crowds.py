"""Simulations of crowds in compiled code.

The simulation of a crowd and its exact gradient are generated as source text. A step of Euler's
method has two parts: sums over other people, wall points and walls, for all pairs or for
neighbours; and accelerations from these sums. The gradients of both parts are generated from the
formulas. Receivers and sources of interactions are rows of arrays. Interactions are computed in a
buffer of rows of SIZE numbers, whose distances are compile-time constants. The compiler can then
prove that writes do not overlap later reads, and vectorises the loops.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.errors import ConfigError
from nnode.model.arrays import Formulas
from nnode.model.crowd_formula import people_of, settings_of, walls_of
from nnode.model.differentiate import derivatives
from nnode.model.expression import (
    Expr,
    apply,
    const,
    substitute,
    symbol,
    symbols,
    topological,
)
from nnode.model.laws import InteractionForce
from nnode.model.names import check_symbols
from nnode.model.operations import FUNCTIONS
from nnode.model.system import Crowd, System
from nnode.model.terms import (
    NOBODY,
    OTHERS,
    POINTS,
    SEEN,
    SMALLEST,
    WALLS,
    CrowdDynamics,
    parameter_values,
)
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

#: Smallest number of people for which social forces use cell lists. The lists are faster from 50
#: people on, but smaller crowds, and so most recordings, are computed exactly up to rounding.
LISTS_FROM = 200
#: Numbers in a row of the buffer; ten rows of float32 fit the first-level cache.
SIZE = 512
#: Rows are padded to a multiple of this, so that loops have no remainder.
CHUNK = 16
_STATE = ("x", "y", "vx", "vy")
_FIELDS = ("goal_x", "goal_y", "pace", "people", "points", "start")
#: Kind of neighbours to the relative quantities in sums, in the order of the neighbours' rows.
_APART = ("dx", "dy", "dvx", "dvy")
_RELATIVE = {OTHERS: _APART, POINTS: ("dx", "dy"), WALLS: ("dx", "dy"), SMALLEST: _APART}
_COUNT = {POINTS: "points", WALLS: "walls"}
#: Arguments that define the interactions in a driver: without cell lists, and with them.
_PARTNERS = {
    False: {
        OTHERS: "length, own_mask, y, own_mask, width, first, shifts",
        POINTS: "length, own_mask, rows_points, mask_points, width, 0, points",
        WALLS: "length, own_mask, rows_walls, mask_walls, width, 0, walls",
    },
    True: {
        OTHERS: "own, pairs, meetings",
        POINTS: "barriers, touched, touches",
        WALLS: "solid, every, every.shape[1]",
    },
}
#: Indices of receivers and sources: contiguous without cell lists, or from lists of pairs.
_AT = {False: ("at + j", "to + j"), True: ("at[j]", "to[j]")}
#: Sign, array, row and index of a number.
_Part = tuple[str, str, int, str]
#: A difference to the receiver's quantity and the source's quantity, of which one may be missing.
_PARTS = {
    OTHERS: {"dx": ("x", "x"), "dy": ("y", "y"), "dvx": ("vx", "vx"), "dvy": ("vy", "vy")},
    POINTS: {
        "dx": ("x", "x"),
        "dy": ("y", "y"),
        "vx": ("vx", ""),
        "vy": ("vy", ""),
        "normal_x": ("", "normal_x"),
        "normal_y": ("", "normal_y"),
    },
}


@dataclass(frozen=True)
class CrowdSource:
    """Source code of a model.

    Attributes:
        law: flat.
        near: whether cell lists restrict interactions to neighbours, which excludes minima over
            others.
    """

    kind: ClassVar[str] = "crowd"
    law: CrowdDynamics
    near: bool = False

    @cached_property
    def uniform(self) -> list[str]:
        """Symbols of the array ``q``."""
        return [*self.law.owned, *self.law.settings]

    @cached_property
    def _split(self) -> tuple[CrowdDynamics, dict[str, dict[str, tuple[Expr, Expr]]]]:
        # features do not reduce the cost of lists of pairs
        return (self.law, {}) if self.near else split(self.law, self.uniform)

    @property
    def features(self) -> dict[str, dict[str, tuple[Expr, Expr]]]:
        """Features of receivers and sources, for sums over functions of features."""
        return self._split[1]

    @cached_property
    def fields(self) -> list[str]:
        """People's properties, in the rows after their states."""
        names = [*_FIELDS, *self.law.inputs]
        return [n for n in names if {n, f"{n}_j"} & self.law.symbols]

    @cached_property
    def person_rows(self) -> list[str]:
        """All rows of a person."""
        return [*_STATE, *self.fields]

    @cached_property
    def over(self) -> dict[str, dict[str, Expr]]:
        """Kind of neighbours to the sums over them."""
        return {over: sums for over, sums in self._split[0].sums.items() if sums}

    @cached_property
    def formulas(self) -> dict[str, dict[str, Expr]]:
        """The sums, and under ``own`` both components of the acceleration."""
        x, y = self._split[0].rate
        return {**self.over, "own": {"O_x": x, "O_y": y}}

    @cached_property
    def sums(self) -> list[str]:
        return [name for sums in self.over.values() for name in sums]

    @property
    def rows_of_sums(self) -> list[str]:
        """The sums, and the indices of the people who attain minima."""
        return [*self.sums, *(f"who_{name}" for name in self.over.get(SMALLEST, ()))]

    @cached_property
    def antisymmetric(self) -> bool:
        """Whether the force is antisymmetric (Newton's third law): each pair is computed once."""
        pair = list(self.over.get(OTHERS, {}).values())
        if not pair or OTHERS in self.features:
            return False
        return _opposite(pair, [self.law.swapped(s) for s in pair])

    @cached_property
    def kept(self) -> list[str]:
        """Sums that the gradient needs, and that are therefore stored."""
        needed: list[Expr] = []
        for over in {"own", SMALLEST} & {*self.formulas}:
            stored, ends = self.loop.adjoints(
                seeds(self.formulas[over], _weight), self._slopes(over)
            )
            needed += [*stored.values(), *ends.values()]
        inner = {*symbols(needed), *self.rows_of_sums[len(self.sums) :]}
        return [name for name in self.rows_of_sums if name in inner]

    @cached_property
    def loop(self) -> Loop:
        return Loop(self.uniform, options="LOOP", fixed=tuple(self.law.settings))

    def _slopes(self, over: str) -> dict[str, str]:
        """Row of an adjoint to its quantity."""
        names = [*_RELATIVE.get(over, ()), *_STATE, *self.sums]
        used = set(symbols(self.formulas[over].values()))
        return {f"D_{name}": name for name in names if name in used}

    @cached_property
    def rows(self) -> list[str]:
        """All rows of the buffer."""
        relative = dict.fromkeys(name for over in self.over for name in SEEN[over])
        features = [z for numbers in self.features.values() for z in numbers]
        state = [*self.person_rows, *relative, *(f"{n}_j" for n in self.law.inputs), *features]
        outputs = [*self.sums, "O_x", "O_y"]
        weights = [f"W_{name}" for name in (*outputs, *features)]
        slopes = [f"D_{name}" for name in (*_STATE, *relative, *self.sums)]
        return [*state, *outputs, *weights, *slopes]

    # -- text ------------------------------------------------------------------------------------

    def text(self) -> str:
        """The module's source.

        Raises:
            ConfigError: a name in the formulas is not a valid symbol.
        """
        law = self.law
        check_symbols([*self.rows, *self.uniform, *law.symbols])
        state = "v" if law.order == 2 else ""
        formula = [f"d{state}{a}/dt = {plain(r)}" for a, r in zip("xy", law.rate, strict=True)]
        for over, sums in self.over.items():
            what = "smallest over others of" if over == SMALLEST else f"sum over {over} of"
            formula += [f"{plain(symbol(n))} = {what} {plain(s)}" for n, s in sums.items()]
        whom = "near" if self.near else "everybody"
        text = head(
            "crowd",
            formula,
            CHUNK,
            [f"_{r} = np.uint64({i * SIZE})" for i, r in enumerate(self.rows)],
            size=SIZE,
            rows=len(self.rows),
            kept=[self.rows_of_sums.index(name) for name in self.kept],
        )
        text += fill("crowd", "rows") + fill("crowd", whom)
        for over in self.formulas:
            if over in self.features:
                text += self._neurons(over)
                continue
            text += self._functions(f"law_{over}", self.formulas[over], self._slopes(over))
            match over:
                case "own":
                    text += self._rates()
                case _ if over == SMALLEST:
                    text += self._smallest()
                case _:
                    text += self._pairs(over, whom)
        return text + fill("crowd", "simulate", **self._drivers(whom))

    def _functions(self, name: str, formulas: dict[str, Expr], slopes: dict[str, str]) -> str:
        """Functions that compute formulas for rows, and their gradients."""
        vjp = self.loop.vjp(f"{name}_vjp", seeds(formulas, _weight), slopes, [])
        return self.loop.function(name, formulas) + vjp

    def _taken(self, over: str, near: bool) -> dict[str, list[_Part]]:
        """Row of the buffer to the numbers whose sum it is."""
        relative, neighbour_rows = _RELATIVE.get(over, ()), [*SEEN.get(over, ())]
        at, to = _AT[near]
        taken: dict[str, list[_Part]] = {}
        for n in symbols(self.formulas[over].values()):
            if n in relative:
                c = relative.index(n)
                taken[n] = [("", "own", c, at), ("-", "other", c, to)]
            elif n in neighbour_rows:
                taken[n] = [("", "other", neighbour_rows.index(n), to)]
            elif n in self.person_rows:
                taken[n] = [("", "own", self.person_rows.index(n), at)]
            elif n[:-2] in self.person_rows and n.endswith("_j"):
                taken[n] = [("", "other", self.person_rows.index(n[:-2]), to)]
            elif n in self.sums and over in (SMALLEST, "own"):
                taken[n] = [("", "sums", self.sums.index(n), at)]
        return taken

    def _scattered(self, over: str, near: bool, *arrays: str) -> list[str]:
        """Lines that add adjoints in the buffer to the adjoints of the source arrays."""
        taken = self._taken(over, near)
        return _scatter({n: taken[n] for n in self._slopes(over).values()}, *arrays)

    def _pairs(self, over: str, whom: str) -> str:
        """Functions for the sums over pairs and their gradients, for a block and for all pairs."""
        at, to = _AT[self.near]
        antisymmetric = self.antisymmetric and over == OTHERS
        other_weight, own_weight = (
            ("", "") if self.near else (f"other_mask[{to}] * ", f"own_mask[{at}] * ")
        )
        add, weights = [], {}
        for n, summand in self.over[over].items():
            c = self.sums.index(n)
            add.append(_increase("sums", c, at, f"+ {other_weight}buffer[_{n} + j]"))
            weight = f"{other_weight}weight[{c}, {at}]"
            if antisymmetric:
                add.append(_increase("reaction", c, to, f"- {own_weight}buffer[_{n} + j]"))
                weight += f" - {own_weight}weight[{c}, {to}]"
            if not summand.is_number():
                weights[n] = weight
        moving = ["other"] if over == OTHERS else []  # walls are constants
        text = fill(
            "crowd",
            "pairs",
            over=over,
            gather=_gather(self._taken(over, self.near)),
            add=_each(add),
            weights=_weighted(weights),
            scatter=self._scattered(over, self.near, "own", *moving),
        )
        for end, arrays in (("", "sums, reaction"), ("_vjp", "weight, to_own, to_other")):
            text += fill(
                "crowd", f"meet {whom}", name=over + end, rest=arrays, antisymmetric=antisymmetric
            )
        return text

    def _smallest(self) -> str:
        """Functions for minima over the others, and their gradients."""
        names, first, who = [*self.over[SMALLEST]], self.sums.index, len(self.sums)
        return fill(
            "crowd",
            "smallest",
            number=len(names),
            first=first(names[0]),
            who=who,
            nobody=NOBODY,
            gather=_gather(self._taken(SMALLEST, False)),
            smaller=[
                f"neighbour_min(sums[{first(n)}], sums[{who + r}], low, own_mask, start, length, "
                f"buffer[_{n}:], n)"
                for r, n in enumerate(names)
            ],
            gather_pairs=_gather(self._taken(SMALLEST, True)),
            weights=_weighted(
                {
                    n: f"to_sums[{first(n)}, at[j]] if which == {r} else real(0, dt)"
                    for r, n in enumerate(names)
                }
            ),
            scatter=self._scattered(SMALLEST, True, "own", "sums", "other"),
        )

    def _neurons(self, over: str) -> str:
        """Functions for features of receivers and sources, for sums of functions of their
        differences, and for the gradients."""
        text, features = "", self.features[over]
        for side, whose in enumerate(("own", "other")):
            formulas = {z: feature[side] for z, feature in features.items()}
            moves = over == OTHERS or whose == "own"  # walls are constants
            columns = _STATE if moves else ("x", "y", "normal_x", "normal_y")
            used = set(symbols(formulas.values()))
            taken: dict[str, list[_Part]] = {
                # relative to a person's position, because large numbers lose digits
                n: [("", "own", c, "at + j"), *([("-", "y", c, "0")] if c < 2 else [])]
                for c, n in enumerate(columns)
                if n in used
            }
            name = f"features_{whose}_{over}"
            slopes = {f"D_{n}": n for n in taken if moves}
            text += self._functions(name, formulas, slopes)
            text += fill(
                "crowd",
                "features",
                name=f"{whose}_{over}",
                gather=_gather(taken),
                store=_each(
                    f"features[{i}, at + j] = buffer[_{z} + j]" for i, z in enumerate(features)
                ),
                weights=_weighted({z: f"weight[{i}, at + j]" for i, z in enumerate(features)}),
                scatter=_scatter(taken if moves else {}, "own"),
            )
        value = apply(self.over[over][f"{over}_s0"].op, symbol("z"))
        return text + fill(
            "crowd",
            "neurons",
            over=over,
            first=self.sums.index(f"{over}_one"),
            value=self.loop.of_numbers("value", value),
            slope=self.loop.of_numbers("slope", derivatives(value, ["z"])["z"]),
        )

    def _rates(self) -> str:
        """Functions for accelerations from sums, and their gradient."""
        return fill(
            "crowd",
            "rates",
            gather=_gather(self._taken("own", False)),
            store=_each(f"rate[{i}, at + j] = buffer[_O_{a} + j]" for i, a in enumerate("xy")),
            weights=_weighted({f"O_{a}": f"weight[{i}, at + j]" for i, a in enumerate("xy")}),
            scatter=self._scattered("own", False, "own", "sums"),
        )

    def _drivers(self, whom: str) -> dict[str, Any]:
        """Values of the template of the time loops."""
        near, number, second = self.near, len(self.rows_of_sums), self.law.order == 2
        barriers, meet, back = [], [], []
        for over in self.over:
            if over == SMALLEST:
                continue
            if near and over == POINTS:
                lists = (
                    "touched, touches = points_near(own[0], own[1], barriers[0], barriers[1], "
                    "cells, start, cutoff_wall, touched)"
                )
                meet.append(lists)
                back.append(lists)
            elif not near and over != OTHERS:
                table = f"barrier(members, people, {_COUNT[over]}, table_{over})"
                barriers.append(f"rows_{over}, mask_{over} = {table}")
            if over in self.features:
                others = over == OTHERS
                pieces = {
                    "over": over,
                    "number": len(self.features[over]),
                    "size": "2 * length" if others else f"rows_{over}.shape[1]",
                    "rows": "y" if others else f"rows_{over}",
                    "partners": "own_mask, width, first, shifts"
                    if others
                    else f"mask_{over}, width, 0, {_COUNT[over]}",
                }
                barriers += fill("crowd", "neurons begin", **pieces).splitlines()
                meet += fill("crowd", "neurons meet", **pieces).splitlines()
                back += fill("crowd", "neurons back", **pieces).splitlines()
                end = "others" if others else "barriers"
                back += fill("crowd", f"neurons back to {end}", **pieces).splitlines()
                continue
            call = f"buffer, own, {_PARTNERS[near][over]}, q, time, dt, total"
            meet.append(f"meet_{over}({call}, sums, reaction)")
            back.append(f"meet_{over}_vjp({call}, to_sums, to_own, to_other)")
        if not near:
            meet += ["accumulate(sums, reaction, length)"] if self.antisymmetric else []
            back = [f"repeat(to_sums, {number}, length)", *back]
            back.append("accumulate(to_own, to_other, length)")
        if SMALLEST in self.over:
            call = "buffer, y, length, own_mask, width, q, time, dt, total, sums"
            meet.append(f"least({call})")
            back.insert(0, f"least_vjp({call}, to_sums, to_own, to_other)")
        inner = {"width": len(self.person_rows), "antisymmetric": self.antisymmetric}
        return {
            "scene": fill("crowd", f"scene {whom}", **inner).splitlines(),
            "arrange": fill("crowd", f"arrange {whom}", **inner).splitlines(),
            "barriers": barriers,
            "rows_of": "scattered" if near else "zeros",
            "twice": 1 if near else 2,
            "reaction": "sums" if near else f"zeros({number}, 2 * length, y0)",
            "to_other": "to_own" if near else "zeros(4, 2 * length, grad_y0)",
            "sums": number,
            "kept_width": 4 + len(self.kept),
            "meet": meet,
            "meet_vjp": back,
            "moved": "2 + c" if second else "c",
            "place": "y[c, t] += move[t] * y[2 + c, t]" if second else "pass",
            "place_vjp": "adjoint[2 + c, t] += move[t] * adjoint[c, t]" if second else "pass",
        }


def _weight(row: str) -> str:
    return f"W_{row}"


def _increase(array: str, row: int, at: str, value: str) -> str:
    return f"{array}[{row}, {at}] = {array}[{row}, {at}] {value}"


def _each(body: Iterable[str], numbers: str = "np.uint64(n)") -> list[str]:
    """One loop over pairs per line. In a loop over several rows, the compiler cannot prove that
    they do not overlap."""
    return [line for row in body for line in (f"for j in range({numbers}):", f"    {row}")]


def _gather(taken: Mapping[str, Sequence[_Part]]) -> list[str]:
    """Lines that fill rows of the buffer."""
    sums = {
        row: " ".join(f"{sign} {array}[{c}, {at}]" for sign, array, c, at in parts)
        for row, parts in taken.items()
    }
    return _each(f"buffer[_{row} + j] = {parts.strip()}" for row, parts in sums.items())


def _scatter(taken: Mapping[str, Sequence[_Part]], *arrays: str) -> list[str]:
    """Lines that add adjoints in the buffer to the adjoints of the source arrays."""
    return _each(
        _increase(f"to_{array}", c, at, f"{sign or '+'} buffer[_D_{row} + j]")
        for array in arrays
        for row, parts in taken.items()
        for sign, source, c, at in parts
        if source == array
    )


def _weighted(weights: Mapping[str, str]) -> list[str]:
    """Lines that fill rows of weights, with zeros for padding."""
    body = [f"buffer[_W_{row} + j] = {weight}" for row, weight in weights.items()]
    ends = [f"buffer[_W_{row} + j] = 0" for row in weights]
    return _each(body) + _each(ends, "np.uint64(n), np.uint64(padded(n))")


def _opposite(pair: list[Expr], swapped: list[Expr]) -> bool:
    """Whether formulas are each other's negative, tested numerically for eight random inputs."""
    generator = torch.Generator().manual_seed(0)
    values = {
        node.value: 0.5 * torch.randn(8, generator=generator, dtype=torch.float64)
        if node.value.startswith(("d", "v"))
        else 0.3 + torch.rand(8, generator=generator, dtype=torch.float64)
        for node in topological([*pair, *swapped])
        if node.op == "symbol"
    }
    if not values:
        return False
    return all(
        torch.allclose(a, -b, rtol=1e-9, atol=1e-12)
        for a, b in zip(Formulas(pair)(values), Formulas(swapped)(values), strict=True)
    )


# -- runs ------------------------------------------------------------------------------------------


def supports(system: System, batch: Batch | None = None) -> CrowdDynamics | None:
    """The formula of a model that compiled code covers; None for other models."""
    if type(system) is not Crowd or system.neighbours != "simulated":
        return None
    tensors: list[Tensor] = list(system.parameters())
    if batch is not None:
        tensors.append(batch.x)
        if batch.destination.requires_grad or batch.walls.requires_grad:
            return None  # compiled code has no gradient by these
    law = system.formula
    if any(t.device.type != "cpu" for t in tensors) or law is None or without_partners(system):
        return None  # PyTorch is cheap without interactions
    force = system.find(InteractionForce)
    # self-interaction must not apply to sums other than those of the force
    alone = len(law.sums[OTHERS]) == 2 or force is None or not force.self_interaction
    return law if alone else None


def without_partners(system: System) -> bool:
    """Whether a crowd model has no interactions between people, so that a cutoff has no effect."""
    law = system.formula if isinstance(system, Crowd) else None
    return law is not None and not (law.sums[OTHERS] or law.sums[SMALLEST])


def simulate(
    system: System,
    law: CrowdDynamics,
    batch: Batch,
    substeps: int,
    threads: int = 1,
    cutoff: float | None = None,
    cutoff_error: float = 1e-10,
) -> Tensor:
    """Simulate a crowd model with the formula ``law`` (see :func:`supports`), by Euler's method.

    The gradient with respect to the parameters and the initial state is that of the discrete
    scheme. Without a cutoff, all pairs are computed for fewer than LISTS_FROM people, and for
    models in which other terms than a social force act between people. Other models use cell
    lists, which omit social forces below ``cutoff_error`` times A. See
    :func:`nnode.simulation.kernels.crowds.cutoff_distance` for the bound of their sum.

    Args:
        substeps: Euler steps in a sampling interval.
        threads: largest number of threads for blocks of simulations.
        cutoff: distance (m) beyond which people do not interact with each other and with wall
            points. This changes the model if forces do not decay, as those of a network.
        cutoff_error: largest omitted force of one partner, in units of A; 0 computes all pairs.

    Returns:
        ``(K, B, N, M)`` states at the samples, m and m/s; only positions for a law of first order.
        Padding people do not move.

    Raises:
        ConfigError: a cutoff that is not positive or omits contacts, a cutoff for a law with
            minima over others, or an error outside [0, 1).
    """
    terms, scene = system.term_list, system.scene(batch)
    y0 = system.initial(batch)
    if law.order == 1:
        y0 = torch.cat([y0, torch.zeros_like(y0)], -1)  # the rows of velocities are unused
    kind = y0.dtype
    walls, wall_exists = walls_of(scene)
    counts = [_last(mask) for mask in (scene.agent, scene.wall_point, wall_exists)]
    people = int(counts[0].max())
    distances = _distances(system, law, cutoff, cutoff_error, people)
    source = CrowdSource(law, bool(distances))
    if WALLS not in source.over:
        counts[2] = 0 * counts[2]
    # blocks with rows of about SIZE numbers, and at least one block per thread
    width = min(max(1, SIZE // max(people, 1)), -(-len(y0) // threads))
    width = 1 if distances else width // CHUNK * CHUNK if width > CHUNK else width
    order = np.argsort(-counts[0], kind="stable")
    kept = substeps * (batch.n_samples - 1) * (4 + len(source.kept))
    blocks: list[tuple[int, ...]] = []
    stored = 0
    for low in range(0, len(order), width):
        members = order[low : low + width]
        most, *barriers = (int(number[members].max()) for number in counts)
        slot = len(blocks) % threads
        blocks.append((low, len(members), most, stored, slot, 0, *barriers))
        stored += kept * most * len(members)
    jobs = shared_out(blocks, threads)
    force = system.find(InteractionForce)
    alone = force is None or not force.self_interaction
    inputs = people_of(terms, law, scene)
    # the last row is dropped; it gives the shape if there are no fields
    fields = [inputs[name].to(kind).expand(scene.agent.shape) for name in source.fields]
    present = scene.agent.to(kind)
    plan = Plan(
        module=compiled(source),
        jobs=jobs,
        constants=(
            substeps,
            _scalar(y0, batch.dt / substeps),
            order,
            torch.stack([*fields, present])[: len(fields)].numpy(),
            present.numpy(),
            _table(scene.wall, scene.wall_normal, scene.wall_point, kind),
            _table(walls[..., :2], walls[..., 2:], wall_exists, kind),
            substeps * (batch.valid.any(-1).sum(0).numpy() - 1),
            1 if alone else 0,  # 0 includes interactions of people with themselves
            *(_scalar(y0, d) for d in distances or (0.0, 0.0)),
        ),
        stored=stored,
        samples=batch.n_samples,
        owner=np.zeros(len(jobs), int),
        padding=~scene.agent.numpy(),
    )
    fixed = [y0.new_tensor(value) for value in settings_of(terms, law).values()]
    q = torch.stack([*parameter_values(terms, law).values(), *fixed]).to(kind)
    y: Tensor = Simulate.apply(plan, y0.permute(2, 0, 1), q[None]).permute(1, 2, 3, 0).contiguous()
    return y[..., : 2 * law.order]


def _table(place: Tensor, columns: Tensor, exists: Tensor, kind: torch.dtype) -> np.ndarray:
    table = torch.cat([place, columns, exists.to(place.dtype)[..., None]], -1)
    return np.ascontiguousarray(table.to(kind).numpy())


def _scalar(like: Tensor, value: float) -> Any:
    return like.new_tensor(value).numpy()[()]


def _last(mask: Tensor) -> np.ndarray:
    """``(B,)``: one more than the index of the last True in every row."""
    index = torch.arange(1, mask.shape[1] + 1)
    return np.asarray((index * mask).amax(1).numpy()) if mask.shape[1] else np.zeros(len(mask), int)


def _distances(
    system: System, law: CrowdDynamics, cutoff: float | None, cutoff_error: float, people: int
) -> tuple[float, ...]:
    """Cutoffs for pairs and for wall points, m; empty if all pairs are computed."""
    social: Any = system.find_law("social_force")
    check_cutoff(cutoff, cutoff_error, 2 * social.r if social else 0.0)
    if cutoff is not None:
        if law.sums[SMALLEST]:
            raise ConfigError(
                f"solver.cutoff={cutoff:g} m: this law has smallest values over the others, and "
                "whoever attains one may stand farther away; set it to null"
            )
        return cutoff, cutoff
    # the range of other sums is unknown
    others = len(law.sums[OTHERS]) > 2 or bool(law.sums[SMALLEST])
    if social is None or others or cutoff_error == 0 or people < LISTS_FROM:
        return ()
    reaches = (2 * social.r, social.r)
    pair, wall = (cutoff_distance(reach, social.B, cutoff_error) for reach in reaches)
    return pair, wall


def check_cutoff(cutoff: float | None, cutoff_error: float, touching: float = 0.0) -> None:
    """Check a cutoff.

    Args:
        cutoff: m, or None.
        cutoff_error: largest omitted force of one partner, in units of A.
        touching: distance of people who touch, m; a cutoff must not omit contacts.

    Raises:
        ConfigError: ``cutoff`` is not a number larger than ``touching``, or ``cutoff_error``
            lies outside [0, 1).
    """
    if cutoff is not None and not touching < cutoff < math.inf:
        raise ConfigError(
            f"solver.cutoff={cutoff} m must be larger than {touching:g} m"
            + (", the distance of people who touch" if touching else "")
            + "; null derives it from solver.cutoff_error"
        )
    if not 0 <= cutoff_error < 1:
        raise ConfigError(
            f"solver.cutoff_error={cutoff_error} must be at least 0 and below 1, for example 1e-10"
        )


def cutoff_distance(reach: float, decay: float, cutoff_error: float) -> float:
    """Distance (m) beyond which a social force is omitted.

    The force of one partner at distance d is A exp((reach - d) / B) in the far field. Contact
    forces and friction end at d = reach. Beyond

        reach + B log(1 / cutoff_error)

    one partner's force is below ``cutoff_error`` A, so with N people

    * the sum of the omitted forces on one person is below N ``cutoff_error`` A: 1e-6 of the
      force A of a single touching partner for 10,000 people and the default of 1e-10;
    * the error of the acceleration, a mean over the N people, is below ``cutoff_error`` A / m.

    Both bounds hold for every arrangement of people. At one person per square metre, people beyond
    the cutoff c contribute about 2 pi c B ``cutoff_error`` A, for any N.

    Args:
        reach: distance at which bodies touch, m.
        decay: B, m.
        cutoff_error: largest omitted force of one partner, in units of A; above 0.
    """
    return reach + decay * math.log(1 / cutoff_error)


# -- networks --------------------------------------------------------------------------------------


def split(
    law: CrowdDynamics, uniform: Sequence[str]
) -> tuple[CrowdDynamics, dict[str, dict[str, tuple[Expr, Expr]]]]:
    """Rewrite sums over pairs as sums over functions of features, as for a network's neurons.

    A feature is the difference of a number of the receiver and a number of the source, which are
    computed once per person instead of once per pair.

    Args:
        uniform: symbols with one value for all people.

    Returns:
        The law with rewritten sums, where this is possible; and kind of neighbours to the symbols
        of features and their (receiver's, source's) formulas.
    """
    uniform_symbols = {*uniform, "t"}

    def is_uniform(node: Expr) -> bool:
        return uniform_symbols.issuperset(symbols([node]))

    features: dict[str, dict[str, tuple[Expr, Expr]]] = {}
    if law.sums[SMALLEST]:
        return law, features  # minima may contain the sums
    for over, parts in _PARTS.items():
        summands = law.sums[over]
        outer = {name: _weights(summand, is_uniform) for name, summand in summands.items()}
        inner = list(dict.fromkeys(g for _, weights in outer.values() for g in weights))
        if not inner or FUNCTIONS.get(inner[0].op) != 1 or len({g.op for g in inner}) > 1:
            continue
        numbers = [_weights(g.args[0], is_uniform) for g in inner]
        if not all(s.op == "symbol" and s.value in parts for _, w in numbers for s in w):
            continue
        features[over], sums = {}, {f"{over}_one": const(1)}
        for k, (g, (start, weights)) in enumerate(zip(inner, numbers, strict=True)):
            features[over][f"{over}_z{k}"] = _feature(parts, start, weights)
            sums[f"{over}_s{k}"] = apply(g.op, symbol(f"{over}_z{k}"))
        total = {}
        for name, (start, weights) in outer.items():
            total[name] = start * symbol(f"{over}_one")
            for g, weight in weights.items():
                total[name] = total[name] + weight * symbol(f"{over}_s{inner.index(g)}")
        x, y = (substitute(rate, total) for rate in law.rate)
        law = replace(law, rate=(x, y), sums={**law.sums, over: sums})
    return law, features


def _feature(
    parts: Mapping[str, tuple[str, str]], start: Expr, weights: Mapping[Expr, Expr]
) -> tuple[Expr, Expr]:
    """The receiver's and the source's part of a feature."""
    receiver, source = start, const(0)
    for part, weight in weights.items():
        receiver_symbol, source_symbol = parts[part.value]
        receiver = receiver + weight * symbol(receiver_symbol) if receiver_symbol else receiver
        if source_symbol:
            source = (
                source + weight * symbol(source_symbol)
                if receiver_symbol
                else source - weight * symbol(source_symbol)
            )
    return receiver, source


def _weights(node: Expr, is_uniform: Callable[[Expr], bool]) -> tuple[Expr, dict[Expr, Expr]]:
    """A node as a uniform constant and a weighted sum of other nodes, with uniform weights."""
    if is_uniform(node):
        return node, {}
    if node.op in ("add", "sub"):
        start, weights = _weights(node.args[0], is_uniform)
        second_start, others = _weights(node.args[1], is_uniform)
        sign = 1.0 if node.op == "add" else -1.0
        for part, weight in others.items():
            weight = sign * weight
            weights[part] = weights[part] + weight if part in weights else weight
        return start + sign * second_start, weights
    if node.op == "neg":
        start, weights = _weights(node.args[0], is_uniform)
        return -start, {part: -weight for part, weight in weights.items()}
    if node.op == "mul":
        for factor, other in (node.args, node.args[::-1]):
            if is_uniform(factor):
                start, weights = _weights(other, is_uniform)
                return factor * start, {part: factor * weight for part, weight in weights.items()}
    return const(0), {node: const(1)}
