"""Effects on a person's own motion: pace, side, company."""

from __future__ import annotations

import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model.crowd_dynamics import CrowdRule
from nnode.model.effects.base import CATALOGUE, Effect, Probe, Setting, Strength
from nnode.model.effects.crowd_pairs import PairEffect
from nnode.model.scene import Scene
from nnode.model.system import System
from nnode.model.term import Interval


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
    rule = CrowdRule(
        rate=("c*(1 - exp(-met))*e_y", "-c*(1 - exp(-met))*e_x"),
        others={"met": ("1", "max(ahead, 0)*max(facing, 0)*logistic((reach - d)/edge)")},
        where={
            "ahead": "-(e_x*n_x + e_y*n_y)",
            "facing": "-(e_x*other_x + e_y*other_y)",
        },
        constants={"reach": (3.0, "m"), "edge": (0.3, "m")},
    )
    source = "Moussaïd et al. 2009 (side preference in avoidance)"
    strengths = {"c": Strength(0.0, 0.02, Interval(-3.0, 3.0), "m/s²", min_effect_size=0.1)}
    confusable_group = "avoidance_side"
    distinguishing_data = (
        "encounters at different distances and angles, so that the force's shape shows"
    )

    c: Tensor


@CATALOGUE.add
class GroupCohesion(Effect):
    """Members of a social group are drawn to the middle of the others of their group."""

    name = "group_cohesion"
    covariate = "group"
    formula = "c (mean of x_j over the others of the group - x_i)"
    rule = CrowdRule(
        rate=("-c*way_x/max(mates, 1)", "-c*way_y/max(mates, 1)"),
        others={
            "mates": ("1", "mate"),
            "way_x": ("m", "mate*dx"),
            "way_y": ("m", "mate*dy"),
        },
        # groups are numbered from 1; 0 is nobody's
        where={"mate": "choose(group - 0.5, choose(0.5 - abs(group - group_j), 1, 0), 0)"},
        inputs={"group": "1"},
    )
    source = "Moussaïd et al. 2010"
    domain = "crowd"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.05, 5.0), "1/s²", min_effect_size=0.1)}
    distinguishing_data = "groups that are pulled apart"

    c: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        names = [[name for name in group or () if name] for group in batch.group]
        together = any(len(set(group)) < len(group) for group in names)
        return super().probes(batch, system) if together else []

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        return {"group": scene.companies}


@CATALOGUE.add
class PreferredSpeed(Effect):
    """People return to a preferred speed; the base law keeps whatever speed they have."""

    name = "preferred_speed"
    formula = "c (v_pref - |v|) v/|v|"
    rule = CrowdRule(rate=("c*(v_pref - speed)*e_x", "c*(v_pref - speed)*e_y"))
    source = "Helbing & Molnár 1995 (relaxation to the desired speed)"
    domain = "crowd"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.02, 5.0), "1/s", min_effect_size=0.2)}
    settings = {"v_pref": Setting(1.3, Interval(0.0, 3.0), "m/s")}
    confusable_group = "speed"
    sets_desired_speed = True
    distinguishing_data = "people who walk faster and slower than preferred, in thin crowds"

    c: Tensor
    v_pref: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        real = batch.valid[:-1] & batch.valid[1:]
        step = torch.linalg.vector_norm(batch.x[1:] - batch.x[:-1], dim=-1) / batch.dt
        levels = torch.quantile(step[real][:100_000], torch.tensor([0.15, 0.5, 0.85]).to(step))
        return [Probe({"v_pref": min(float(level), 3.0)}, {"c": 0.02}) for level in levels]


@CATALOGUE.add
class Drift(Effect):
    """A constant acceleration of everyone."""

    name = "drift"
    formula = "(a_x, a_y)"
    rule = CrowdRule(rate=("a_x", "a_y"))
    source = "a slope, a wind or a current; no specific source"
    domain = "crowd"
    strengths = {
        "a_x": Strength(0.0, 0.02, Interval(-3.0, 3.0), "m/s²", min_effect_size=0.1),
        "a_y": Strength(0.0, 0.02, Interval(-3.0, 3.0), "m/s²", min_effect_size=0.1),
    }
    distinguishing_data = "people who walk in several directions at several places"

    a_x: Tensor
    a_y: Tensor
