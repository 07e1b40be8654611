"""Laws of other programs as formulas, where they are not those of the field to the last detail."""

from __future__ import annotations

from typing import Any

from nnode.model.laws import CAR_FOLLOWING_LAWS

_IDM, _KRAUSS = CAR_FOLLOWING_LAWS["idm"], CAR_FOLLOWING_LAWS["krauss"]
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

#: JuPedSim's laws: the way to the goal, and relative positions, both ``lookahead`` seconds later.
_LOOKAHEAD = {
    "to_x": "goal_x - x - lookahead*vx",
    "to_y": "goal_y - y - lookahead*vy",
    "way": "sqrt(to_x**2 + to_y**2)",
    "then_x": "dx + lookahead*dvx",
    "then_y": "dy + lookahead*dvy",
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
        "lookahead": "0 s",
    },
    "where": {
        **_LOOKAHEAD,
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
    return {**law, "parameters": {**law["parameters"], "lookahead": f"{step} s"}}


_HERMITE = {
    # what is left and right of an interval of unit length, and the slopes there
    "left": "(2*{t}**3 - 3*{t}**2 + 1)*{y1}",
    "right": "(3*{t}**2 - 2*{t}**3)*{y2}",
    "slope_left": "({t}**3 - 2*{t}**2 + {t})*{s1}",
    "slope_right": "({t}**3 - {t}**2)*{s2}",
}


def _hermite(t: str, y1: str, y2: str, s1: str, s2: str) -> str:
    """Cubic polynomial with these values and slopes at both ends of 0 <= t <= 1."""
    return " + ".join(p.format(t=t, y1=y1, y2=y2, s1=s1, s2=s2) for p in _HERMITE.values())


#: JuPedSim's generalised centrifugal force: the distance of bodies is that of the ellipses' points
#: at each other's polar angle, which are not on the line between the centres; one over it is
#: interpolated below 0.6 m, where it ends at 9 times its value there, and from 1.9 to 2 m.
CENTRIFUGAL: dict[str, Any] = {
    "parameters": {
        "eta": {"value": "0.3", "low": "0", "high": "5"},
        "v0": {"value": "1.3 m/s", "low": "0.1 m/s", "high": "3 m/s"},
        "tau": {"value": "0.5 s", "low": "0.05 s", "high": "5 s"},
        "a_v": {"value": "0.5 s", "low": "0 s", "high": "2 s"},
        "a_min": "0.2 m",
        "b_min": "0.2 m",
        "b_max": "0.4 m",
        "near": "0.6 m",
        "closest": "0.4 m",
        "far": "1.9 m",
        "reach": "2 m",
        "most": "9",
        "lookahead": "0 s",
    },
    "where": {
        **_LOOKAHEAD,
        "away": "sqrt(then_x**2 + then_y**2)",
        "m_x": "then_x/away",
        "m_y": "then_y/away",
        "its_speed": "sqrt((vx - dvx)**2 + (vy - dvy)**2 + small_v**2)",
        "long": "a_min + a_v*speed",
        "wide": "b_max - (b_max - b_min)*speed/v0",
        "its_long": "a_min + a_v*its_speed",
        "its_wide": "b_max - (b_max - b_min)*its_speed/v0",
        "ahead": "-(e_x*m_x + e_y*m_y)*long",
        "aside": "(e_y*m_x - e_x*m_y)*wide",
        "its_ahead": "(other_x*m_x + other_y*m_y)*its_long",
        "its_aside": "(other_x*m_y - other_y*m_x)*its_wide",
        "gap_x": "then_x + ahead*e_x - aside*e_y - its_ahead*other_x + its_aside*other_y",
        "gap_y": "then_y + ahead*e_y + aside*e_x - its_ahead*other_y - its_aside*other_x",
        "between": "sqrt(gap_x**2 + gap_y**2)",
        "inner": "clip((between - closest)/(near - closest), 0, 1)",
        "outer": "clip((between - far)/(reach - far), 0, 1)",
        "short": _hermite("inner", "most/near", "1/near", "0/near", "(closest - near)/near**2"),
        "fading": _hermite("outer", "1/far", "0/far", "(far - reach)/far**2", "0/far"),
        "inverse": "choose(near - between, short, choose(between - far, fading, 1/between))",
        "sees": "max(-(e_x*m_x + e_y*m_y), 0)",
        "closing": "max(-(dvx*m_x + dvy*m_y), 0)",
        "push": "sees*(eta*v0 + closing)**2*inverse",
    },
    "others": {"push_x": "push*m_x", "push_y": "push*m_y"},
    "rate": {
        "vx": "(v0*to_x/way - vx)/tau + push_x",
        "vy": "(v0*to_y/way - vy)/tau + push_y",
    },
    "source": "JuPedSim's GeneralizedCentrifugalForceModel",
}
