"""Laws of other programs as formulas, where they are not those of the field to the last detail."""

from __future__ import annotations

from typing import Any

from nnode.models.field import FIELD

_IDM, _KRAUSS = FIELD["idm"], FIELD["krauss"]
#: Gaps that SUMO counts as none, m, its slack in distances, m, and what stands for no speed, m/s.
_SMALL = {"near": "0.01 m", "slack": "0.001 m", "still": "1e-9 m/s", "one": "1 s"}

#: SUMO's IDM never asks for a negative speed: in a ballistic step that ends at rest a vehicle drives
#: at the mean of its old speed and 0, however hard it wanted to brake.
IDM: dict[str, Any] = {**_IDM, "rate": {"v": f"max({_IDM['rate']['v']}, -v/dt)"}}

#: SUMO's KraussOrig1: behind a vehicle at rest the last b dt (s) metres are driven at b dt at most,
#: and the last centimetre is left; anywhere else the safe speed is Krauss'.
KRAUSS_ORIG: dict[str, Any] = {
    **_KRAUSS,
    "constants": {**_KRAUSS["constants"], **_SMALL},
    "where": {
        "net": "gap - length_1 - s0",
        "left": "(b*T)**2 + v_1**2 + 2*b*net",
        "usual": "choose(net, sqrt(max(left, unit*1e-12)) - b*T, 0)",
        "crawl": "choose(b*dt*one - net, min(b*dt, net/dt), usual)",
        "safely": "choose(v_1 - still, usual, choose(near - net, 0, crawl))",
        "next": "min(min(v + a*dt, v0), safely)",
    },
}

#: SUMO's Krauss in ballistic steps, whose emergencyDecel is decel: within T it reaches a speed from
#: which it stops behind where the leader can, or else stops at once within the room that there is.
KRAUSS_BALLISTIC: dict[str, Any] = {
    **_KRAUSS,
    "constants": {**_KRAUSS["constants"], **_SMALL},
    "where": {
        "net": "gap - length_1 - s0",
        "room": "max(net + v_1**2/(2*b) - slack, 0)",
        "half": "b*T/2",
        "left": "half**2 + b*(2*room - T*v)",
        "softly": "v + dt*(sqrt(max(left, unit*1e-12)) - half - v)/T",
        "hard": "v - dt*v**2/(2*max(room, slack*1e-6))",
        "safely": "choose(2*room - v*T, softly, hard)",
        "next": "max(min(min(v + a*dt, v0), safely), v - b*dt)",
    },
    "rate": {"v": "(next - v)/dt"},
    "step": "ballistic",
    "source": "SUMO's Krauss with --step-method.ballistic",
}
