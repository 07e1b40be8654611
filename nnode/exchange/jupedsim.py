"""Calibrated social forces as parameters of JuPedSim's social force model.

Both have the same force between two people, A exp((2r - d)/B) n with contact and sliding
friction. Two things differ. Here a person's forces are averaged over the N people and the P wall
points of the scene, there they are summed; and walls are points here, there the nearest point of
each edge. The mass takes up the first difference, the strength of obstacles the second.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import kve

from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.exchange.counterpart import Counterpart, effects_without
from nnode.models import Relaxation, SocialForce, System
from nnode.models.scene import wall_points


@dataclass
class Scenes:
    """What parameters depend on beside the model: means over sequences.

    Attributes:
        people: number of people.
        points: number of wall points; 0 where no sequence has walls.
        spacing: distance of neighbouring wall points, m.
        speed: median of the measured speeds, m/s.
    """

    people: float
    points: float
    spacing: float
    speed: float


def scenes_of(sequences: Iterable[Sequence], spacing: float) -> Scenes:
    """Look at all sequences, whose walls become points ``spacing`` (m) apart or closer."""
    people, points, speeds, gaps = [], [], [], []
    for s in sequences:
        people.append(s.n_agents)
        speeds.append(np.linalg.norm(s.velocity(), axis=-1).ravel())
        number = 0
        if s.walls is not None and len(s.walls):
            _, _, real = wall_points(torch.as_tensor(s.walls)[None], spacing)
            number = int(real.sum())
            length = np.linalg.norm(s.walls[:, 2:] - s.walls[:, :2], axis=1).sum()
            gaps.append(length / (number - len(s.walls)))
        points.append(number)
    return Scenes(
        people=float(np.mean(people)),
        points=float(np.mean(points)),
        spacing=float(np.mean(gaps)) if gaps else spacing,
        speed=float(np.median(np.concatenate(speeds))),
    )


def points_per_edge(r: float, B: float, spacing: float) -> float:
    """How much stronger a long row of points acts than the nearest point of an edge.

    At distance r (m), where a person touches the wall, only the pushes' parts along the normal
    add up: the mean over the row's places of sum exp((r - d_p)/B) r/d_p, which is
    2 r exp(r/B) K_0(r/B) / spacing with the Bessel function K_0.
    """
    return float(2 * r * kve(0, r / B) / spacing)


def jupedsim_parameters(system: System, scenes: Scenes) -> Counterpart:
    """JSON with the arguments of ``SocialForceModel`` (``model``) and of
    ``SocialForceModelAgentParameters`` (``agent``), in JuPedSim's units.

    Raises:
        ConfigError: the model is no social force.
    """
    force, relaxation = system.find(SocialForce), system.find(Relaxation)
    if force is None:
        raise ConfigError(
            "to=jupedsim: the run's model has no social force, and JuPedSim has no counterpart "
            "to another; leave it out of to="
        )
    found = Counterpart()
    walls = force.walls and scenes.points > 0
    mass = force.mass * scenes.people
    strength, k, kappa = (float(value.detach()) for value in (force.A, force.k, force.kappa))
    obstacle = 0.0
    if walls:
        share = scenes.people / scenes.points
        obstacle = strength * share * points_per_edge(force.r, force.B, scenes.spacing)
        found.notes.append(
            "obstacle_scale: equals the wall points' force on a person who touches a long "
            "straight wall; farther away and at corners the two differ"
        )
        found.missing.append(
            "k and kappa at walls: JuPedSim has one body_force and one friction for people and "
            "walls; here contact with walls is averaged over wall points instead"
        )
    found.notes.append(
        f"mass: {force.mass:g} kg times the {scenes.people:.3g} people of a mean sequence, because "
        "forces are averaged over people here and summed there; accelerations between people are "
        "equal in a scene of so many"
    )
    found.notes.append(
        "desired_speed: the median of the measured speeds; the model itself keeps everybody's "
        "present speed, which JuPedSim cannot"
    )
    if force.walls and not walls:
        found.notes.append("obstacle_scale: 0, the data have no walls")
    if force.sign < 0 and walls:
        found.missing.append(
            "opposing_wall_friction: JuPedSim's friction at walls has the opposite sign"
        )
    found.missing.append("reach: JuPedSim lets nobody feel people farther away than 2.5 m")
    found.missing += effects_without(system, 2 if relaxation else 1, set())
    found.text = json.dumps(
        {
            "program": "JuPedSim >= 1.4, SocialForceModel",
            "model": {"body_force": k, "friction": kappa},
            "agent": {
                "mass": mass,
                "desired_speed": scenes.speed,
                "reaction_time": relaxation.tau if relaxation else 0.5,
                "agent_scale": strength,
                "obstacle_scale": obstacle,
                "force_distance": force.B,
                "radius": force.r,
            },
            "notes": found.notes,
            "no_counterpart": found.missing,
        },
        indent=2,
        ensure_ascii=False,
    )
    return found
