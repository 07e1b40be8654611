"""Effects on pedestrians: of others, on the force between people, of places, and differences
between people."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model.crowd import norm
from nnode.model.effects.base import (
    CATALOGUE,
    Effect,
    IndividualEffect,
    Probe,
    Setting,
    Strength,
)
from nnode.model.scene import Scene
from nnode.model.system import System
from nnode.model.term import Interval
from nnode.model.terms import Rule

#: Spacing of the grid of tested places, m, and largest number of its cells.
SPACING, CELLS = 0.8, 170


def heading(v: Tensor) -> Tensor:
    """``(..., 2)``: the walking direction, a unit vector; 0 for a standing person."""
    return v / norm(v)[..., None]


class CrowdEffect(Effect):
    """An effect on people."""

    domain = "crowd"


class PairEffect(CrowdEffect):
    """An effect between people."""

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        return bool((batch.agent.sum(1) > 1).any()) and super().applies(batch, system)


# -- others ------------------------------------------------------------------------------------


@CATALOGUE.add
class PairRepulsion(PairEffect):
    """A second, wider range of the repulsion between people."""

    name = "pair_repulsion"
    rules = {
        2: Rule(
            rate=("more_x", "more_y"),
            others={"more_x": ("m/s²", "push*n_x"), "more_y": ("m/s²", "push*n_y")},
            where={"push": "A_2*exp((2*r - d)/B_2)"},
        )
    }
    source = "Helbing, Buzna, Johansson & Werner 2005 (two ranges)"
    built_into_laws = True
    strengths = {"A_2": Strength(0.0, 0.05, Interval(-0.2, 20.0), "m/s²", min_effect_size=0.2)}
    settings = {"B_2": Setting(0.8, Interval(0.1, 3.0), "m")}
    tried = {"B_2": (0.4, 0.8, 1.4)}
    confusable_group = "pair_force"
    distinguishing_data = (
        "encounters from all sides: this force is the same ahead and behind, and at every speed "
        "of approach"
    )


@CATALOGUE.add
class SlidingFriction(PairEffect):
    """Friction between people who pass each other, also without contact.

    It slows the sliding along the tangent t = (-n_y, n_x) over a range of B.
    """

    name = "sliding_friction"
    rules = {
        2: Rule(
            rate=("drag_x", "drag_y"),
            others={"drag_x": ("m/s²", "-slide*n_y"), "drag_y": ("m/s²", "slide*n_x")},
            where={"slide": "c*exp((2*r - d)/reach)*(dvx*n_y - dvy*n_x)"},
            constants={"reach": (0.5, "m")},
        )
    }
    source = "Helbing, Farkas & Vicsek 2000, with a range beyond contact"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.05, 10.0), "1/s", min_effect_size=0.2)}
    confusable_group = "velocity_of_others"
    distinguishing_data = "people who pass at different distances, overtaking as well as head on"


@CATALOGUE.add
class Alignment(PairEffect):
    """People adopt the velocity of those around them, the near ones most."""

    name = "alignment"
    rules = {
        2: Rule(
            rate=("c*pull_x/(near + few)", "c*pull_y/(near + few)"),
            others={
                "near": ("1", "weight"),
                "pull_x": ("m/s", "-weight*dvx"),
                "pull_y": ("m/s", "-weight*dvy"),
            },
            where={"weight": "exp(-d/reach)"},
            # the small number keeps the quotient finite for people without neighbours
            constants={"reach": (2.0, "m"), "few": (1e-12, "1")},
        )
    }
    source = "Vicsek et al. 1995; Cucker & Smale 2007"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.05, 5.0), "1/s", min_effect_size=0.2)}
    confusable_group = "velocity_of_others"
    distinguishing_data = (
        "people who walk side by side at different speeds, far apart as well as near"
    )


@CATALOGUE.add
class DensitySlowdown(PairEffect):
    """People slow down where it is dense."""

    name = "density_slowdown"
    rules = {
        2: Rule(
            rate=("-c*density*vx", "-c*density*vy"),
            others={"density": ("1/m²", f"exp(-d**2/(2*h**2))/({2 * math.pi!r}*h**2)")},
            constants={"h": (1.0, "m")},
        )
    }
    source = (
        "a drag that grows with density; that of Helbing, Johansson & Al-Abideen 2007, not "
        "Weidmann's relation"
    )
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.05, 5.0), "m²/s", min_effect_size=0.1)}
    confusable_group = "speed"
    distinguishing_data = "the same people at different densities"


# -- the law's force between people ------------------------------------------------------------


def _force(x: str, y: str, where: Mapping[str, str] | None = None) -> dict[int, Rule]:
    """Rules of an addition to the force of another person, averaged over people as the force."""
    rate = ("more_x/(mass*people)", "more_y/(mass*people)")
    others = {"more_x": ("N", x), "more_y": ("N", y)}
    return {2: Rule(rate=rate, others=others, where=where or {})}


class ForceEffect(PairEffect):
    """An effect that changes the base law's force between people."""

    acts_on = "force"
    confusable_group = "pair_force"


