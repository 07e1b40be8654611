"""Simulation of people who walk alone: compiled for the social force, in PyTorch for the rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap

from nnode.discover import crowd_kernel
from nnode.discover.crowd_windows import Windows, WindowScene, alone
from nnode.discover.engine import trained
from nnode.models.crowd import Relaxation, SocialForce
from nnode.models.system import Crowd, System
from nnode.models.term import State, Term

#: Numbers in the largest intermediate result.
CHUNK = 2_000_000


class Beyond(nn.Module):
    """The sum of a model's terms that have no compiled code."""

    def __init__(self, system: Crowd, terms: list[Term]) -> None:
        super().__init__()
        self.system = system
        self._added = terms  # a plain list: the terms' parameters belong to the system

    def forward(self, state: State) -> Tensor:
        total = torch.zeros_like(state.x) if state.rate is None else state.rate
        first = total
        for term in self._added:
            total = total + term(replace(state, system=self.system, rate=total))
        return total - first


@dataclass
class Tables:
    """What the compiled code knows of the surroundings, see its description."""

    others: np.ndarray
    window: np.ndarray
    meets: np.ndarray
    wall: np.ndarray
    points: np.ndarray
    fixed: np.ndarray

    @classmethod
    def of(cls, windows: Windows, scene: WindowScene, force: SocialForce) -> Tables:
        """The tables of all people of all windows."""
        which, who = windows.person.T
        x, v = windows.batch.x.numpy(), windows.batch.v.numpy()
        others = np.ascontiguousarray(np.concatenate([x, v], -1).transpose(0, 1, 3, 2))
        agent = scene.agent.numpy()
        count = agent.sum(1)
        meets = agent[which] / (force.mass * count[which])[:, None]
        meets[np.arange(len(who)), who] = 0.0
        place, _, real = (part.numpy() for part in scene.walls_of_each())
        shape = (*agent.shape, place.shape[2])
        wall = np.broadcast_to(place, (*shape, 2))[which, who].transpose(0, 2, 1)
        there = np.broadcast_to(real, shape)[which, who]
        if not force.walls:
            there = np.zeros_like(there)
        share = 1 / (force.mass * scene.wall_count.numpy()[which, 0])
        goal = scene.destination.numpy()[which, who]
        # real points come first
        order = np.argsort(~there, axis=1, kind="stable")
        wall = np.take_along_axis(wall, order[:, None], 2)
        return cls(
            others=others,
            window=which,
            meets=meets,
            wall=np.ascontiguousarray(wall),
            points=there.sum(1),
            fixed=np.concatenate([goal, share], 1),
        )

    def arguments(self) -> tuple[np.ndarray, ...]:
        """In the order of the compiled functions."""
        return (self.others, self.window, self.meets, self.wall, self.points, self.fixed)


