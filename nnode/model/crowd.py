"""Accelerations of pedestrians: relaxation, social force, and forces by networks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nnode.model.crowd_dynamics import (
    OTHERS,
    POINTS,
    SMOOTHING,
    CrowdDynamics,
    CrowdRule,
    with_rule,
)
from nnode.model.crowd_formula import CrowdBase, formula_of, ruled, settings_of
from nnode.model.expression import call, symbol
from nnode.model.formula import own_values, values_of
from nnode.model.network import FeedForward
from nnode.model.tensors import Code, computed
from nnode.model.term import Interval, State


def norm(vector: Tensor) -> Tensor:
    """``(..., 2)`` to ``(...)``: Euclidean length with a finite gradient everywhere."""
    return torch.sqrt(dot(vector, vector) + SMOOTHING**2)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """``(..., 2)`` twice to ``(...)``: scalar product; faster than a sum over an axis of two."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def _positive(**options: float) -> None:
    for name, value in options.items():
        if not value > 0:
            raise ValueError(f"{name}={value} must be positive")


def velocity(state: State) -> Tensor:
    """``(B, N, 2)`` m/s.

    Raises:
        ValueError: the model is of first order.
    """
    if state.v is None:
        raise ValueError("a term of a second-order model needs velocities")
    return state.v


class Relaxation(CrowdBase):
    """Relaxation towards the destination at the present speed.

    (v_des - v) / tau with v_des = |v| (x_D - x) / |x_D - x|; tau (s) is fixed.

    Args:
        tau: s.
        preferred: at everybody's preferred speed in place of the present one.
    """

    name = "relaxation"
    formula = "(|v| (x_D - x) / |x_D - x| - v) / tau"
    source = "Göttlich & Totzeck, equation (relaxation)"
    rule = CrowdRule(
        rate=("(speed*way_x - vx)/tau", "(speed*way_y - vy)/tau"),
        settings={"tau": "s"},
        drive=True,
    )

    def __init__(self, tau: float = 0.5, preferred: bool = False) -> None:
        super().__init__()
        _positive(tau=tau)
        self.tau, self.preferred = tau, preferred
        if preferred:
            self.rule = replace(
                Relaxation.rule, rate=("(pace*way_x - vx)/tau", "(pace*way_y - vy)/tau")
            )

    @property
    def shape(self) -> tuple[Any, ...]:
        return (*super().shape, self.preferred)


class InteractionForce(CrowdBase):
    """Forces between people and from walls, averaged as in the paper.

    (1/m) mean over the N people of the pair force + (1/m) mean over the P wall points of the
    wall force. A person exerts no force on himself unless a force says so, but counts in N.

    Args:
        mass: m, kg.
        walls: False leaves the walls out.
    """

    def __init__(self, mass: float = 1.0, walls: bool = True) -> None:
        super().__init__()
        _positive(mass=mass)
        self.mass = mass
        self.walls = walls

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        """Force on i from j, ``(..., 2)`` N, of x_i - x_j (m) and v_i - v_j (m/s)."""
        raise NotImplementedError  # pragma: no cover - every force defines its own

    def wall_force(self, dx: Tensor, v: Tensor, normal: Tensor) -> Tensor:
        """Force on i from a wall point, ``(..., 2)`` N, of x_i - x_w (m), v_i (m/s) and the
        wall's unit normal."""
        raise NotImplementedError  # pragma: no cover - every force defines its own

    def pairs(self, state: State) -> Tensor:
        """``(B, N, N, 2)`` m/s²: the acceleration of person i (second axis) by person j (third),
        0 where they are one."""
        x, v, scene = state.x, velocity(state), state.scene
        other, speed = state.others
        dx, dv = x[:, :, None] - other[:, None], v[:, :, None] - speed[:, None]
        apart = ~torch.eye(x.shape[1], dtype=torch.bool, device=x.device)
        acts = (scene.agent[:, None, :] & apart)[..., None]
        return self.pair_force(dx, dv) * (acts / (self.mass * scene.count[..., None]))

    def components(self, state: State) -> dict[str, Tensor]:
        """``pair`` and ``wall`` accelerations, ``(B, N, 2)`` m/s² each."""
        x, v, scene = state.x, velocity(state), state.scene
        parts = {"pair": self.pairs(state).sum(2)}
        if self.walls and scene.wall.shape[1]:
            wall, normal, real = scene.walls_of_each()
            dx = x[:, :, None] - wall
            force = self.wall_force(dx, v[:, :, None].expand_as(dx), normal.expand_as(dx))
            parts["wall"] = (force * real[..., None]).sum(2) / (self.mass * scene.wall_count)
        return parts

    def forward(self, state: State) -> Tensor:
        return sum(self.components(state).values(), torch.zeros_like(state.x))

    def told(self, law: CrowdDynamics, owner: str, place: int) -> CrowdDynamics:
        """Its force is code that formulas can call."""
        seen = [symbol(name) for name in ("dx", "dy", "dvx", "dvy")]
        known = {f"force_{axis}": call(f"force_{axis}", *seen) for axis in "xy"}
        mass = f"{owner}__mass"
        return replace(
            law,
            known=law.known | known | {"mass": symbol(mass)},
            settings=law.settings | {mass: (place, "mass")},
            units=law.units | {mass: "kg"},
        )

    @property
    def own_rule(self) -> CrowdRule:
        """Its rule, without walls where it has none."""
        assert isinstance(self.rule, CrowdRule)
        rate = ("pair_x/(mass*people)", "pair_y/(mass*people)")
        return self.rule if self.walls else replace(self.rule, rate=rate, points={})

    def code(self) -> dict[str, Code]:
        def component(c: int) -> Code:
            def force(dx: Tensor, dy: Tensor, dvx: Tensor, dvy: Tensor) -> Tensor:
                return self.pair_force(torch.stack([dx, dy], -1), torch.stack([dvx, dvy], -1))[
                    ..., c
                ]

            return force

        return {"force_x": component(0), "force_y": component(1)}