@CATALOGUE.add
class FieldOfView(ForceEffect):
    """People mind those in front of them more than those behind."""

    name = "field_of_view"
    rules = _force(
        "less*force_x",
        "less*force_y",
        # the other is in the direction (-n_x, -n_y)
        {"less": "(1 - lambda_)*((1 - (e_x*n_x + e_y*n_y))/2 - 1)"},
    )
    source = "Helbing, Farkas, Molnár & Vicsek 2002"
    built_into_laws = True
    strengths = {"lambda_": Strength(1.0, -0.1, Interval(-0.5, 1.5), "1", min_effect_size=0.25)}
    distinguishing_data = "people who follow others closely, so that some are behind and some ahead"


@CATALOGUE.add
class Anticipation(ForceEffect):
    """People react to where they and the others will be in a moment."""

    name = "anticipation"
    rules = _force(
        "force_x(dx=dx + T_a*dvx, dy=dy + T_a*dvy) - force_x",
        "force_y(dx=dx + T_a*dvx, dy=dy + T_a*dvy) - force_y",
    )
    source = (
        "a fixed time: Johansson, Helbing & Shukla 2007; positions then: Zanlungo, Ikeda & Kanda "
        "2011"
    )
    built_into_laws = True
    strengths = {"T_a": Strength(0.0, 0.1, Interval(-0.5, 2.0), "s", min_effect_size=0.2)}
    tried = {"T_a": (0.1, 0.4, 0.8)}  # the force is far from linear in the time
    distinguishing_data = "approaches at different speeds that come equally near"


@CATALOGUE.add
class EvasiveRotation(ForceEffect):
    """The force of oncoming people pushes a person sideways instead of back.

    The force is turned by theta (1 - cos gamma)/2, gamma the angle between the two walking
    directions: by theta for people who meet head on, not at all for people who walk the same
    way; to the left for theta > 0.
    """

    name = "evasive_rotation"
    rules = _force(
        "(cos(angle) - 1)*force_x - sin(angle)*force_y",
        "sin(angle)*force_x + (cos(angle) - 1)*force_y",
        {"angle": "theta*(1 - (e_x*other_x + e_y*other_y))/2"},
    )
    source = "Totzeck 2020 (an angle proportional to gamma there)"
    strengths = {"theta": Strength(0.0, 0.1, Interval(-1.6, 1.6), "rad", min_effect_size=0.3)}
    confusable_group = "avoidance_side"
    distinguishing_data = (
        "encounters passed on the left as well as on the right, head on and crossing"
    )


# -- what differs from person to person --------------------------------------------------------


@CATALOGUE.add
class WalkerHeterogeneity(CrowdEffect, IndividualEffect):
    """Some people steer to their destination more vigorously than others.

    ``people`` holds their eta_i.
    """

    name = "walker_heterogeneity"
    rules = {2: Rule(rate=("eta*drive_x", "eta*drive_y"), inputs={"eta": "1"})}
    source = "Campanella, Hoogendoorn & Daamen 2009 (heterogeneous walkers)"
    acts_on = "drive"
    strengths = {"sigma": Strength(0.0, 0.05, Interval(0.0, 2.0), "1", min_effect_size=0.2)}
    in_equation = False
    distinguishing_data = "people who are recorded for longer and turn more often"

    @classmethod
    def person(cls, numbers: np.ndarray, options: dict[str, Any]) -> float:
        """The number, at least -1. Below -1 a person would move away from the destination."""
        return max(float(numbers[0]), -1.0)