class Walk:
    """One model among the measured others.

    Args:
        windows: the windows.
        scene: their surroundings.
        system: the model.
        tables: from :class:`Tables`, where they are known already.
    """

    def __init__(
        self, windows: Windows, scene: WindowScene, system: System, tables: Tables | None = None
    ) -> None:
        self.windows, self.scene, self.system = windows, scene, alone(system)
        terms = cast(list[Term], list(system.terms))
        law = [term for term in terms if type(term) in (Relaxation, SocialForce)]
        self.compiled = [type(term) for term in law] == [Relaxation, SocialForce] and (
            law == terms[:2]
        )
        self.beyond = Beyond(self.system, terms[2:] if self.compiled else terms)
        self.names = list(trained(system))
        self.sizes = [p.numel() for p in trained(system).values()]
        if self.compiled:
            relaxation, force = cast(tuple[Relaxation, SocialForce], law)
            self.tables = tables or Tables.of(windows, scene, force)
            self.law = np.array([1 / relaxation.tau, force.r, 1 / force.B, force.friction_sign])
            self.own = [f"terms.1.{name}" for name in ("A", "k", "kappa")]
            self.usual = [float(p.detach()) for p in (force.A, force.k, force.kappa)]

    def forces(self, rows: Tensor) -> np.ndarray:
        """``(R, 3)``: A, k, kappa of rows ``(R, K)``."""
        out = np.tile(self.usual, (len(rows), 1))
        for column, name in enumerate(self.own):
            if name in self.names:
                place = sum(self.sizes[: self.names.index(name)])
                out[:, column] = rows[:, place].numpy()
        return out

    def parameters(self, rows: Tensor) -> dict[str, Tensor]:
        """Rows ``(R, K)`` as parameters of :class:`Beyond`."""
        own = trained(self.system).values()
        parts = rows.split(self.sizes, 1)
        return {
            f"system.{name}": part.reshape(-1, *p.shape)
            for name, p, part in zip(self.names, own, parts, strict=True)
        }

    @torch.no_grad()
    def paths(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (m) and velocities (m/s) ``(F, R, P, 2)`` at the steps of the simulation."""
        w, n = self.windows.batch.agent.shape
        most = max(1, CHUNK // (2 * w * n * n))
        parts = [self._run(part.double()) for part in rows.split(most)]
        path = torch.cat(parts, 1)
        return path[..., :2], path[..., 2:]

    def _run(self, rows: Tensor) -> Tensor:
        windows, which, who = self.windows, *map(torch.as_tensor, self.windows.person.T)
        first = torch.cat([windows.batch.x[0], windows.batch.v[0]], -1)
        if self.compiled and not self.beyond._added:
            start = first[which, who].numpy()
            found = crowd_kernel.simulate(
                start, windows.step, *self.tables.arguments(), self.law, self.forces(rows)
            )
            return torch.from_numpy(found)
        parameters = self.parameters(rows)
        q = self.forces(rows) if self.compiled else np.empty((len(rows), 3))
        y, h = first.expand(len(rows), *first.shape).clone(), windows.step
        out = [y[:, which, who]]
        for k in range(windows.steps):
            k1 = self._rate(parameters, q, 2 * k, y)
            k2 = self._rate(parameters, q, 2 * k + 1, y + h / 2 * k1)
            k3 = self._rate(parameters, q, 2 * k + 1, y + h / 2 * k2)
            k4 = self._rate(parameters, q, 2 * k + 2, y + h * k3)
            y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            out.append(y[:, which, who])
        return torch.stack(out)

    def _rate(self, parameters: dict[str, Tensor], q: np.ndarray, moment: int, y: Tensor) -> Tensor:
        """``(R, W, N, 4)``: time derivative of states at one half step."""
        which, who = map(torch.as_tensor, self.windows.person.T)
        t = torch.tensor(moment * self.windows.step / 2, dtype=y.dtype)
        seen = (self.windows.batch.x[moment], self.windows.batch.v[moment])
        base = torch.zeros_like(y[..., :2])
        if self.compiled:
            r, p = len(y), len(which)
            rate = crowd_kernel.accelerations(
                y[:, which, who].reshape(r * p, 4).numpy(),
                np.tile(np.arange(p), r),
                np.full(r * p, moment),
                np.repeat(np.arange(r), p),
                *self.tables.arguments(),
                self.law,
                q,
            )
            base[:, which, who] = torch.from_numpy(rate).reshape(r, p, 2)

        def one(own: dict[str, Tensor], y: Tensor, rate: Tensor) -> Tensor:
            state = State(t, y[..., :2], y[..., 2:], self.scene, rate=rate, seen=seen)
            found: Tensor = functional_call(self.beyond, own, (state,))
            return found

        if len(y) == 1:
            # nothing to batch, and no price of batching
            single = {name: value[0] for name, value in parameters.items()}
            more = one(single, y[0], base[0])[None]
        else:
            more = vmap(one)(parameters, y, base)
        return torch.cat([y[..., 2:], base + more], -1)
