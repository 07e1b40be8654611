"""Effects that change the base law's force between people: view, anticipation, rotation."""

from __future__ import annotations

from torch import Tensor

from nnode.data.sequence import Batch
from nnode.model.crowd_dynamics import CrowdRule
from nnode.model.effects.base import CATALOGUE, Effect, Probe, Strength
from nnode.model.effects.crowd_pairs import company
from nnode.model.laws import InteractionForce
from nnode.model.system import System
from nnode.model.term import Interval, State


class ForceEffect(Effect):
    """An effect that looks up the pair force of the base law and adds what changes of it."""

    domain = "crowd"
    confusable_group = "pair_force"

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        if system.find(InteractionForce) is None or not company(batch):
            return []
        return super().probes(batch, system)

    def forward(self, state: State) -> Tensor:
        """By its rule.

        Raises:
            ValueError: the model has no force between people.
        """
        if state.system is None or state.system.find(InteractionForce) is None:
            raise ValueError(
                f"effect {self.name} changes the force between people, but the model has none; "
                "add social_force or network_force to its terms"
            )
        return super().forward(state)


#: What is added to the acceleration: a mean over people, as that of the force.
_MEAN = ("more_x/(mass*people)", "more_y/(mass*people)")


@CATALOGUE.add
class FieldOfView(ForceEffect):
    """People mind those in front of them more than those behind.

    phi is the angle between i's walking direction and the direction to j.
    """

    name = "field_of_view"
    formula = "sum over j of (w_ij - 1) f_ij, w = lambda_ + (1 - lambda_) (1 + cos phi_ij)/2"
    rule = CrowdRule(
        rate=_MEAN,
        others={"more_x": ("N", "less*force_x"), "more_y": ("N", "less*force_y")},
        # the other is in the direction (-n_x, -n_y)
        where={"less": "(1 - lambda_)*((1 - (e_x*n_x + e_y*n_y))/2 - 1)"},
    )
    source = "Helbing, Farkas, Molnár & Vicsek 2002"
    built_into_laws = True
    strengths = {"lambda_": Strength(1.0, -0.1, Interval(-0.5, 1.5), "1", min_effect_size=0.25)}
    distinguishing_data = "people who follow others closely, so that some are behind and some ahead"

    lambda_: Tensor


@CATALOGUE.add
class Anticipation(ForceEffect):
    """People react to where they and the others will be in a moment."""

    name = "anticipation"
    formula = "sum over j of f(x_ij + T_a v_ij, v_ij) - f(x_ij, v_ij)"
    rule = CrowdRule(
        rate=_MEAN,
        others={
            "more_x": ("N", "force_x(dx=dx + T_a*dvx, dy=dy + T_a*dvy) - force_x"),
            "more_y": ("N", "force_y(dx=dx + T_a*dvx, dy=dy + T_a*dvy) - force_y"),
        },
    )
    source = (
        "a fixed time: Johansson, Helbing & Shukla 2007; positions then: Zanlungo, Ikeda & Kanda "
        "2011"
    )
    built_into_laws = True
    strengths = {"T_a": Strength(0.0, 0.1, Interval(-0.5, 2.0), "s", min_effect_size=0.2)}
    distinguishing_data = "approaches at different speeds that come equally near"

    T_a: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        if not super().probes(batch, system):
            return []
        # the force is far from linear in the time
        return [Probe({}, {"T_a": step}) for step in (0.1, 0.4, 0.8)]


@CATALOGUE.add
class EvasiveRotation(ForceEffect):
    """The force of those who come towards a person pushes him aside, not back.

    The force is turned by theta (1 - cos gamma)/2, gamma the angle between the two walking
    directions: by theta for people who meet head on, not at all for people who walk the same
    way; to the left for theta > 0.
    """

    name = "evasive_rotation"
    formula = "sum over j of (R(theta (1 - e_i·e_j)/2) - 1) f_ij"
    rule = CrowdRule(
        rate=_MEAN,
        others={
            "more_x": ("N", "(cos(angle) - 1)*force_x - sin(angle)*force_y"),
            "more_y": ("N", "sin(angle)*force_x + (cos(angle) - 1)*force_y"),
        },
        where={"angle": "theta*(1 - (e_x*other_x + e_y*other_y))/2"},
    )
    source = "Totzeck 2020 (an angle proportional to gamma there)"
    strengths = {"theta": Strength(0.0, 0.1, Interval(-1.6, 1.6), "rad", min_effect_size=0.3)}
    confusable_group = "avoidance_side"
    distinguishing_data = (
        "encounters passed on the left as well as on the right, head on and crossing"
    )

    theta: Tensor
