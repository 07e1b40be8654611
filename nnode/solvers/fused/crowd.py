"""Crowd models in compiled code: relaxation with a social force or a force by networks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nnode.data.sequence import Batch
from nnode.models.crowd import InteractionForce, NetworkForce, Relaxation, SocialForce
from nnode.models.scene import Scene
from nnode.models.system import Crowd, System
from nnode.simulate.threads import run_all
from nnode.solvers.fused.crowd_cache import load
from nnode.solvers.fused.crowd_laws import LANES, SIZE
from nnode.solvers.fused.neighbours import check_cutoff, cutoff_distance

#: From so many people on, social forces use cell lists. They are faster for 50 already; smaller
#: crowds, and so most recordings, are exact to rounding instead.
LISTS_FROM = 200


def supports(system: System, batch: Batch | None = None) -> bool:
    """Whether the compiled code covers this model: one Relaxation, and one SocialForce or
    NetworkForce with one hidden layer, on the processor. Subclasses are other models."""
    if type(system) is not Crowd or len(system.terms) != 2:
        return False
    kinds = {type(term) for term in system.terms}
    if Relaxation not in kinds or not kinds & {SocialForce, NetworkForce}:
        return False
    force = _force(system)
    if isinstance(force, NetworkForce) and any(len(n.sizes) != 3 for n in (force.pair, force.wall)):
        return False
    tensors: list[Tensor] = list(system.parameters())
    if batch is not None:
        tensors.append(batch.x)
        if batch.destination.requires_grad or batch.walls.requires_grad:
            return False  # both are constants here
    return all(tensor.device.type == "cpu" for tensor in tensors)


def without_partners(system: System) -> bool:
    """Whether nobody meets anybody in this model, so that a cutoff changes nothing."""
    return isinstance(system, Crowd) and all(isinstance(t, Relaxation) for t in system.terms)


def _force(system: System) -> InteractionForce:
    (found,) = (term for term in system.terms if isinstance(term, InteractionForce))
    return found


@dataclass(frozen=True)
class _Plan:
    """Everything of a simulation that carries no gradient.

    Attributes:
        module: the compiled functions, dense or sparse.
        jobs: for every thread rows of first place in ``order``, simulations, people, wall
            points, place in the stored states, number of the thread.
        order: simulations in the order in which they are cut into blocks.
        size: numbers of stored states.
        per: steps in a sampling interval.
        dt: step, s.
        still: ``(B, N, 3)`` destination and 1 for real people.
        wall: ``(B, P, 5)`` place, velocity, and 1 for real points.
        scale: ``(B, 2)`` factors of the sums of pair and wall forces, 1/kg.
        end: ``(B,)`` last step in which a sequence moves.
        rate: 1 / tau, 1/s.
        slip: factor of velocities at walls.
        mutual: partners exert opposite forces.
        first: 0 lets people meet themselves as well, otherwise 1.
        cutoff: distances of pairs and of walls, m, or none.
        samples: K.
    """

    module: Any
    jobs: tuple[np.ndarray, ...]
    order: np.ndarray
    size: int
    per: int
    dt: Any
    still: np.ndarray
    wall: np.ndarray
    scale: np.ndarray
    end: np.ndarray
    rate: Any
    slip: Any
    mutual: bool
    first: int
    cutoff: tuple[Any, ...]
    samples: int


class _Simulate(torch.autograd.Function):
    """Euler's method and the exact gradient of what it computes."""

    @staticmethod
    def forward(ctx: Any, plan: _Plan, y0: Tensor, q: Tensor, q_wall: Tensor) -> Tensor:
        values = [np.ascontiguousarray(t.detach().numpy()) for t in (y0, q, q_wall)]
        keep = any(ctx.needs_input_grad)
        # NumPy asks for huge pages, which are far faster to touch for the first time
        states = np.empty(plan.size if keep else 0, values[0].dtype)
        # whoever is not computed, because he is padding, stays where he is
        still = y0.detach().expand(plan.samples, *y0.shape)
        out = still.clone(memory_format=torch.contiguous_format)

        def call(jobs: np.ndarray) -> None:
            plan.module.forward(
                jobs, plan.order, plan.per, plan.dt, values[0], plan.still, plan.wall,
                plan.scale, plan.end, plan.rate, plan.slip, plan.mutual, plan.first, values[1],
                values[2], states, out.numpy(), *plan.cutoff,
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
        totals = [np.zeros((len(plan.jobs), *value.shape)) for value in ctx.values[1:]]

        def call(jobs: np.ndarray) -> None:
            plan.module.backward(
                jobs, plan.order, plan.per, plan.dt, plan.still, plan.wall, plan.scale,
                plan.end, plan.rate, plan.slip, plan.mutual, plan.first, *ctx.values[1:],
                ctx.states, grad_out, grad_y0, *(total[jobs[0, 5]] for total in totals),
                *plan.cutoff,
            )  # fmt: skip

        run_all(call, plan.jobs)
        padding = plan.still[..., 2] == 0
        grad_y0[padding] = grad_out[:, padding].sum(0)
        shares = [torch.from_numpy(total.sum(0)).to(grads[0].dtype) for total in totals]
        return None, torch.from_numpy(grad_y0), *shares


def _network(layers: Any) -> Tensor:
    """``(hidden + 1, 7)``: see :mod:`nnode.solvers.fused.crowd_laws`."""
    first, last = layers
    neurons = torch.cat([first.weight, first.bias[:, None], last.weight.T], 1)
    return torch.cat([neurons, torch.nn.functional.pad(last.bias, (0, 5))[None]])


def _parameters(force: InteractionForce) -> tuple[Tensor, Tensor]:
    """Parameters of the pair and of the wall force as the compiled code takes them."""
    if isinstance(force, NetworkForce):
        return _network(force.pair.layers), _network(force.wall.layers)
    assert isinstance(force, SocialForce)
    strength = torch.stack([force.A, force.k, force.kappa])
    shapes = strength.new_tensor([[2 * force.r, 1 / force.B], [force.r, 1 / force.B]])
    return torch.cat([strength, shapes[0]]), torch.cat([strength, shapes[1]])


def _layout(
    order: np.ndarray, people: np.ndarray, points: np.ndarray, kept: int, width: int, threads: int
) -> tuple[tuple[np.ndarray, ...], int]:
    """Jobs of every thread, and the size of all that is stored, ``kept`` numbers a person."""
    rows: list[tuple[int, ...]] = []
    place = 0
    for low in range(0, len(order), width):
        members = order[low : low + width]
        most = int(people[members].max())
        # blocks come sorted by size: dealt out in turn, every thread has its share of large ones
        thread = len(rows) % threads
        rows.append((low, len(members), most, int(points[members].max()), place, thread))
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
    batch: Batch,
    substeps: int,
    threads: int = 1,
    *,
    cutoff: float | None = None,
    cutoff_error: float = 1e-10,
) -> tuple[Tensor, Tensor]:
    """Simulate a crowd model that :func:`supports` accepts, by Euler's method.

    The gradient with respect to the parameters and the initial state is that of the discrete
    scheme. Simulations of fewer than LISTS_FROM people, and all force networks without a
    cutoff, let everybody meet everybody. Larger ones use cell lists: social forces that are
    smaller than ``cutoff_error`` times A are left out. See
    :func:`nnode.solvers.fused.neighbours.cutoff_distance` for the bound of the sum.

    Args:
        substeps: Euler steps in a sampling interval.
        threads: at most so many threads compute blocks of simulations.
        cutoff: m; pairs, and people and wall points, that are farther apart do not interact,
            whatever the number of people. For a force network this changes the model, since
            nothing makes it decay.
        cutoff_error: largest force of one partner that is left out, in units of A; 0 lets
            everybody meet everybody.

    Returns:
        x and v at the samples, ``(K, B, N, 2)`` m and m/s. Padding people stand still.

    Raises:
        ConfigError: a cutoff that is not positive or leaves out contacts, or an error outside
            [0, 1).
    """
    force, scene = _force(system), system.scene(batch)
    (tau,) = (term.tau for term in system.terms if isinstance(term, Relaxation))
    social = force if isinstance(force, SocialForce) else None
    y0 = system.initial(batch)
    kind, simulations = y0.dtype, len(y0)
    people = _last(scene.agent)
    distances = _distances(social, cutoff, cutoff_error, int(people.max()))
    points = _last(scene.wall_point) if force.walls else np.zeros(simulations, np.int64)
    order = np.argsort(-people, kind="stable")
    width = 1 if distances else _width(simulations, int(people.max()), threads)
    steps = substeps * (batch.n_samples - 1)
    # besides x and v, networks where everybody meets everybody keep four sums a neuron
    neurons = force.pair.sizes[1] if isinstance(force, NetworkForce) and not distances else 0
    jobs, size = _layout(order, people, points, steps * (4 + 4 * neurons), width, threads)
    number = y0.new_tensor
    plan = _Plan(
        module=load("crowd_sparse" if distances else "crowd_dense"),
        jobs=jobs,
        order=order,
        size=size,
        per=substeps,
        dt=_scalar(number(batch.dt / substeps)),
        still=torch.cat([scene.destination, scene.agent.to(kind)[..., None]], -1).numpy(),
        wall=_walls(scene, social is None).numpy(),
        scale=torch.cat([1 / (force.mass * scene.count), 1 / (force.mass * scene.wall_count)], -1)[
            :, 0
        ].numpy(),
        end=substeps * (batch.valid.any(-1).sum(0).numpy() - 1),
        rate=_scalar(number(1 / tau)),
        slip=_scalar(number(-social.sign if social else 1.0)),
        mutual=social is not None,
        first=0 if isinstance(force, NetworkForce) and force.self_interaction else 1,
        cutoff=tuple(_scalar(number(distance)) for distance in distances),
        samples=batch.n_samples,
    )
    q, q_wall = (value.to(kind) for value in _parameters(force))
    y: Tensor = _Simulate.apply(plan, y0, q, q_wall)
    return y[..., :2], y[..., 2:]


def _scalar(value: Tensor) -> Any:
    return value.numpy()[()]


def _last(mask: Tensor) -> np.ndarray:
    """``(B,)`` one more than the index of the last True in every row."""
    index = torch.arange(1, mask.shape[1] + 1)
    return np.asarray((index * mask).amax(1).numpy()) if mask.shape[1] else np.zeros(len(mask), int)


def _walls(scene: Scene, velocity: bool) -> Tensor:
    normal = scene.wall_normal if velocity else torch.zeros_like(scene.wall_normal)
    return torch.cat([scene.wall, normal, scene.wall_point.to(normal.dtype)[..., None]], -1)


def _distances(
    social: SocialForce | None, cutoff: float | None, cutoff_error: float, people: int
) -> tuple[float, ...]:
    """Cutoffs of pairs and of walls, m; none where everybody meets everybody."""
    check_cutoff(cutoff, cutoff_error, 2 * social.r if social else 0.0)
    if cutoff is not None:
        return cutoff, cutoff
    if social is None or cutoff_error == 0 or people < LISTS_FROM:
        return ()
    reaches = (2 * social.r, social.r)
    pair, wall = (cutoff_distance(reach, social.B, cutoff_error) for reach in reaches)
    return pair, wall
