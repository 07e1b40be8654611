"""Published figures of car following, with the parameters and conventions of their packages."""

from __future__ import annotations

from typing import Any

from nnode.model.laws import CAR_FOLLOWING_LAWS
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


def published(name: str, values: dict[str, float]) -> dict[str, Any]:
    """A law of :data:`nnode.model.laws.CAR_FOLLOWING_LAWS` with published parameters, its
    acceleration clipped, in the published steps, ballistic ones.

    Args:
        values: by parameter, SI units.
    """
    law, (low, high) = CAR_FOLLOWING_LAWS[name], CLIPPED[name]
    ends = {"least_rate": f"{low} m/s²", "most_rate": f"{high} m/s²"}
    return {
        **law,
        "parameters": {name: f"{value!r} {UNITS[name]}" for name, value in values.items()},
        "constants": {**law.get("constants", {}), **ends},
        "rate": {"v": f"clip({law['rate']['v']}, least_rate, most_rate)"},
        "step": "ballistic",
    }


def units(names: list[str]) -> list[str]:
    """The units of parameters; 1 where there is none."""
    return [UNITS.get(name, "1") for name in names]
