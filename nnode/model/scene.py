"""The fixed surroundings of a simulated batch: leaders, walls and destinations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from nnode.data.sequence import Batch
from nnode.errors import DataError


@dataclass
class Scene:
    """The fixed surroundings of the B simulations of a batch.

    Attributes:
        agent: ``(B, N)`` True for real agents.
        count: ``(B, 1, 1)`` number of real agents.
        leader: ``(B, N)`` True for the last real agent.
        follower: ``(B, N)`` True for the real agents behind it.
        destination: ``(B, N, D)`` m.
        length: ``(B, N)`` m, NaN where unknown.
        measured: ``(K, B, N, D)`` measured positions, m.
        measured_rate: ``(K, B, N, D)`` measured velocities, m/s.
        dt: sampling interval of ``measured``, s.
        wall: ``(B, P, 2)`` wall points, m.
        wall_normal: ``(B, P, 2)`` unit normals into the walkable side.
        wall_point: ``(B, P)`` True for real wall points.
        wall_count: ``(B, 1, 1)`` number of real wall points, at least 1.
        segment: ``(B, W, 4)`` walls x1, y1, x2, y2, m; NaN in the padding.
        start: ``(B,)`` clock time of the first sample, s.
        near: each person's nearby wall points, as :meth:`walls_of_each` returns them; None if all
            points act on everyone.
        step: the solver's time step, s.
        method: the solver's method of stepping, see :mod:`nnode.model.steps`.
        preferred: ``(B, N, D)`` velocities before the sequence, m/s; the first measured ones where
            no earlier data exist.
        names: names of the sequences.
        kind, group: per sequence the agents' class and group names, or None.
    """

    agent: Tensor
    count: Tensor
    leader: Tensor
    follower: Tensor
    destination: Tensor
    length: Tensor
    measured: Tensor
    measured_rate: Tensor
    dt: float
    wall: Tensor
    wall_normal: Tensor
    wall_point: Tensor
    wall_count: Tensor
    segment: Tensor
    start: Tensor
    preferred: Tensor
    near: tuple[Tensor, Tensor, Tensor] | None = None
    step: float = 0.1
    method: str = "euler"
    names: tuple[str, ...] = ()
    kind: tuple[tuple[str, ...] | None, ...] = ()
    group: tuple[tuple[str, ...] | None, ...] = ()

    @classmethod
    def of(cls, batch: Batch, wall_spacing: float = 0.25) -> Scene:
        """The scene of a batch, walls cut into points ``wall_spacing`` (m) apart or closer."""
        agent = batch.agent
        number = agent.sum(1)
        index = torch.arange(agent.shape[1], device=agent.device)
        leader = index == (number - 1)[:, None]
        wall, normal, real = wall_points(batch.walls, wall_spacing)
        preferred = batch.preferred
        return cls(
            agent=agent,
            count=number.to(batch.x.dtype)[:, None, None],
            leader=leader,
            follower=agent & ~leader,
            destination=batch.destination,
            length=batch.length,
            measured=batch.x,
            measured_rate=batch.v,
            dt=batch.dt,
            wall=wall,
            wall_normal=normal,
            wall_point=real,
            wall_count=real.sum(1).clamp(min=1).to(batch.x.dtype)[:, None, None],
            segment=batch.walls,
            start=batch.start,
            preferred=batch.v[0]
            if preferred is None
            else preferred.where(preferred.isfinite(), batch.v[0]),
            names=batch.names,
            kind=batch.kind,
            group=batch.group,
        )

    def walls_of_each(self) -> tuple[Tensor, Tensor, Tensor]:
        """Wall points ``(B, N or 1, P, 2)`` that act on each person, their normals, and the mask
        ``(B, N or 1, P)`` of real points."""
        if self.near is not None:
            return self.near
        return self.wall[:, None], self.wall_normal[:, None], self.wall_point[:, None]

    def measured_at(self, t: Tensor) -> Tensor:
        """``(B, N, D)`` measured positions at time ``t`` (s), linear between samples."""
        return self._between(self.measured, t)

    def measured_rate_at(self, t: Tensor) -> Tensor:
        """``(B, N, D)`` measured velocities at time ``t`` (s), m/s, linear between samples."""
        return self._between(self.measured_rate, t)

    def _between(self, samples: Tensor, t: Tensor) -> Tensor:
        position = t / self.dt
        # the tolerance keeps whole sample numbers whole in any precision
        k = torch.floor(position + 1e-4).long().clamp(0, samples.shape[0] - 2)
        # a tensor index allows tracing and batching of the equations
        before, after = samples.index_select(0, torch.stack([k, k + 1]))
        return torch.lerp(before, after, (position - k).clamp(0, 1).to(before.dtype))

    @cached_property
    def pace(self) -> Tensor:
        """``(B, N)`` preferred speeds, m/s."""
        return torch.linalg.vector_norm(self.preferred.detach(), dim=-1)

    @cached_property
    def mean_length(self) -> Tensor:
        """Mean length of the agents whose length is known, m; 0 if none is."""
        is_known = torch.isfinite(self.length)
        return torch.where(is_known, self.length, 0.0).sum() / is_known.sum().clamp(min=1)

    @cached_property
    def kinds(self) -> dict[str, Tensor]:
        """Class name to ``(B, N)`` True for its agents; empty if no class is known."""
        table = self._table(self.kind)
        return {
            name: torch.from_numpy(table == name).to(self.agent.device)
            for name in sorted(set(table.flat) - {""})
        }

    @cached_property
    def companies(self) -> Tensor:
        """``(B, N)`` number of an agent's social group in its sequence, from 1; 0 for none."""
        rows = self._table(self.group)
        numbers = [[sorted({"", *row}).index(name) for name in row] for row in rows]
        return torch.tensor(numbers, dtype=torch.float64, device=self.agent.device)

    def _table(self, names: Sequence[Sequence[str] | None]) -> np.ndarray:
        """``(B, N)`` the agents' names; empty where there is none."""
        table = np.full(self.agent.shape, "", dtype=object)
        for row, row_names in zip(table, names, strict=False):
            row[: len(row_names or ())] = row_names or ()
        return table


