"""A law that the package does not know, as a formula."""

from __future__ import annotations

from nnode.model.laws import Law, law_from


def saturation(v0: float = 20.0, reach: float = 12.0) -> Law:
    """W = v0 (1 - exp(-gap / reach))."""
    return law_from(
        "saturation",
        {
            "parameters": {"v0": f"{v0} m/s", "reach": f"{reach} m"},
            "rate": {"x": "v0*(1 - exp(-gap/reach))"},
        },
    )
