"""Names of the builder of lanes."""

from nnode.model.terms import REMEMBERED, UNITS, LaneDynamics, Rule

__all__ = ["REMEMBERED", "UNITS", "LaneDynamics", "Rule"]