#: Kinds of destinations: the end of the sequence; destinations from the data; along the stream.
DESIRED = ("last", "exit", "direction")
#: Distance (m) of the destination of people who walk in a direction.
FAR = 1e4


def with_destinations(scene: Scene, batch: Batch, desired: str) -> Scene:
    """The scene with the destinations for a model.

    Args:
        desired: ``last``: the batch's destinations, by default the last measured positions, which
            give the model the end of the predicted path. ``exit``: the batch's destinations,
            which must differ from the last measured positions. ``direction``: far ahead in the
            direction of the person's stream. The stream is the mean preferred velocity of all
            people in the sequence whose preferred velocity is within a right angle of the
            person's.

    Raises:
        DataError: ``exit``, and the data have no destinations.
    """
    if desired == "last":
        return scene
    if desired == "exit":
        last = batch.valid.sum(0).clamp(min=1) - 1
        end = batch.x.gather(0, last[None, ..., None].expand(1, *batch.x.shape[1:]))[0]
        if bool((batch.destination == end)[batch.agent].all()):
            raise DataError(
                "model.desired=exit needs destinations from the data, and these are the last "
                "measured positions; name data.exits, give a table with dest_x and dest_y, or take "
                "model.desired=direction"
            )
        return scene
    # destinations are constants: gradients exclude them
    preferred = scene.preferred.detach() * scene.agent[..., None]
    same_stream = (preferred @ preferred.mT > 0).to(preferred.dtype)
    stream = same_stream @ preferred
    length = torch.linalg.vector_norm(stream, dim=-1, keepdim=True)
    # without a preferred velocity, the destination is the present position
    ahead = scene.measured[0].detach() + FAR * stream / length.clamp(min=1e-9)
    return replace(scene, destination=torch.where(scene.agent[..., None], ahead, batch.destination))


def wall_points(walls: Tensor, spacing: float) -> tuple[Tensor, Tensor, Tensor]:
    """Cut wall segments into points.

    Args:
        walls: ``(B, W, 4)`` segments x1, y1, x2, y2 in m, NaN rows are padding; the walkable
            side is on the left of the direction from point 1 to point 2.
        spacing: largest distance of neighbouring points, m.

    Returns:
        points ``(B, P, 2)``, unit normals into the walkable side ``(B, P, 2)`` and the mask
        ``(B, P)`` of real points. Padding points repeat far outside.
    """
    if not walls.shape[1]:
        return (*walls.new_zeros(2, len(walls), 0, 2), walls.new_zeros(len(walls), 0).bool())
    points_of: dict[bytes, tuple[Tensor, Tensor]] = {}
    rows = []
    for segments in walls.detach().cpu().double():
        # the sequences of a recording share their walls
        key = segments.numpy().tobytes()
        if key not in points_of:
            points_of[key] = _points(segments, spacing)
        rows.append(points_of[key])
    points, normals = map(list, zip(*rows, strict=True))
    point = pad_sequence(points, batch_first=True, padding_value=1e4).to(walls)
    real = torch.arange(point.shape[1]) < torch.tensor([[len(part)] for part in points])
    return point, pad_sequence(normals, batch_first=True).to(walls), real.to(walls.device)


def _points(segments: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Points and normals ``(P, 2)`` of one simulation's walls ``(W, 4)``."""
    points, normals = [], []
    for segment in segments[~segments.isnan().any(1)]:
        start, end = segment[:2], segment[2:]
        length = float(torch.linalg.vector_norm(end - start))
        n = max(1, math.ceil(length / spacing - 1e-9)) + 1
        fraction = torch.linspace(0, 1, n, dtype=torch.float64)[:, None]
        points.append(start + fraction * (end - start))
        along = (end - start) / max(length, 1e-12)
        normals.append(torch.stack([-along[1], along[0]]).expand(n, 2))
    none = segments.new_empty(0, 2)
    return torch.cat([none, *points]), torch.cat([none, *normals])
