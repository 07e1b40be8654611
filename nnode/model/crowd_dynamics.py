"""Names of the builder of crowds."""

from nnode.model.terms import (
    NOBODY,
    OTHERS,
    POINTS,
    SEEN,
    SMALLEST,
    SMOOTHING,
    WALLS,
    CrowdDynamics,
)
from nnode.model.terms import Rule as CrowdRule

__all__ = [
    "NOBODY", "OTHERS", "POINTS", "SEEN", "SMALLEST", "SMOOTHING", "WALLS", "CrowdDynamics",
    "CrowdRule",
]  # fmt: skip
