"""The calibrated force of a crowd model at any relative position and velocity.

Forces act on person i; relative positions are x_i - x_j and relative velocities v_i - v_j. A
positive first component pushes i towards larger x: where i stands on the right of j that is
repulsion, on the left attraction.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch

from nnode.errors import ConfigError
from nnode.model import InteractionForce, System

Part = Literal["sum", "pair", "wall"]
Vector = tuple[float, float]


def interaction(system: System) -> InteractionForce:
    """The first interaction force among the terms of ``system``.

    Raises:
        ConfigError: there is none.
    """
    force = system.find(InteractionForce)
    if force is None:
        raise ConfigError(
            "a force figure needs a crowd model with an interaction force, found a "
            f"{system.domain} model with the terms {[t.name for t in system.terms]}"
        )
    return force


@torch.no_grad()
def evaluate_force(
    system: System, dx: np.ndarray, dv: np.ndarray, part: Part | None = None
) -> np.ndarray:
    """Interaction force of a model, not divided by mass or number of people.

    Args:
        dx: ``(..., 2)`` x_i - x_j in m.
        dv: ``(..., 2)`` v_i - v_j in m/s. For the wall, v_i minus the velocity of the wall
            point, which in a network is the artificial one.
        part: ``pair``; ``wall``; or ``sum`` of both at the same dx and dv, as the paper adds
            its two networks. Default: ``pair`` for the social force, else ``sum``. A model
            without walls has ``sum`` = ``pair``.

    Returns:
        ``(..., 2)`` N.

    Raises:
        ConfigError: no interaction force, or ``wall`` of a model without walls.
    """
    term = interaction(system)
    chosen = chosen_part(term, part)
    like = next(term.parameters(), torch.zeros((), dtype=torch.float64))
    position, velocity = (
        torch.from_numpy(np.array(value, dtype=np.float64)).to(like) for value in (dx, dv)
    )
    force = torch.zeros_like(position)
    if chosen != "wall":
        force = force + term.pair_force(position, velocity)
    if chosen != "pair" and term.walls:
        force = force + term.wall_force(position, velocity, torch.zeros_like(velocity))
    return np.asarray(force.double().cpu().numpy())


def force_range(term: InteractionForce) -> str:
    """``short`` for the social force, ``long`` for others; the paper draws them differently."""
    return "short" if term.entry == "social_force" else "long"


def chosen_part(term: InteractionForce, part: Part | None) -> Part:
    """``part``, or the default of ``term``; see :func:`evaluate_force` for both."""
    if part is None:
        return "pair" if term.entry == "social_force" else "sum"
    if part == "wall" and not term.walls:
        raise ConfigError("part=wall: this model was built without walls (model.walls=false)")
    return part


def describe(term: InteractionForce, part: Part | None) -> str:
    """The name of the force and its part, for a title."""
    parts = {"sum": "pair + wall" if term.walls else "pair", "pair": "pair", "wall": "wall"}
    return f"{term.name.replace('_', ' ')}, {parts[chosen_part(term, part)]}"