class SocialForce(InteractionForce):
    """Helbing and Molnár's social force with contact and sliding friction.

    With h(y) = max(y, 0), d the distance, n the unit vector from j to i, t = (-n_y, n_x):

    * people: (A exp((2r - d)/B) + k h(2r - d)) n + kappa h(2r - d) ((v_j - v_i)·t) t
    * walls: (A exp((r - d)/B) + k h(r - d)) n + kappa h(r - d) s (v_i·t) t

    A (N), k (kg/s²) and kappa (kg/(m s)) are calibrated and kept >= 0; r (m), B (m) and mass
    (kg) are fixed. The paper prints s = +1, which speeds a person up along the wall; Helbing
    et al. (2000) have s = -1: ``opposing_wall_friction=True``.

    The paper's table of six settings is reproduced with B = 0.05, not with the B = 0.1 of its
    text, so 0.05 is the default here.

    Source: Göttlich & Totzeck, equation (InteractionForceHelbing).
    """

    rule = CrowdRule(
        rate=(
            "pair_x/(mass*people) + wall_x/(mass*points)",
            "pair_y/(mass*people) + wall_y/(mass*points)",
        ),
        others={"pair_x": ("N", "f_x"), "pair_y": ("N", "f_y")},
        points={
            "wall_x": ("N", "f_x(r=r/2, dvx=-sign*vx, dvy=-sign*vy)"),
            "wall_y": ("N", "f_y(r=r/2, dvx=-sign*vx, dvy=-sign*vy)"),
        },
        where={
            "contact": "max(2*r - d, 0)",
            "push": "A*exp((2*r - d)/B) + k*contact",
            "slide": "kappa*contact*(dvx*n_y - dvy*n_x)",
            "f_x": "push*n_x - slide*n_y",
            "f_y": "push*n_y + slide*n_x",
        },
        settings={"r": "m", "B": "m", "mass": "kg", "sign": "1"},
        force=("pair_x", "pair_y"),
    )
    name = "social_force"
    formula = "(A exp((2r - d)/B) + k h(2r - d)) n + kappa h(2r - d) (dv·t) t"
    source = "Göttlich & Totzeck, equation (InteractionForceHelbing); Helbing & Molnár 1995"

    def __init__(
        self,
        A: float,
        k: float,
        kappa: float,
        *,
        r: float = 0.25,
        B: float = 0.05,
        mass: float = 1.0,
        walls: bool = True,
        opposing_wall_friction: bool = False,
    ) -> None:
        super().__init__(mass, walls)
        _positive(r=r, B=B)
        positive = Interval(low=0.0)
        self.declare("A", A, unit="N", bounds=positive)
        self.declare("k", k, unit="kg/s²", bounds=positive)
        self.declare("kappa", kappa, unit="kg/(m s)", bounds=positive)
        self.A: Tensor
        self.k: Tensor
        self.kappa: Tensor
        self.r, self.B = r, B
        self.sign = -1.0 if opposing_wall_friction else 1.0

    @property
    def shape(self) -> tuple[Any, ...]:
        return (*super().shape, self.walls)

    def written(self, law: CrowdDynamics, owner: str, place: int) -> CrowdDynamics:
        return ruled(law, self, owner, place, self.own_rule)

    told = written

    def _of(self, over: str, seen: Mapping[str, Tensor]) -> Tensor:
        """``(..., 2)`` N: its summands over the others or over wall points."""
        law = formula_of(self)
        values = dict(zip(law.owned, values_of(law, own_values([self], law)), strict=True))
        like = seen["dx"]
        fixed = {k: like.new_tensor(value) for k, value in settings_of([self], law).items()}
        found = computed(list(law.sums[over].values()), {**seen, **values, **fixed})
        return torch.stack(found, -1)

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        seen = {"dx": dx[..., 0], "dy": dx[..., 1], "dvx": dv[..., 0], "dvy": dv[..., 1]}
        return self._of(OTHERS, seen)

    def wall_force(self, dx: Tensor, v: Tensor, normal: Tensor) -> Tensor:
        seen = {"dx": dx[..., 0], "dy": dx[..., 1], "vx": v[..., 0], "vy": v[..., 1]}
        return self._of(POINTS, seen)