@CATALOGUE.add
class GaitSway(CrowdEffect, IndividualEffect):
    """People sway from side to side as they step.

    ``people`` holds their phases phase_i (rad) at the clock time 0.
    """

    name = "gait_sway"
    rules = {
        2: Rule(
            rate=("sway*e_y", "-sway*e_x"),
            where={"sway": f"a*sin({2 * math.pi!r}*f*clock + phase)*there"},
            inputs={"phase": "1", "there": "1"},
        )
    }
    source = "Hoogendoorn & Daamen 2005; Liu, Song & Zhang 2009 (lateral sway)"
    strengths = {"a": Strength(0.0, 0.05, Interval(0.0, 5.0), "m/s²", min_effect_size=0.3)}
    settings = {"f": Setting(0.95, Interval(0.5, 1.6), "Hz")}
    tried = {"f": tuple(0.6 + 0.05 * i for i in range(17))}
    distinguishing_data = "sampling of at least 5 Hz with a noise below the amplitude of the sway"

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        return batch.dt <= 0.25

    @classmethod
    def directions(cls, options: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
        """Sine and cosine of the clock, at 1 m/s²."""
        unit = {**options, "a": 1.0}
        return [(unit, 0.0), (unit, math.pi / 2)]

    @classmethod
    def person(cls, numbers: np.ndarray, options: dict[str, Any]) -> float:
        """The phase, from the amplitudes of the sine and the cosine of the clock."""
        return float(np.arctan2(numbers[1], numbers[0]))

    @classmethod
    def spread(cls, sigma: float) -> float:
        """The amplitude: sine and cosine share its square."""
        return math.sqrt(2) * sigma


# -- side, company, pace ---------------------------------------------------------------------


@CATALOGUE.add
class SidePreference(PairEffect):
    """People step to one side, to the right for c > 0, when somebody comes towards them.

    The weight of an encounter increases with the alignment of the other person with the walking
    direction, with the opposition of both walking directions, and with proximity.
    """

    name = "side_preference"
    rules = {
        2: Rule(
            rate=("c*(1 - exp(-met))*e_y", "-c*(1 - exp(-met))*e_x"),
            others={"met": ("1", "max(ahead, 0)*max(facing, 0)*logistic((reach - d)/edge)")},
            where={
                "ahead": "-(e_x*n_x + e_y*n_y)",
                "facing": "-(e_x*other_x + e_y*other_y)",
            },
            constants={"reach": (3.0, "m"), "edge": (0.3, "m")},
        )
    }
    source = "Moussaïd et al. 2009 (side preference in avoidance)"
    strengths = {"c": Strength(0.0, 0.02, Interval(-3.0, 3.0), "m/s²", min_effect_size=0.1)}
    confusable_group = "avoidance_side"
    distinguishing_data = (
        "encounters at different distances and angles, so that the force's shape shows"
    )


@CATALOGUE.add
class GroupCohesion(CrowdEffect):
    """Members of a social group are drawn to the middle of the others of their group."""

    name = "group_cohesion"
    covariate = "group"
    rules = {
        2: Rule(
            rate=("-c*way_x/max(mates, 1)", "-c*way_y/max(mates, 1)"),
            others={
                "mates": ("1", "mate"),
                "way_x": ("m", "mate*dx"),
                "way_y": ("m", "mate*dy"),
            },
            # groups are numbered from 1; 0 is for people without a group
            where={"mate": "choose(group - 0.5, choose(0.5 - abs(group - group_j), 1, 0), 0)"},
            inputs={"group": "1"},
        )
    }
    source = "Moussaïd et al. 2010"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.05, 5.0), "1/s²", min_effect_size=0.1)}
    distinguishing_data = "groups that are pulled apart"

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        names = [[name for name in group or () if name] for group in batch.group]
        return any(len(set(group)) < len(group) for group in names)

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        return {"group": scene.companies}


@CATALOGUE.add
class PreferredSpeed(CrowdEffect):
    """People return to a preferred speed; the base law keeps whatever speed they have."""

    name = "preferred_speed"
    rules = {2: Rule(rate=("c*(v_pref - speed)*e_x", "c*(v_pref - speed)*e_y"))}
    source = "Helbing & Molnár 1995 (relaxation to the desired speed)"
    strengths = {"c": Strength(0.0, 0.02, Interval(-0.02, 5.0), "1/s", min_effect_size=0.2)}
    settings = {"v_pref": Setting(1.3, Interval(0.0, 3.0), "m/s")}
    confusable_group = "speed"
    sets_desired_speed = True
    distinguishing_data = "people who walk faster and slower than preferred, in thin crowds"

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        real = batch.valid[:-1] & batch.valid[1:]
        step = torch.linalg.vector_norm(batch.x[1:] - batch.x[:-1], dim=-1) / batch.dt
        levels = torch.quantile(step[real][:100_000], torch.tensor([0.15, 0.5, 0.85]).to(step))
        return [Probe({"v_pref": min(float(level), 3.0)}, {"c": 0.02}) for level in levels]


