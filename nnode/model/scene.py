"""What stays fixed while a batch is simulated: who leads, where walls are, who walks where."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

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
        near: wall points, normals and mask as of :meth:`walls_of_each`, where people feel a part of
            the points; None: they feel all.
        step: s, of the solver; method: what becomes of a law in it, see :mod:`nnode.model.steps`.
        preferred: ``(B, N, D)`` velocities before the sequence, m/s; the first measured ones where
            nothing was measured before.
        names: of the sequences.
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
            preferred=_preferred(batch),
            names=batch.names,
            kind=batch.kind,
            group=batch.group,
        )

    def walls_of_each(self) -> tuple[Tensor, Tensor, Tensor]:
        """Wall points ``(B, N or 1, P, 2)`` that each person feels, their normals, and the mask
        ``(B, N or 1, P)`` of real ones."""
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
        # a hair of tolerance keeps whole sample numbers whole in any precision
        k = torch.floor(position + 1e-4).long().clamp(0, samples.shape[0] - 2)
        # an index that stays a tensor lets the equations be recorded and run in batches
        before, after = samples.index_select(0, torch.stack([k, k + 1]))
        return torch.lerp(before, after, (position - k).clamp(0, 1).to(before.dtype))

    @cached_property
    def pace(self) -> Tensor:
        """``(B, N)`` preferred speeds, m/s."""
        return torch.linalg.vector_norm(self.preferred.detach(), dim=-1)

    @cached_property
    def mean_length(self) -> Tensor:
        """Of the agents whose length is known, m; 0 where none is."""
        known = torch.isfinite(self.length)
        return torch.where(known, self.length, 0.0).sum() / known.sum().clamp(min=1)

    @cached_property
    def kinds(self) -> dict[str, Tensor]:
        """Class name to ``(B, N)`` True for its agents; empty where no class is known."""
        return self._masks(self.kind)

    @cached_property
    def companies(self) -> Tensor:
        """``(B, N)`` number of an agent's social group in its sequence, from 1; 0: none."""
        found = torch.zeros(self.agent.shape, dtype=torch.float64)
        for b, names in enumerate(self.group):
            known = sorted({name for name in names or () if name})
            for i, name in enumerate(names or ()):
                found[b, i] = known.index(name) + 1 if name else 0
        return found.to(self.agent.device)

    def _masks(self, labels: tuple[tuple[str, ...] | None, ...]) -> dict[str, Tensor]:
        known = sorted({name for names in labels for name in names or () if name})
        masks = {name: torch.zeros(self.agent.shape, dtype=torch.bool) for name in known}
        for b, names in enumerate(labels):
            for i, name in enumerate(names or ()):
                if name:
                    masks[name][b, i] = True
        return {name: mask.to(self.agent.device) for name, mask in masks.items()}


#: Where people want to go: to the end of the sequence; to destinations from the data; along
#: their stream.
DESIRED = ("last", "exit", "direction")
#: So far away (m) lies the destination of who wants to walk in a direction.
FAR = 1e4


def wanted(scene: Scene, batch: Batch, desired: str) -> Scene:
    """The scene with the destinations that a model is to know.

    Args:
        desired: ``last``: those of the batch, by default everybody's last measured position, which
            hands the model the end of what it predicts; ``exit``: those of the batch, which must
            be others; ``direction``: far ahead in the direction of a person's stream. That is
            the mean preferred velocity of everybody in the sequence whose own is within a right
            angle of his, measured before the sequence, or at its first sample where nothing was.

    Raises:
        DataError: ``exit``, and the data tell no destinations.
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
    # constants: nothing is differentiated by what people want
    own = scene.preferred.detach() * scene.agent[..., None]
    with_him = (own @ own.mT > 0).to(own.dtype)
    stream = with_him @ own
    length = torch.linalg.vector_norm(stream, dim=-1, keepdim=True)
    # who stood has no direction: he wants to stay
    ahead = scene.measured[0].detach() + FAR * stream / length.clamp(min=1e-9)
    return replace(scene, destination=torch.where(scene.agent[..., None], ahead, batch.destination))


def _preferred(batch: Batch) -> Tensor:
    if batch.preferred is None:
        return batch.v[0]
    return torch.where(batch.preferred.isfinite(), batch.preferred, batch.v[0])


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
    known: dict[bytes, tuple[Tensor, Tensor]] = {}
    rows = []
    for segments in walls.detach().cpu().double():
        # the sequences of a recording share their walls
        key = segments.numpy().tobytes()
        if key not in known:
            known[key] = _points(segments, spacing)
        rows.append(known[key])
    most = max((len(points) for points, _ in rows), default=0)
    shape = (len(rows), most, 2)
    point = torch.full(shape, 1e4, dtype=torch.float64)
    normal = torch.zeros(shape, dtype=torch.float64)
    real = torch.zeros(shape[:2], dtype=torch.bool)
    for b, (place, direction) in enumerate(rows):
        point[b, : len(place)] = place
        normal[b, : len(place)] = direction
        real[b, : len(place)] = True
    device, dtype = walls.device, walls.dtype
    return point.to(device, dtype), normal.to(device, dtype), real.to(device)


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
    if not points:
        return torch.empty(0, 2), torch.empty(0, 2)
    return torch.cat(points), torch.cat(normals)
