"""Crowds in compiled code: blocks of simulations, threads, neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nnode.data.sequence import Batch
from nnode.errors import ConfigError
from nnode.model.crowd_dynamics import OTHERS, SMALLEST, WALLS, CrowdDynamics
from nnode.model.crowd_formula import people_of, settings_of, walls_of
from nnode.model.formula import crowd_of, own_values, values_of
from nnode.model.laws import InteractionForce
from nnode.model.scene import Scene
from nnode.model.system import Crowd, System
from nnode.model.term import Term
from nnode.simulate.kernels import functions
from nnode.simulate.kernels.cache import digest, keep
from nnode.simulate.kernels.crowds import cells, least
from nnode.simulate.kernels.crowds import rows as crowd_rows
from nnode.simulate.kernels.crowds.cells import check_cutoff, cutoff_distance
from nnode.simulate.kernels.crowds.rows import LANES, SIZE
from nnode.simulate.kernels.crowds.source import CrowdSource
from nnode.simulate.kernels.threads import run_all

#: From so many people on, social forces use cell lists. They are faster for 50 already; smaller
#: crowds, and so most recordings, are exact to rounding instead.
LISTS_FROM = 200
#: Compiled into every module besides its own text.
_COMPILED_IN = (crowd_rows, least, cells, functions)


@cache
def compiled(source: CrowdSource) -> ModuleType:
    """The module of a source.

    Raises:
        ConfigError: the cache folder cannot be written.
    """
    text = source.text().encode()
    return keep(f"nnode_crowd_{digest(text, list(_COMPILED_IN))}", text)


def supports(system: System, batch: Batch | None = None) -> CrowdDynamics | None:
    """The formula of a model that is simulated in compiled code; None: it is not."""
    if type(system) is not Crowd or system.neighbours != "simulated":
        return None
    tensors: list[Tensor] = list(system.parameters())
    if batch is not None:
        tensors.append(batch.x)
        if batch.destination.requires_grad or batch.walls.requires_grad:
            return None  # both are constants here
    if any(tensor.device.type != "cpu" for tensor in tensors):
        return None
    terms = cast(list[Term], list(system.terms))
    law = crowd_of(terms)
    if law is None or not (law.sums[OTHERS] or law.sums[SMALLEST]):
        return None  # nobody meets anybody: cheap in PyTorch
    force = system.find(InteractionForce)
    # only the sums of the force are over oneself as well
    alone = len(law.sums[OTHERS]) == 2 or force is None or not force.self_interaction
    return law if alone else None


def without_partners(system: System) -> bool:
    """Whether nobody meets anybody in this model, so that a cutoff changes nothing."""
    if not isinstance(system, Crowd):
        return False
    law = crowd_of(cast(list[Term], list(system.terms)))
    return law is not None and not (law.sums[OTHERS] or law.sums[SMALLEST])


@dataclass(frozen=True)
class _Plan:
    """Everything of a simulation that carries no gradient.

    Attributes:
        module: the compiled functions.
        jobs: for every thread rows of first place in ``order``, simulations, people, wall
            points, walls, place in the stored states, number of the thread.
        order: simulations in the order in which they are cut into blocks.
        size: numbers of stored states.
        per: steps in a sampling interval.
        dt: step, s.
        fields: ``(B, N, F)`` what people have.
        real: ``(B, N)`` 1 for real people.
        points, walls: ``(B, P, 5)`` place, normal or way to the second end, and 1 for real ones.
        end: ``(B,)`` last step in which a sequence moves.
        first: 0 lets people meet themselves as well, otherwise 1.
        cutoff: distances of pairs and of wall points, m; 0 where everybody meets everybody.
        samples: K.
    """

    module: Any
    jobs: tuple[np.ndarray, ...]
    order: np.ndarray
    size: int
    per: int
    dt: Any
    fields: np.ndarray
    real: np.ndarray
    points: np.ndarray
    walls: np.ndarray
    end: np.ndarray
    first: int
    cutoff: tuple[Any, Any]
    samples: int


class _Simulate(torch.autograd.Function):
    """Euler's method and the exact gradient of what it computes."""

    @staticmethod
    def forward(ctx: Any, plan: _Plan, y0: Tensor, q: Tensor) -> Tensor:
        start, values = (np.ascontiguousarray(t.detach().numpy()) for t in (y0, q))
        keeps = any(ctx.needs_input_grad)
        # NumPy asks for huge pages, which are far faster to touch for the first time
        states = np.empty(plan.size if keeps else 0, start.dtype)
        # whoever is not computed, because he is padding, stays where he is
        still = y0.detach().expand(plan.samples, *y0.shape)
        out = still.clone(memory_format=torch.contiguous_format)

        def call(jobs: np.ndarray) -> None:
            plan.module.forward(
                jobs, plan.order, plan.per, plan.dt, start, plan.fields, plan.real, plan.points,
                plan.walls, plan.end, plan.first, values, states, out.numpy(), *plan.cutoff,
            )  # fmt: skip

        run_all(call, plan.jobs)
        ctx.plan, ctx.states, ctx.values = plan, states, values
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        plan: _Plan = ctx.plan
        grad_out = np.ascontiguousarray(grads[0].numpy())
        grad_y0 = np.zeros(grad_out.shape[1:], grad_out.dtype)
        # sums over all steps are kept in float64 whatever the precision of the states
        totals = np.zeros((len(plan.jobs), len(ctx.values)))

        def call(jobs: np.ndarray) -> None:
            plan.module.backward(
                jobs, plan.order, plan.per, plan.dt, plan.fields, plan.real, plan.points,
                plan.walls, plan.end, plan.first, ctx.values, ctx.states, grad_out, grad_y0,
                totals[jobs[0, 6]], *plan.cutoff,
            )  # fmt: skip

        run_all(call, plan.jobs)
        padding = plan.real == 0
        grad_y0[padding] = grad_out[:, padding].sum(0)
        share = torch.from_numpy(totals.sum(0)).to(grads[0].dtype)
        return None, torch.from_numpy(grad_y0), share


