"""Effects on a person's own motion: pace, side, company."""

from __future__ import annotations

import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.models.crowd import dot, norm, velocity
from nnode.models.effects.base import CATALOGUE, Effect, Probe, Setting, Strength
from nnode.models.effects.crowd_pairs import (
    Neighbours,
    PairEffect,
    heading,
    right_of,
)
from nnode.models.system import System
from nnode.models.term import Interval, State


@CATALOGUE.add
class SidePreference(PairEffect):
    """People step to one side, to the right for c > 0, when somebody comes towards them.

    An encounter counts by how far the other is ahead, how straight he comes, and how near he is.
    """

    name = "side_preference"
    formula = (
        "c (1 - exp(-sum_j w_ij)) right_i, w_ij = h(e_i·e_ij) h(-e_i·e_j) / (1 + exp((d - D)/S)),"
        " D = 3 m, S = 0.3 m"
    )
    source = "Moussaïd et al. 2009 (side preference in avoidance)"
    strengths = {"c": Strength(0.0, 0.02, Interval(-3.0, 3.0), "m/s²", usual=0.1)}
    kin = "avoidance_side"
    separated_by = "encounters at different distances and angles, so that the force's shape shows"

    #: D and S, m
    REACH, EDGE = 3.0, 0.3
    c: Tensor

    def forward(self, state: State) -> Tensor:
        pair = Neighbours.of(state)
        own, other = heading(velocity(state)), heading(state.others[1])
        ahead = -dot(own[:, :, None], pair.n)
        facing = -dot(own[:, :, None], other[:, None])
        near = torch.sigmoid((self.REACH - pair.d) / self.EDGE)
        weight = pair.acts * ahead.clamp(min=0) * facing.clamp(min=0) * near
        met = 1 - torch.exp(-weight.sum(2))
        return self.c * met[..., None] * right_of(own)


@CATALOGUE.add
class GroupCohesion(Effect):
    """Members of a social group are drawn to the middle of the others of their group."""

    name = "group_cohesion"
    covariate = "group"
    formula = "c (mean of x_j over the others of the group - x_i)"
    source = "Moussaïd et al. 2010"
    domain = "crowd"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.05, 5.0), "1/s²", usual=0.1)}
    separated_by = "groups that are pulled apart"

    c: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        names = [[name for name in group or () if name] for group in batch.group]
        together = any(len(set(group)) < len(group) for group in names)
        return super().probes(batch, system) if together else []

    def forward(self, state: State) -> Tensor:
        mates = state.scene.companions.to(state.x.dtype)
        share = mates / mates.sum(2, keepdim=True).clamp(min=1)
        way = state.others[0][:, None] - state.x[:, :, None]
        return self.c * (share[..., None] * way).sum(2)


@CATALOGUE.add
class PreferredSpeed(Effect):
    """People return to a preferred speed; the base law keeps whatever speed they have."""

    name = "preferred_speed"
    formula = "c (v_pref - |v|) v/|v|"
    source = "Helbing & Molnár 1995 (relaxation to the desired speed)"
    domain = "crowd"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.02, 5.0), "1/s", usual=0.2)}
    settings = {"v_pref": Setting(1.3, Interval(0.0, 3.0), "m/s")}
    kin = "speed"
    separated_by = "people who walk faster and slower than preferred, in thin crowds"

    c: Tensor
    v_pref: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        real = batch.valid[:-1] & batch.valid[1:]
        step = torch.linalg.vector_norm(batch.x[1:] - batch.x[:-1], dim=-1) / batch.dt
        levels = torch.quantile(step[real][:100_000], torch.tensor([0.15, 0.5, 0.85]).to(step))
        return [Probe({"v_pref": min(float(level), 3.0)}, {"c": 0.02}) for level in levels]

    def forward(self, state: State) -> Tensor:
        v = velocity(state)
        return self.c * ((self.v_pref - norm(v))[..., None] * heading(v))


@CATALOGUE.add
class Drift(Effect):
    """A constant acceleration of everyone."""

    name = "drift"
    formula = "(a_x, a_y)"
    source = "a slope, a wind or a current; no specific source"
    domain = "crowd"
    strengths = {
        "a_x": Strength(0.0, 0.02, Interval(-3.0, 3.0), "m/s²", usual=0.1),
        "a_y": Strength(0.0, 0.02, Interval(-3.0, 3.0), "m/s²", usual=0.1),
    }
    separated_by = "people who walk in several directions at several places"

    a_x: Tensor
    a_y: Tensor

    def forward(self, state: State) -> Tensor:
        one = torch.ones_like(state.x[..., 0])
        return torch.stack([self.a_x * one, self.a_y * one], -1)