class NetworkForce(InteractionForce):
    """Pair and wall force as two networks of relative position and relative velocity.

    A wall point has no velocity of its own; the paper gives it an artificial one so that one
    network can tell the walls apart. Here it is the wall's unit normal times 1 m/s.

    Args:
        hidden: neurons in each hidden layer, 4 in the paper.
        box: b keeps every weight in [-b, b]; None leaves them free.
        self_interaction: True sums over j = i as well, as printed: NN_pair(0, 0) pushes everyone,
            a lone person too, the same way. False leaves it out.

    Source: Göttlich & Totzeck, equation (NNseparate) and section 6.4.
    """

    rule = CrowdRule(
        rate=(
            "pair_x/(mass*people) + wall_x/(mass*points)",
            "pair_y/(mass*people) + wall_y/(mass*points)",
        ),
        # the networks are written out by written()
        others={"pair_x": ("N", "0"), "pair_y": ("N", "0")},
        points={"wall_x": ("N", "0"), "wall_y": ("N", "0")},
        settings={"mass": "kg"},
        force=("pair_x", "pair_y"),
    )
    name = "network_force"
    formula = "NN_pair(x_i - x_j, v_i - v_j), NN_wall(x_i - x_w, v_i - v_w)"
    source = "Göttlich & Totzeck, equation (NNseparate)"

    def __init__(
        self,
        hidden: int = 4,
        *,
        mass: float = 1.0,
        walls: bool = True,
        box: float | None = None,
        self_interaction: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(mass, walls)
        self.self_interaction = self_interaction
        self.pair = FeedForward((4, hidden, 2), generator)
        self.wall = FeedForward((4, hidden, 2), generator)
        if box is not None:
            self.bound_all("", Interval(-box, box))

    @property
    def shape(self) -> tuple[Any, ...]:
        return (*super().shape, self.walls, self.self_interaction, self.pair.sizes)

    def written(self, law: CrowdDynamics, owner: str, place: int) -> CrowdDynamics:
        """Both networks, neuron by neuron."""
        seen = [symbol(name) for name in ("dx", "dy", "dvx", "dvy")]
        pair, owned = self.pair.written(seen, f"{owner}__p", f"terms.{place}.pair.")
        wind = [symbol("vx") - symbol("normal_x"), symbol("vy") - symbol("normal_y")]
        wall, more = self.wall.written(seen[:2] + wind, f"{owner}__w", f"terms.{place}.wall.")
        owned |= more if self.walls else {}
        found = with_rule(law, owner, self.own_rule, {}, owned, dict.fromkeys(owned, "*"), place)
        for over, kind, outputs in ((OTHERS, "pair", pair), (POINTS, "wall", wall)):
            for axis, output in zip("xy", outputs, strict=True):
                found.sums[over][f"{owner}__{kind}_{axis}"] = output
                if over == OTHERS:
                    found.known[f"force_{axis}"] = output
        return found

    def components(self, state: State) -> dict[str, Tensor]:
        parts = super().components(state)
        if self.self_interaction:
            here = torch.zeros_like(state.x[:1, :1])
            own = self.pair_force(here, here) / (self.mass * state.scene.count)
            parts["pair"] = parts["pair"] + own
        return parts

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        out: Tensor = self.pair(torch.cat([dx, dv], -1))
        return out

    def wall_force(self, dx: Tensor, v: Tensor, normal: Tensor) -> Tensor:
        out: Tensor = self.wall(torch.cat([dx, v - normal], -1))
        return out
