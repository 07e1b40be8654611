"""Effects that a model may lack: terms with a name, a formula, units and a source."""

from nnode.models.effects import following as _following
from nnode.models.effects import traffic as _traffic
from nnode.models.effects.base import CATALOGUE, Effect, IndividualEffect, Probe, Setting, Strength

__all__ = [
    "CATALOGUE",
    "Effect",
    "IndividualEffect",
    "Probe",
    "Setting",
    "Strength",
    "following",
    "traffic",
]

#: Modules that fill the catalogue.
FILLED_BY = (_following, _traffic)
