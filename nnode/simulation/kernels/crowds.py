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
from nnode.simulation.kernels.loops import Loop
from nnode.simulation.kernels.runs import Plan, Simulate, Source, compiled, shared_out

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
#: Sign, array, row and index of a number.
_Part = tuple[str, str, int, str]


def _differences(names: Iterable[str]) -> dict[str, tuple[Expr, Expr]]:
    return {f"d{name}": (symbol(name), symbol(name)) for name in names}


#: A quantity to the receiver's and the source's terms, of which it is the difference.
_PARTS: dict[str, dict[str, tuple[Expr, Expr]]] = {
    OTHERS: _differences(_STATE),
    POINTS: {
        **_differences("xy"),
        **{name: (symbol(name), const(0)) for name in ("vx", "vy")},
        **{name: (const(0), -symbol(name)) for name in ("normal_x", "normal_y")},
    },
}


@dataclass(frozen=True)
class CrowdSource(Source):
    """Source code of a model.

    Attributes:
        law: flat.
        near: whether cell lists restrict interactions to neighbours, which excludes minima over
            others.
    """

    kind: ClassVar[str] = "crowd"
    chunk: ClassVar[int] = CHUNK
    size: ClassVar[int] = SIZE
    nobody: ClassVar[float] = NOBODY
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
    def kept(self) -> list[int]:
        """Rows of sums that the gradient needs, and that are therefore stored."""
        needed: list[Expr] = []
        for over in {"own", SMALLEST} & {*self.formulas}:
            rows = {f"D_{name}": name for name in self.slopes(over)}
            stored, ends = self.loop.adjoints(_weighted(self.formulas[over]), rows)
            needed += [*stored.values(), *ends.values()]
        inner = {*symbols(needed), *self.rows_of_sums[len(self.sums) :]}
        return [i for i, name in enumerate(self.rows_of_sums) if name in inner]

    @cached_property
    def loop(self) -> Loop:
        return Loop(self.uniform, options="LOOP", fixed=tuple(self.law.settings))

    def slopes(self, over: str) -> list[str]:
        """Quantities of formulas with an adjoint."""
        names = [*_RELATIVE.get(over, ()), *_STATE, *self.sums]
        used = set(symbols(self.formulas[over].values()))
        return [name for name in names if name in used]

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

    @property
    def names(self) -> list[str]:
        return [*self.rows, *self.uniform, *self.law.symbols]

    def functions(self, name: str, formulas: dict[str, Expr], slopes: list[str]) -> str:
        """Source of the functions that compute formulas for rows, and their gradients."""
        rows = {f"D_{n}": n for n in slopes}
        vjp = self.loop.vjp(f"{name}_vjp", _weighted(formulas), rows, [])
        return self.loop.function(name, formulas) + vjp

    def taken(self, over: str, by_index: bool) -> dict[str, list[_Part]]:
        """Row of the buffer to the numbers whose sum it is.

        Args:
            by_index: whether receivers and sources have lists of indices, instead of being
                contiguous.
        """
        at, to = ("at[j]", "to[j]") if by_index else ("at + j", "to + j")
        relative, neighbour_rows = _RELATIVE.get(over, ()), [*SEEN.get(over, ())]
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

    def weighted(self, over: str) -> dict[str, int]:
        """Sums whose summands have a gradient, and their indices."""
        return {n: self.sums.index(n) for n, s in self.over[over].items() if not s.is_number()}

    def side_features(
        self, over: str, side: str
    ) -> tuple[dict[str, Expr], dict[str, list[_Part]], list[str]]:
        """Features of receivers (``own``) or of sources: formulas, and as :meth:`taken` and
        :meth:`slopes`."""
        moves = over == OTHERS or side == "own"  # walls are constants
        formulas = {
            z: of_receiver if side == "own" else of_source
            for z, (of_receiver, of_source) in self.features[over].items()
        }
        used = symbols(formulas.values())
        taken: dict[str, list[_Part]] = {
            # relative to a person's position, because large numbers lose digits
            n: [("", "own", c, "at + j"), *([("-", "y", c, "0")] if c < 2 else [])]
            for c, n in enumerate(_STATE if moves else ("x", "y", "normal_x", "normal_y"))
            if n in used
        }
        return formulas, taken, [*taken] if moves else []

    def neuron(self, over: str) -> tuple[Expr, Expr]:
        """The function of a feature z that is summed, and its derivative."""
        value = apply(self.over[over][f"{over}_s0"].op, symbol("z"))
        return value, derivatives(value, ["z"])["z"]


def _weighted(formulas: Mapping[str, Expr]) -> dict[str, Expr]:
    """Row of a formula's weight to the formula."""
    return {f"W_{row}": formula for row, formula in formulas.items()}


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
            receiver, source = start, const(0)
            for part, weight in weights.items():
                of_receiver, of_source = parts[part.value]
                receiver, source = receiver + weight * of_receiver, source + weight * of_source
            features[over][f"{over}_z{k}"] = receiver, source
            sums[f"{over}_s{k}"] = apply(g.op, symbol(f"{over}_z{k}"))
        total = {}
        for name, (start, weights) in outer.items():
            total[name] = start * symbol(f"{over}_one")
            for g, weight in weights.items():
                total[name] = total[name] + weight * symbol(f"{over}_s{inner.index(g)}")
        x, y = (substitute(rate, total) for rate in law.rate)
        law = replace(law, rate=(x, y), sums={**law.sums, over: sums})
    return law, features


def _weights(node: Expr, is_uniform: Callable[[Expr], bool]) -> tuple[Expr, dict[Expr, Expr]]:
    """A node as a uniform constant and a weighted sum of other nodes, with uniform weights."""
    if is_uniform(node):
        return node, {}
    if node.op in ("add", "sub"):
        start, weights = _weights(node.args[0], is_uniform)
        second_start, others = _weights(node.args[1], is_uniform)
        sign = 1.0 if node.op == "add" else -1.0
        for part, weight in others.items():
            weights[part] = weights.get(part, const(0)) + sign * weight
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
