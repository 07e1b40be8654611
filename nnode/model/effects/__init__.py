"""Effects that a model may lack: terms with a name, a formula, units and a source."""

from nnode.model.effects import (
    crowd_force,
    crowd_individual,
    crowd_motion,
    crowd_pairs,
    crowd_places,
    following,
    traffic,
)
from nnode.model.effects.base import CATALOGUE, Effect, IndividualEffect, Probe, Setting, Strength

__all__ = [
    "CATALOGUE",
    "Effect",
    "IndividualEffect",
    "Probe",
    "Setting",
    "Strength",
    "crowd_force",
    "crowd_individual",
    "crowd_motion",
    "crowd_pairs",
    "crowd_places",
    "following",
    "traffic",
]
