"""Laws of other programs as formulas, where they are not those of the field to the last detail."""

from __future__ import annotations

from typing import Any

from nnode.models.field import FIELD

_IDM, _KRAUSS = FIELD["idm"], FIELD["krauss"]
#: Gaps that SUMO counts as none, m, its slack in distances, m, and what stands for no speed, m/s.
_SMALL = {"near": "0.01 m", "slack": "0.001 m", "still": "1e-9 m/s", "one": "1 s"}

#: SUMO's IDM never asks for a negative speed: in a ballistic step that ends at rest a vehicle
#: drives at the mean of its old speed and 0, however hard it wanted to brake.
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

#: JuPedSim's social force, by mass: with a desired speed, and nobody farther away than 2.5 m. Its
#: steps place people with their new velocity, Euler's here with the old one. A place that is meant
#: one step earlier turns one into the other, if forces act from where people are a step later.
SOCIAL_FORCE: dict[str, Any] = {
    "parameters": {
        "A": {"value": "2 m/s²", "low": "0 m/s²"},
        "B": {"value": "0.3 m", "low": "0.01 m", "high": "2 m"},
        "k": {"value": "100 1/s²", "low": "0 1/s²"},
        "kappa": {"value": "30 1/(m*s)", "low": "0 1/(m*s)"},
        "v0": {"value": "1.3 m/s", "low": "0.1 m/s", "high": "3 m/s"},
        "tau": {"value": "0.5 s", "low": "0.05 s", "high": "5 s"},
        "radius": "0.3 m",  # known, as are JuPedSim's reach and step
        "reach": "2.5 m",
        "step": "0 s",
    },
    "where": {
        "to_x": "goal_x - x - step*vx",
        "to_y": "goal_y - y - step*vy",
        "way": "sqrt(to_x**2 + to_y**2)",
        "then_x": "dx + step*dvx",
        "then_y": "dy + step*dvy",
        "far": "sqrt(then_x**2 + then_y**2)",
        "contact": "max(2*radius - far, 0)",
        "push": "choose(reach - far, A*exp((2*radius - far)/B) + k*contact, 0)/far",
        "slide": "kappa*contact*(dvx*then_y - dvy*then_x)/far**2",
    },
    "others": {
        "push_x": "push*then_x - slide*then_y",
        "push_y": "push*then_y + slide*then_x",
    },
    "rate": {
        "vx": "(v0*to_x/way - vx)/tau + push_x",
        "vy": "(v0*to_y/way - vy)/tau + push_y",
    },
    "source": "JuPedSim's SocialForceModel: Helbing, Farkas & Vicsek 2000",
}


def stepping(law: dict[str, Any], step: float) -> dict[str, Any]:
    """A law of people for steps of JuPedSim's, whose length is ``step`` s."""
    return {**law, "parameters": {**law["parameters"], "step": f"{step} s"}}
