"""Effects that a model may lack: terms with a name, a rule, units and a source."""

from nnode.model.effects import crowd, lane
from nnode.model.effects.base import CATALOGUE, Effect, IndividualEffect, Probe, Setting, Strength

__all__ = [
    "CATALOGUE",
    "Effect",
    "IndividualEffect",
    "Probe",
    "Setting",
    "Strength",
    "crowd",
    "lane",
]
