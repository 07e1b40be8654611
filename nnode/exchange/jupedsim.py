"""Calibrated pedestrian laws as parameters of JuPedSim's models.

The collision-free speed model (``cfsm``) is equal in both programs, the generalised centrifugal
force model (``gcfm``) nearly equal. The social force between two people is equal,
A exp((2r - d)/B) n with contact and sliding friction, but there are two differences. nnode averages
a person's forces over the N people and the P wall points of the scene, and JuPedSim sums them.
nnode represents walls by points, and JuPedSim by the nearest point of each edge. The mass accounts
for the first difference, and the strength of obstacles for the second.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from scipy.special import kve

from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError
from nnode.exchange.counterpart import (
    Counterpart,
    Intervals,
    effects_without,
    field_law,
    interval_lines,
)
from nnode.model import Law, System
from nnode.model.scene import Scene, wall_points


@dataclass
class Scenes:
    """Properties of the data that parameters depend on, as means over sequences.

    Attributes:
        people: number of people.
        points: number of wall points; 0 without walls.
        spacing: distance of neighbouring wall points, m.
        speed: median of the measured speeds, m/s.
        pace: median of people's preferred speeds, m/s.
    """

    people: float
    points: float
    spacing: float
    speed: float
    pace: float = math.nan


def scenes_of(sequences: Iterable[Sequence], spacing: float) -> Scenes:
    """The properties of sequences, with walls as points that are at most ``spacing`` (m) apart."""
    people, points, speeds, gaps, paces = [], [], [], [], []
    for s in sequences:
        paces.append(Scene.of(collate([s]), spacing).pace[0].numpy())
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
        pace=float(np.median(np.concatenate(paces))),
    )


def points_per_edge(r: float, B: float, spacing: float) -> float:
    """The force of a long row of points relative to that of the nearest point of an edge.

    At distance r (m), where a person touches the wall, the components along the normal add up. The
    sum of exp((r - d_p)/B) r/d_p, averaged over positions along the row, is
    2 r exp(r/B) K_0(r/B) / spacing with the Bessel function K_0.
    """
    return float(2 * r * kve(0, r / B) / spacing)


#: Laws that JuPedSim has.
SAME = ("cfsm", "gcfm")
_PACE = "desired_speed: the median of the preferred speeds, which differ between people"


def has_parameters(system: System) -> bool:
    """Whether JuPedSim has a counterpart of a model."""
    return system.find_law("social_force") is not None or field_law(system, SAME) is not None


def jupedsim_parameters(
    system: System, scenes: Scenes, intervals: Intervals | None = None
) -> Counterpart:
    """JSON with the arguments of one of JuPedSim's models (``model``) and of its agents' parameters
    (``agent``), in JuPedSim's units, and the names of both classes (``classes``).

    Args:
        intervals: intervals of the parameters, for the file's notes.

    Raises:
        ConfigError: JuPedSim has no counterpart of the model.
    """
    name = field_law(system, SAME)
    if name is not None:
        counterpart, content = _same_law(system, name, scenes)
    else:
        counterpart, content = _social_force(system, scenes)
    counterpart.notes[:0] = interval_lines(system, intervals or {})
    content |= {"notes": counterpart.notes, "no_counterpart": counterpart.missing}
    counterpart.text = json.dumps(content, indent=2, ensure_ascii=False)
    return counterpart


def _content(model: str, arguments: dict[str, Any], agent: dict[str, Any]) -> dict[str, Any]:
    classes = {"model": model, "agent": f"{model}AgentParameters"}
    return {
        "program": f"JuPedSim >= 1.4, {model}",
        "classes": classes,
        "model": arguments,
        "agent": agent,
    }


def _same_law(system: System, name: str, scenes: Scenes) -> tuple[Counterpart, dict[str, Any]]:
    """The counterpart of ``cfsm`` or ``gcfm``."""
    counterpart, law = Counterpart(), cast(Law, system.terms[0])
    values = {p: float(getattr(law, p).detach()) for p in law.scalars}
    fixed = {name: value for name, (value, _) in law.formulas.constants.items()}
    agent: dict[str, Any] = {"desired_speed": scenes.pace}
    if name == "cfsm":
        agent |= {"time_gap": values["T"], "radius": values["l"] / 2}
        model = {
            "strength_neighbor_repulsion": values["a"],
            "range_neighbor_repulsion": values["D"],
            "strength_geometry_repulsion": fixed["a_w"],
            "range_geometry_repulsion": fixed["D_w"],
        }
        content = _content("CollisionFreeSpeedModel", model, agent)
        counterpart.notes.append("radius: l/2")
    else:
        agent |= {
            "mass": 1.0,
            "tau": values["tau"],
            "a_v": fixed["tau_a"],
            **{p: fixed[p] for p in ("a_min", "b_min", "b_max")},
        }
        model = {
            "strength_neighbor_repulsion": values["eta"],
            "max_neighbor_interaction_distance": fixed["r_c"],
            "max_neighbor_repulsion_force": fixed["f_max"],
            "strength_geometry_repulsion": fixed["eta_w"],
            "max_geometry_interaction_distance": fixed["r_c"],
            "max_geometry_repulsion_force": fixed["f_w"],
        }
        content = _content("GeneralizedCentrifugalForceModel", model, agent)
        counterpart.missing.append(
            "the distance of bodies: JuPedSim uses points of the ellipses that are not on the line "
            "between the centres, and interpolates the force at small and large distances, also "
            "for walls"
        )
    counterpart.notes.append(_PACE)
    counterpart.missing += effects_without(system)
    return counterpart, content


def _social_force(system: System, scenes: Scenes) -> tuple[Counterpart, dict[str, Any]]:
    force: Any = system.find_law("social_force")
    relaxation: Any = system.find_law("relaxation")
    if force is None:
        raise ConfigError(
            "to=jupedsim: the run's model has no social force and is neither "
            f"{' nor '.join(SAME)}, and JuPedSim has no counterpart of it; leave jupedsim out "
            "of to="
        )
    counterpart = Counterpart()
    walls = force.walls and scenes.points > 0
    mass = force.mass * scenes.people
    strength, k, kappa = (float(value.detach()) for value in (force.A, force.k, force.kappa))
    obstacle = 0.0
    if walls:
        share = scenes.people / scenes.points
        obstacle = strength * share * points_per_edge(force.r, force.B, scenes.spacing)
        counterpart.notes.append(
            "obstacle_scale: equal to the force of wall points on a person who touches a long "
            "straight wall; at larger distances and at corners the forces differ"
        )
        counterpart.missing.append(
            "k and kappa at walls: JuPedSim has one body_force and one friction for people and "
            "walls, and nnode averages contact with walls over wall points"
        )
    counterpart.notes.append(
        f"mass: {force.mass:g} kg times the {scenes.people:.3g} people of a mean sequence, because "
        "nnode averages forces over people and JuPedSim sums them; accelerations between people "
        "are equal in a scene with this number of people"
    )
    preferred = relaxation is not None and relaxation.preferred
    counterpart.notes.append(
        _PACE
        if preferred
        else "desired_speed: the median of the measured speeds; in the model, people keep their "
        "present speed, which is not possible in JuPedSim"
    )
    if force.walls and not walls:
        counterpart.notes.append("obstacle_scale: 0, the data have no walls")
    if force.sign < 0 and walls:
        counterpart.missing.append(
            "opposing_wall_friction: JuPedSim's friction at walls has the opposite sign"
        )
    counterpart.missing.append("range: in JuPedSim, forces between people end at 2.5 m")
    counterpart.missing += effects_without(system, 2 if relaxation else 1)
    content = _content(
        "SocialForceModel",
        {"body_force": k, "friction": kappa},
        {
            "mass": mass,
            "desired_speed": scenes.pace if preferred else scenes.speed,
            "reaction_time": relaxation.tau if relaxation else 0.5,
            "agent_scale": strength,
            "obstacle_scale": obstacle,
            "force_distance": force.B,
            "radius": force.r,
        },
    )
    return counterpart, content
