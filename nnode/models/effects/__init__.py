"""Effects that a model may lack: terms with a name, a formula, units and a source."""

from nnode.models.effects import following, traffic
from nnode.models.effects.base import CATALOGUE, Effect, Probe, Setting, Strength

__all__ = ["CATALOGUE", "Effect", "Probe", "Setting", "Strength", "following", "traffic"]
