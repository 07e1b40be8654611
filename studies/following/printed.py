"""Published figures of car following, with the parameters and conventions of their packages."""

from __future__ import annotations

from typing import Any

from studies.printed import told

_TOLD = told(__package__)
OBJECTIVES = _TOLD["objectives"]
ERRORS = _TOLD["errors"]
PARAMETERS = _TOLD["parameters"]
BOUNDS = _TOLD["bounds"]
EVOLUTION = _TOLD["evolution"]
CLIPPED = _TOLD["clipped"]
PLATOON = _TOLD["platoon"]
FIRST = _TOLD["first"]
PLATOON_ERRORS = _TOLD["platoon_errors"]
PLATOON_PARAMETERS = _TOLD["platoon_parameters"]
UNITS = _TOLD["units"]


def clipped(
    law: dict[str, Any], limits: tuple[float, float], values: dict[str, float]
) -> dict[str, Any]:
    """A law of the shelf with published parameters, its acceleration clipped, in the published
    steps, ballistic ones.

    Args:
        law: its description, see :data:`nnode.model.laws.CAR_FOLLOWING_LAWS`.
        limits: m/s².
        values: by parameter, SI units.
    """
    low, high = limits
    ends = {"least_rate": f"{low} m/s²", "most_rate": f"{high} m/s²"}
    return {
        **law,
        "parameters": {name: f"{value!r} {UNITS[name]}" for name, value in values.items()},
        "constants": {**law.get("constants", {}), **ends},
        "rate": {"v": f"clip({law['rate']['v']}, least_rate, most_rate)"},
        "step": "ballistic",
    }
