"""Evaluation of a model: cost, errors by horizon, and baselines."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from nnode.calibrate.cost import FOLLOWING, Convention, sequence_costs, squared_error
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Batch
from nnode.errors import SimulationError
from nnode.model import Crowd, Law, System, Traffic
from nnode.model.laws import law_from
from nnode.simulation.base import Solver, Trajectory

#: Largest squared distance (m²) between simulation and data, for a distance of 10¹² m.
MOST = 1e24

Simulate = Callable[[Batch], Trajectory]


@dataclass
class Metrics:
    """Errors of one model on one set of sequences.

    The distances exclude agents that follow their measured paths, as a leader with
    ``model.leader=measured``.

    Attributes:
        J: mean cost of a sequence, m² s (or m² with the ``sum`` convention).
        rmse: root mean squared distance over all samples after the first, m.
        final_displacement: mean distance at each agent's last sample, m.
        horizons: rows of ``t`` (s after the start), ``rmse`` (m), ``n`` (agents).
        collisions: share of simulated samples after the first in which a vehicle's gap is
            not positive; 0 for crowds.
        sequences: number of sequences.
        costs: cost of each sequence by name.
        objectives: for vehicles, name of every cost to its mean over sequences, see
            :class:`nnode.calibrate.cost.Convention`. Empty for crowds.
    """

    J: float
    rmse: float
    final_displacement: float
    horizons: list[dict[str, float]]
    collisions: float
    sequences: int
    costs: dict[str, float]
    objectives: dict[str, float] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """The metrics as plain types, for JSON."""
        return dict(vars(self))


@torch.no_grad()
def evaluate(
    simulate: Simulate, batches: Iterable[Batch], convention: Convention = Convention.integral
) -> Metrics:
    """Errors of ``simulate`` over all sequences of ``batches``.

    Raises:
        SimulationError: an error is not finite or too large; the message states sequence, agent
            and time.
    """
    costs: dict[str, float] = {}
    total: defaultdict[int, float] = defaultdict(float)
    number: defaultdict[int, int] = defaultdict(int)
    final, agents, overlaps, followers = 0.0, 0, 0, 0
    objectives: defaultdict[str, float] = defaultdict(float)
    dt = 0.0
    for batch in batches:
        dt = batch.dt
        trajectory = simulate(batch)
        names = zip(batch.names, sequence_costs(trajectory, batch, convention), strict=True)
        costs.update({name: float(cost) for name, cost in names})
        error = squared_error(trajectory, batch)
        _check_finite(error, batch)
        free = batch.agent if trajectory.given is None else batch.agent & ~trajectory.given
        for k in range(1, batch.n_samples):
            total[k] += float((error[k] * free).sum())
            number[k] += int((batch.valid[k] & free).sum())
        last = batch.valid.sum(0) - 1
        distance = error.gather(0, last.clamp(min=0)[None])[0].sqrt()
        final += float((distance * free).sum())
        agents += int(free.sum())
        if batch.x.shape[-1] == 1:
            for kind in FOLLOWING:
                if kind is not Convention.speed or trajectory.v is not None:
                    objectives[kind.value] += float(sequence_costs(trajectory, batch, kind).sum())
            gap = trajectory.x[1:, :, 1:, 0] - trajectory.x[1:, :, :-1, 0]
            real = batch.valid[1:, :, 1:]
            overlaps += int(((gap <= 0) & real).sum())
            followers += int(real.sum())
    horizons = [
        {"t": round(k * dt, 9), "rmse": (total[k] / number[k]) ** 0.5, "n": number[k]}
        for k in sorted(total)
        if number[k]
    ]
    samples = sum(number.values())
    return Metrics(
        J=sum(costs.values()) / max(len(costs), 1),
        rmse=(sum(total.values()) / max(samples, 1)) ** 0.5,
        final_displacement=final / max(agents, 1),
        horizons=horizons,
        collisions=overlaps / max(followers, 1),
        sequences=len(costs),
        costs=costs,
        objectives={name: value / max(len(costs), 1) for name, value in objectives.items()},
    )


def _check_finite(error: Tensor, batch: Batch) -> None:
    """Refuse squared errors ``(K, B, N)`` that would make metrics infinite or NaN."""
    bad = ~error.isfinite() | (error > MOST)
    if bool(bad.any()):
        k, b, n = (int(i) for i in bad.nonzero()[0])
        raise SimulationError(
            f"the simulation of sequence {batch.names[b]} left the data: agent {n} is "
            f"{float(error[k, b, n].sqrt()):.3g} m away at {k * batch.dt:g} s after the start; "
            "check the sequence, start from other parameters, or take a smaller solver.dt"
        )


def sensitivity(
    system: System, solver: Solver, batch: Batch, convention: Convention = Convention.integral
) -> float:
    """Largest relative change of the mean cost by the relative change of a parameter, |p g / J|.

    It is 0 at a minimum and does not depend on the parameters' units. It excludes parameters at a
    bound whose descent direction points out of the admissible set.

    Raises:
        SimulationError: the model cannot be simulated.
    """
    cost = sequence_costs(solver(system, batch), batch, convention).mean()
    vector = ParameterVector(system)
    parameters = list(vector.parameters.values())
    slopes = torch.autograd.grad(cost, parameters, allow_unused=True, materialize_grads=True)
    slope, row = torch.cat([g.flatten() for g in slopes]).double(), vector.row
    low, high = (torch.from_numpy(end) for end in vector.bounds)
    pressed = ((row <= low) & (slope > 0)) | ((row >= high) & (slope < 0))
    return float((row * slope / cost.detach()).masked_fill(pressed, 0.0).abs().max())


def _times(batch: Batch) -> Tensor:
    """``(K,)`` sampling times, s after the start."""
    number = torch.arange(batch.n_samples, dtype=batch.x.dtype, device=batch.x.device)
    return batch.dt * number


def best_common_speed(batches: Iterable[Batch], system: System | None = None) -> float:
    """The common speed (m/s) that fits all vehicles best, in closed form.

    It is the calibrated v0 of a model without interaction:
    sum t (x(t) - x(0)) / sum t² over all measured samples.

    Args:
        system: the model whose vehicles with measured paths are excluded; None excludes none.
    """
    numerator = denominator = 0.0
    for batch in batches:
        t = _times(batch)[:, None, None]
        distance = (batch.x - batch.x[:1])[..., 0]
        given = None if system is None else system.given(batch)
        counts = batch.valid if given is None else batch.valid & ~given
        numerator += float((t * distance * counts).sum())
        denominator += float((t.square() * counts).sum())
    return numerator / denominator


def constant_velocity(system: System) -> Simulate:
    """Baseline: every agent keeps the velocity measured at its first sample."""

    def simulate(batch: Batch) -> Trajectory:
        t = _times(batch)
        x = batch.x[:1] + t[:, None, None, None] * batch.v[:1]
        state = torch.cat([x, batch.v[:1].expand_as(x)][: system.order], -1)
        return Trajectory(*system.observe(state, batch), system.given(batch))

    return simulate


def no_interaction(system: System, solver: Solver, free_speed: float | None) -> Simulate:
    """Baseline: the model without its interaction.

    Traffic: all vehicles at ``free_speed`` (m/s), the leader as in the model. Crowds: only
    relaxation towards the destination, and user-defined laws without their sums.
    """
    bare: System
    if isinstance(system, Traffic):
        speed = 0.0 if free_speed is None else free_speed
        free = law_from("free_flow", {"parameters": {"v0": f"{speed} m/s"}, "rate": {"x": "v0"}})
        bare = Traffic([free], leader=system.leader)
    else:
        laws = [term for term in system.terms if isinstance(term, Law)]
        kept = [law.alone() for law in laws if law.formulas.force is None]
        assert isinstance(system, Crowd)
        bare = Crowd(kept, system.wall_spacing, desired=system.desired)
    bare.to(next(system.parameters()))
    return lambda batch: solver(bare, batch)


def baselines(system: System, solver: Solver, free_speed: float | None) -> dict[str, Simulate]:
    """Name to simulation of the baselines for a calibrated model."""
    return {
        "no_interaction": no_interaction(system, solver, free_speed),
        "constant_velocity": constant_velocity(system),
    }