@CATALOGUE.add
class Drift(CrowdEffect):
    """A constant acceleration of everyone."""

    name = "drift"
    rules = {2: Rule(rate=("a_x", "a_y"))}
    source = "a slope, a wind or a current; no specific source"
    strengths = dict.fromkeys(
        ("a_x", "a_y"), Strength(0.0, 0.02, Interval(-3.0, 3.0), "m/s²", min_effect_size=0.1)
    )
    distinguishing_data = "people who walk in several directions at several places"


# -- places ------------------------------------------------------------------------------------


@CATALOGUE.add
class WallRepulsion(CrowdEffect):
    """People keep away from walls, beyond what the base law has.

    ``far`` is the distance from the nearest point of a wall, r the radius.
    """

    name = "wall_repulsion"
    rules = {
        2: Rule(
            rate=("away_x", "away_y"),
            walls={"away_x": ("m/s²", "push*off_x"), "away_y": ("m/s²", "push*off_y")},
            where={
                "long": "max(along_x**2 + along_y**2, least**2)",
                "share": "clip((dx*along_x + dy*along_y)/long, 0, 1)",
                "off_x": "dx - share*along_x",
                "off_y": "dy - share*along_y",
                "far": "sqrt(off_x**2 + off_y**2 + small_m**2)",
                "push": "A_w*exp((r - far)/B_w)/far",
            },
            constants={"least": (1e-6, "m")},
        )
    }
    source = "Helbing & Molnár 1995"
    strengths = {"A_w": Strength(0.0, 0.05, Interval(-0.5, 20.0), "m/s²", min_effect_size=0.2)}
    settings = {"B_w": Setting(0.4, Interval(0.05, 2.0), "m")}
    tried = {"B_w": (0.2, 0.4, 0.8)}
    distinguishing_data = "people at different distances from walls on both sides"

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        return not batch.walls.isnan().any(-1).all()


def places(batch: Batch) -> list[tuple[float, float]]:
    """Centres of the cells of a coarse grid in which people walk, and of their neighbours."""
    real = batch.valid & batch.agent
    walked = batch.x[real].reshape(-1, 2).cpu().numpy()
    spacing = SPACING
    while True:
        cells = np.unique(np.floor(walked / spacing).astype(int), axis=0)
        around = {(i + a, j + b) for i, j in cells for a in (-1, 0, 1) for b in (-1, 0, 1)}
        if len(around) <= CELLS:
            return [((i + 0.5) * spacing, (j + 0.5) * spacing) for i, j in sorted(around)]
        spacing *= 1.25


_PLACE = Rule(
    rate=("push*to_x", "push*to_y"),
    where={
        "to_x": "x - x_o",
        "to_y": "y - y_o",
        "far": "sqrt(to_x**2 + to_y**2 + small_m**2)",
        "push": "A_o*exp(-far/B_o)/far",
    },
)


class PlaceEffect(CrowdEffect):
    """A force from or towards an unknown place."""

    strengths = {"A_o": Strength(0.0, 0.05, Interval(0.0, 20.0), "m/s²", min_effect_size=0.2)}
    settings = {
        "B_o": Setting(0.8, Interval(0.1, 5.0), "m"),
        "x_o": Setting(0.0, Interval(), "m"),
        "y_o": Setting(0.0, Interval(), "m"),
    }
    confusable_group = "place"
    distinguishing_data = "people who pass the place on all sides"

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        return [
            Probe({"x_o": x, "y_o": y, "B_o": reach}, {"A_o": 0.05})
            for reach in (0.6, 1.5)
            for x, y in places(batch)
        ]


@CATALOGUE.add
class Obstacle(PlaceEffect):
    """People keep away from an unknown place."""

    name = "obstacle"
    rules = {2: _PLACE}
    source = "Helbing & Molnár 1995 (repulsion from obstacles)"


@CATALOGUE.add
class Attraction(PlaceEffect):
    """People are drawn to an unknown place."""

    name = "attraction"
    rules = {2: replace(_PLACE, rate=("-push*to_x", "-push*to_y"))}
    source = "Helbing & Molnár 1995 (attractive places)"
