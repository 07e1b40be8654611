"""Effects between people that do not depend on the base law: a second range, friction."""

from __future__ import annotations

import math

from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model.crowd import norm
from nnode.model.crowd_dynamics import CrowdRule
from nnode.model.effects.base import CATALOGUE, Effect, Probe, Setting, Strength
from nnode.model.system import System
from nnode.model.term import Interval


def heading(v: Tensor) -> Tensor:
    """``(..., 2)``: the walking direction, a unit vector; 0 for someone who stands."""
    return v / norm(v)[..., None]


def company(batch: Batch) -> bool:
    """Whether anyone has others around."""
    return bool((batch.agent.sum(1) > 1).any())


class PairEffect(Effect):
    """An effect between people."""

    domain = "crowd"

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return super().probes(batch, system) if company(batch) else []


@CATALOGUE.add
class PairRepulsion(PairEffect):
    """A second, wider range of the repulsion between people."""

    name = "pair_repulsion"
    formula = "sum over j of A_2 exp((2r - d_ij)/B_2) n_ij"
    rule = CrowdRule(
        rate=("more_x", "more_y"),
        others={"more_x": ("m/s²", "push*n_x"), "more_y": ("m/s²", "push*n_y")},
        where={"push": "A_2*exp((2*r - d)/B_2)"},
    )
    source = "Helbing, Buzna, Johansson & Werner 2005 (two ranges)"
    built_into_laws = True
    strengths = {"A_2": Strength(0.0, 0.05, Interval(-0.2, 20.0), "m/s²", min_effect_size=0.2)}
    settings = {"B_2": Setting(0.8, Interval(0.1, 3.0), "m")}
    confusable_group = "pair_force"
    distinguishing_data = (
        "encounters from all sides: this force is the same ahead and behind, and at every speed "
        "of approach"
    )

    A_2: Tensor
    B_2: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        if not company(batch):
            return []
        return [Probe({"B_2": reach}, {"A_2": 0.05}) for reach in (0.4, 0.8, 1.4)]


@CATALOGUE.add
class SlidingFriction(PairEffect):
    """Friction between people who pass each other, also without contact.

    It slows the sliding along the tangent t = (-n_y, n_x) over a range of B.
    """

    name = "sliding_friction"
    formula = "sum over j of c exp((2r - d_ij)/B) ((v_j - v_i)·t_ij) t_ij, B = 0.5 m"
    rule = CrowdRule(
        rate=("drag_x", "drag_y"),
        others={"drag_x": ("m/s²", "-slide*n_y"), "drag_y": ("m/s²", "slide*n_x")},
        where={"slide": "c*exp((2*r - d)/reach)*(dvx*n_y - dvy*n_x)"},
        constants={"reach": (0.5, "m")},
    )
    source = "Helbing, Farkas & Vicsek 2000, with a range beyond contact"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.05, 10.0), "1/s", min_effect_size=0.2)}
    confusable_group = "velocity_of_others"
    distinguishing_data = "people who pass at different distances, overtaking as well as head on"

    c: Tensor


@CATALOGUE.add
class Alignment(PairEffect):
    """People adopt the velocity of those around them, the near ones most."""

    name = "alignment"
    formula = "c sum_j w_ij (v_j - v_i) / sum_j w_ij, w_ij = exp(-d_ij/R), R = 2 m"
    rule = CrowdRule(
        rate=("c*pull_x/(near + few)", "c*pull_y/(near + few)"),
        others={
            "near": ("1", "weight"),
            "pull_x": ("m/s", "-weight*dvx"),
            "pull_y": ("m/s", "-weight*dvy"),
        },
        where={"weight": "exp(-d/reach)"},
        # the small number keeps someone without neighbours finite
        constants={"reach": (2.0, "m"), "few": (1e-12, "1")},
    )
    source = "Vicsek et al. 1995; Cucker & Smale 2007"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.05, 5.0), "1/s", min_effect_size=0.2)}
    confusable_group = "velocity_of_others"
    distinguishing_data = (
        "people who walk side by side at different speeds, far apart as well as near"
    )

    c: Tensor


@CATALOGUE.add
class DensitySlowdown(PairEffect):
    """People slow down where it is dense."""

    name = "density_slowdown"
    formula = "-c rho_i v_i, rho_i = sum_j exp(-d_ij²/(2 h²)) / (2 pi h²), h = 1 m"
    rule = CrowdRule(
        rate=("-c*density*vx", "-c*density*vy"),
        others={"density": ("1/m²", f"exp(-d**2/(2*h**2))/({2 * math.pi!r}*h**2)")},
        constants={"h": (1.0, "m")},
    )
    source = (
        "a drag that grows with density; that of Helbing, Johansson & Al-Abideen 2007, not "
        "Weidmann's relation"
    )
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.05, 5.0), "m²/s", min_effect_size=0.1)}
    confusable_group = "speed"
    distinguishing_data = "the same people at different densities"

    c: Tensor
