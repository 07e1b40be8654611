"""What is compared: laws of people, without walls, and predictions that need no calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nnode.model.build import build_model
from nnode.model.laws import PEDESTRIAN_LAWS
from nnode.model.system import System


def without_walls(description: Mapping[str, Any]) -> dict[str, Any]:
    """A law of people whose walls nobody feels."""
    unit = "0" if "x" in description["rate"] else "0 m/s²"
    zero = dict.fromkeys(description.get("walls", {}), unit)
    kept = {key: value for key, value in description.items() if key != "walls"}
    return {**kept, "constants": {**description.get("constants", {}), **zero}}


_FORCE = without_walls(PEDESTRIAN_LAWS["esf"])
_CIRCLE = {"stride": "0 s", "lam": "1"}

#: Name to the law; the first is without any interaction.
LAWS: dict[str, dict[str, Any]] = {
    "alone": {
        "parameters": {"tau": PEDESTRIAN_LAWS["esf"]["parameters"]["tau"]},
        "rate": {"vx": "(pace*way_x - vx)/tau", "vy": "(pace*way_y - vy)/tau"},
    },
    "exponential": {
        **_FORCE,
        "parameters": {k: v for k, v in _FORCE["parameters"].items() if k not in _CIRCLE},
        "constants": {**_FORCE["constants"], **_CIRCLE},
    },
    **{name: without_walls(PEDESTRIAN_LAWS[name]) for name in ("esf", "ttc", "gcfm", "cfsm")},
}
#: Values of parameters from all combinations of which a calibration chooses its starts: forces that
#: jump where people just touch leave many valleys.
GRID: dict[str, dict[str, tuple[float, ...]]] = {
    "alone": {},
    "exponential": {"A": (0.05, 0.2, 1.0), "B": (0.1, 0.2, 0.5)},
    "esf": {"A": (0.05, 0.2, 1.0), "B": (0.15, 0.3), "stride": (0.3, 1.0), "lam": (0.06, 1.0)},
    "ttc": {"k": (0.005, 0.02, 0.1, 0.5), "r": (0.05, 0.1, 0.2), "t0": (1.0, 3.0)},
    "gcfm": {"eta": (0.05, 0.3), "tau": (0.1, 0.5)},
    "cfsm": {"T": (0.3, 0.6, 1.0), "l": (0.1, 0.25), "a": (1.0, 5.0), "D": (0.05, 0.15, 0.3)},
}
#: How the page calls them.
LABELS = {
    "constant_velocity": "constant velocity",
    "preferred": "preferred velocity",
    "alone": "no interaction",
    "exponential": "exponential force",
    "esf": "elliptical force",
    "ttc": "time to collision",
    "gcfm": "centrifugal force",
    "cfsm": "collision-free speed",
}
#: Need no calibration.
SIMPLE = ("constant_velocity", "preferred")
#: Where people want to go.
DESIRED = ("direction", "last")


def new_system(law: str, desired: str) -> System:
    """A law of LAWS at its start."""
    options = {"term": "formula", "name": law, "law": LAWS[law], "desired": desired}
    return build_model({**options, "leader": "measured"})