def _layout(
    order: np.ndarray, counts: np.ndarray, kept: int, width: int, threads: int
) -> tuple[tuple[np.ndarray, ...], int]:
    """Jobs of every thread, and the size of all that is stored, ``kept`` numbers a person.

    Args:
        counts: ``(3, B)`` people, wall points, walls.
    """
    rows: list[tuple[int, ...]] = []
    place = 0
    for low in range(0, len(order), width):
        members = order[low : low + width]
        most, points, walls = (int(number) for number in counts[:, members].max(1))
        # blocks come sorted by size: dealt out in turn, every thread has its share of large ones
        rows.append((low, len(members), most, points, walls, place, len(rows) % threads))
        place += kept * most * len(members)
    table = np.array(rows, dtype=np.int64)
    number = min(threads, len(table))
    return tuple(np.ascontiguousarray(table[i::number]) for i in range(number)), place


def _width(simulations: int, people: int, threads: int) -> int:
    """Simulations in a block: rows of about SIZE numbers, and work for every thread."""
    most = min(max(1, SIZE // max(people, 1)), -(-simulations // threads))
    return most // LANES * LANES if most > LANES else most


def simulate(
    system: System,
    law: CrowdDynamics,
    batch: Batch,
    substeps: int,
    threads: int = 1,
    cutoff: float | None = None,
    cutoff_error: float = 1e-10,
) -> tuple[Tensor, Tensor | None]:
    """Simulate a crowd model with the formula ``law`` (see :func:`supports`), by Euler's method.

    The gradient with respect to the parameters and the initial state is that of the discrete
    scheme. Simulations of fewer than LISTS_FROM people, and all models without a cutoff in which
    more than a social force acts between people, let everybody meet everybody. Others use cell
    lists: social forces that are smaller than ``cutoff_error`` times A are left out. See
    :func:`nnode.simulate.kernels.crowds.cells.cutoff_distance` for the bound of the sum.

    Args:
        substeps: Euler steps in a sampling interval.
        threads: at most so many threads compute blocks of simulations.
        cutoff: m; pairs, and people and wall points, that are farther apart do not interact,
            whatever the number of people. Where nothing makes a force decay, as that of a
            network, this changes the model.
        cutoff_error: largest force of one partner that is left out, in units of A; 0 lets
            everybody meet everybody.

    Returns:
        x and v at the samples, ``(K, B, N, 2)`` m and m/s; None for v of a law of first order.
        Padding people stand still.

    Raises:
        ConfigError: a cutoff that is not positive or leaves out contacts, or of a law with
            smallest values over others, or an error outside [0, 1).
    """
    terms, scene = cast(list[Term], list(system.terms)), system.scene(batch)
    y0 = system.initial(batch)
    if law.order == 1:
        y0 = torch.cat([y0, torch.zeros_like(y0)], -1)  # rows of velocities stay empty
    kind, simulations = y0.dtype, len(y0)
    walls, wall_there = walls_of(scene)
    people = _last(scene.agent)
    counts = np.stack([people, _last(scene.wall_point), _last(wall_there)])
    distances = _distances(system, law, cutoff, cutoff_error, int(people.max()))
    source = CrowdSource(law, bool(distances))
    if WALLS not in source.over:
        counts[2] = 0
    order = np.argsort(-people, kind="stable")
    width = 1 if distances else _width(simulations, int(people.max()), threads)
    steps = substeps * (batch.n_samples - 1)
    jobs, size = _layout(order, counts, steps * (4 + len(source.kept)), width, threads)
    number = y0.new_tensor
    force = system.find(InteractionForce)
    alone = force is None or not force.self_interaction
    plan = _Plan(
        module=compiled(source),
        jobs=jobs,
        order=order,
        size=size,
        per=substeps,
        dt=_scalar(number(batch.dt / substeps)),
        fields=_fields(terms, source, scene, kind),
        real=scene.agent.to(kind).numpy(),
        points=_table(scene.wall, scene.wall_normal, scene.wall_point, kind),
        walls=_table(walls[..., :2], walls[..., 2:], wall_there, kind),
        end=substeps * (batch.valid.any(-1).sum(0).numpy() - 1),
        first=1 if alone else 0,
        cutoff=tuple(_scalar(number(d)) for d in distances or (0.0, 0.0)),
        samples=batch.n_samples,
    )
    fixed = [number(value) for value in settings_of(terms, law).values()]
    q = torch.stack([*values_of(law, own_values(terms, law)), *fixed]).to(kind)
    y: Tensor = _Simulate.apply(plan, y0, q)
    return y[..., :2], y[..., 2:] if law.order == 2 else None


def _fields(terms: list[Term], source: CrowdSource, scene: Scene, kind: torch.dtype) -> np.ndarray:
    """``(B, N, F)`` what people have."""
    found = people_of(terms, source.law, scene)
    found |= dict(zip(("goal_x", "goal_y"), scene.destination.unbind(-1), strict=True))
    shape = scene.agent.shape
    rows = [found[name].to(kind).expand(shape) for name in source.fields]
    return torch.stack([*rows, scene.agent.to(kind)], -1)[..., : len(rows)].contiguous().numpy()


def _table(place: Tensor, more: Tensor, there: Tensor, kind: torch.dtype) -> np.ndarray:
    table = torch.cat([place, more, there.to(place.dtype)[..., None]], -1)
    return np.ascontiguousarray(table.to(kind).numpy())


def _scalar(value: Tensor) -> Any:
    return value.numpy()[()]


def _last(mask: Tensor) -> np.ndarray:
    """``(B,)`` one more than the index of the last True in every row."""
    index = torch.arange(1, mask.shape[1] + 1)
    return np.asarray((index * mask).amax(1).numpy()) if mask.shape[1] else np.zeros(len(mask), int)


def _distances(
    system: System, law: CrowdDynamics, cutoff: float | None, cutoff_error: float, people: int
) -> tuple[float, ...]:
    """Cutoffs of pairs and of wall points, m; none where everybody meets everybody."""
    social: Any = system.find_law("social_force")
    check_cutoff(cutoff, cutoff_error, 2 * social.r if social else 0.0)
    if cutoff is not None:
        if law.sums[SMALLEST]:
            raise ConfigError(
                f"solver.cutoff={cutoff:g} m: this law has smallest values over the others, and "
                "whoever attains one may stand farther away; set it to null"
            )
        return cutoff, cutoff
    # nobody knows how far other sums reach
    others = len(law.sums[OTHERS]) > 2 or bool(law.sums[SMALLEST])
    if social is None or others or cutoff_error == 0 or people < LISTS_FROM:
        return ()
    reaches = (2 * social.r, social.r)
    pair, wall = (cutoff_distance(reach, social.B, cutoff_error) for reach in reaches)
    return pair, wall
