"""Effects that change the base law's force between people: view, anticipation, rotation."""

from __future__ import annotations

import torch
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.models.crowd import InteractionForce, dot, velocity
from nnode.models.effects.base import CATALOGUE, Effect, Probe, Strength
from nnode.models.effects.crowd_pairs import Neighbours, company, heading
from nnode.models.system import System
from nnode.models.term import Interval, State


class ForceEffect(Effect):
    """An effect that looks up the pair force of the base law and adds what changes of it."""

    domain = "crowd"
    kin = "pair_force"

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        if system.find(InteractionForce) is None or not company(batch):
            return []
        return super().probes(batch, system)

    def base(self, state: State) -> InteractionForce:
        """The term whose force is changed.

        Raises:
            ValueError: the model has none.
        """
        force = None if state.system is None else state.system.find(InteractionForce)
        if force is None:
            raise ValueError(
                f"effect {self.name} changes the force between people, but the model has none; "
                "add social_force or network_force to its terms"
            )
        return force


@CATALOGUE.add
class FieldOfView(ForceEffect):
    """People mind those in front of them more than those behind.

    phi is the angle between i's walking direction and the direction to j.
    """

    name = "field_of_view"
    formula = "sum over j of (w_ij - 1) f_ij, w = lambda_ + (1 - lambda_) (1 + cos phi_ij)/2"
    source = "Helbing, Farkas, Molnár & Vicsek 2002"
    strengths = {"lambda_": Strength(1.0, -0.1, Interval(-0.5, 1.5), "1", usual=0.25)}
    separated_by = "people who follow others closely, so that some are behind and some ahead"

    lambda_: Tensor

    def forward(self, state: State) -> Tensor:
        towards = -Neighbours.of(state).n
        cosine = dot(heading(velocity(state))[:, :, None], towards)
        weight = (1 - self.lambda_) * ((1 + cosine) / 2 - 1)
        return (weight[..., None] * self.base(state).pairs(state)).sum(2)


@CATALOGUE.add
class Anticipation(ForceEffect):
    """People react to where they and the others will be in a moment."""

    name = "anticipation"
    formula = "sum over j of f(x_ij + T_a v_ij, v_ij) - f(x_ij, v_ij)"
    source = "Zanlungo, Ikeda & Kanda 2011 (positions at a later time)"
    strengths = {"T_a": Strength(0.0, 0.1, Interval(-0.5, 2.0), "s", usual=0.2)}
    separated_by = "approaches at different speeds that come equally near"

    T_a: Tensor

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        if not super().probes(batch, system):
            return []
        # the force is far from linear in the time
        return [Probe({}, {"T_a": step}) for step in (0.1, 0.4, 0.8)]

    def forward(self, state: State) -> Tensor:
        base = self.base(state)
        return (base.pairs(state, self.T_a) - base.pairs(state)).sum(2)


@CATALOGUE.add
class EvasiveRotation(ForceEffect):
    """The force of those who come towards a person pushes him aside, not back.

    The force is turned by theta (1 - cos gamma)/2, gamma the angle between the two walking
    directions: by theta for people who meet head on, not at all for people who walk the same
    way; to the left for theta > 0.
    """

    name = "evasive_rotation"
    formula = "sum over j of (R(theta (1 - e_i·e_j)/2) - 1) f_ij"
    source = "Totzeck 2020 (an angle proportional to gamma there)"
    strengths = {"theta": Strength(0.0, 0.1, Interval(-1.6, 1.6), "rad", usual=0.3)}
    kin = "avoidance_side"
    separated_by = "encounters passed on the left as well as on the right, head on and crossing"

    theta: Tensor

    def forward(self, state: State) -> Tensor:
        force = self.base(state).pairs(state)
        own, other = heading(velocity(state)), heading(state.others[1])
        angle = self.theta * (1 - dot(own[:, :, None], other[:, None])) / 2
        turn, less = torch.sin(angle), torch.cos(angle) - 1
        fx, fy = force[..., 0], force[..., 1]
        return torch.stack([less * fx - turn * fy, turn * fx + less * fy], -1).sum(2)
