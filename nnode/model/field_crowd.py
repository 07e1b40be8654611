"""Laws of people that the field uses, as formulas: what ``model.law`` says of each.

The desired speed of the sources is everybody's preferred speed, ``pace``; where he wants to go says
``model.desired``. Masses are left out. Walls push from their nearest point, with fixed strengths;
:func:`without_walls` is a law as it is without them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Towards the destination at the preferred speed within tau.
_DRIVE = {"drive_to_x": "(pace*way_x - vx)/tau", "drive_to_y": "(pace*way_y - vy)/tau"}
_TAU = {"low": "0.05 s", "high": "5 s"}
#: In sums over walls: from the wall's nearest point to a person, its distance and direction.
_WALL = {
    "share": "clip((dx*along_x + dy*along_y)/(along_x**2 + along_y**2 + small_m**2), 0, 1)",
    "off_x": "dx - share*along_x",
    "off_y": "dy - share*along_y",
    "off": "sqrt(off_x**2 + off_y**2 + small_m**2)",
    "from_x": "off_x/off",
    "from_y": "off_y/off",
}

#: Name of the law to its description; see :class:`nnode.model.formula_law.FormulaForce`.
PEDESTRIAN_LAWS: dict[str, dict[str, Any]] = {
    # first order: the distance to the nearest one whom he would walk into sets the speed
    "cfsm": {
        "parameters": {
            "T": {"value": "1 s", "low": "0.05 s", "high": "5 s"},
            "l": {"value": "0.3 m", "low": "0.05 m", "high": "1 m"},
            "a": {"value": "5", "low": "0", "high": "50"},
            "D": {"value": "0.1 m", "low": "0.02 m", "high": "2 m"},
        },
        # JuPedSim's, of a body's half width l/2; the source has no walls
        "constants": {"a_w": "5", "D_w": "0.02 m"},
        "others": {"turn_x": "exp((l - d)/D)*n_x", "turn_y": "exp((l - d)/D)*n_y"},
        "walls": {"bend_x": "bend*from_x", "bend_y": "bend*from_y"},
        "where": {
            **_WALL,
            "bend": "a_w*exp((l/2 - off)/D_w)",
            "to_x": "way_x + a*turn_x + bend_x",
            "to_y": "way_y + a*turn_y + bend_y",
            "size": "sqrt(to_x**2 + to_y**2 + 1e-12)",
            "ahead": "-(dx*to_x + dy*to_y)/size",
            "aside": "abs(dx*to_y - dy*to_x)/size",
            "V": "min(pace, max((spacing - l)/T, 0))",
        },
        "smallest": {"spacing": "choose(ahead, choose(l - aside, d, nobody), nobody)"},
        "rate": {"x": "V*to_x/size", "y": "V*to_y/size"},
        "source": "Tordeux, Chraibi & Seyfried 2016: speed V(s_i) and direction e_i",
    },
    # simplified: bodies' distance is at least d_min, a force at most f_max, and it fades before
    # r_c, where the source interpolates by polynomials; the other's ellipse has one's own
    # preferred speed
    "gcfm": {
        "parameters": {
            "eta": {"value": "0.2", "low": "0", "high": "5"},
            "tau": {"value": "0.5 s", **_TAU},
        },
        "constants": {
            "a_min": "0.18 m", "tau_a": "0.53 s", "b_min": "0.2 m", "b_max": "0.25 m",
            "d_min": "0.1 m", "r_c": "2 m", "fade": "0.5 m", "v_min": "0.1 m/s",
            "f_max": "9 m/s²", "eta_w": "0.2", "f_w": "3 m/s²",
        },
        "where": {
            **_DRIVE, **_WALL,
            "closing": "max(-(dvx*n_x + dvy*n_y), 0)",
            "sees": "max(-(e_x*n_x + e_y*n_y), 0)",
            "most": "max(pace, v_min)",
            "own_a": "a_min + tau_a*speed",
            "own_b": "max(b_max - (b_max - b_min)*speed/most, b_min)",
            "own_c": "e_x*n_x + e_y*n_y",
            "own_r": "own_a*own_b/sqrt((own_b*own_c)**2 + own_a**2*max(1 - own_c**2, 0))",
            "its_v": "(vx - dvx)*other_x + (vy - dvy)*other_y",
            "its_a": "a_min + tau_a*its_v",
            "its_b": "max(b_max - (b_max - b_min)*its_v/most, b_min)",
            "its_c": "other_x*n_x + other_y*n_y",
            "its_r": "its_a*its_b/sqrt((its_b*its_c)**2 + its_a**2*max(1 - its_c**2, 0))",
            "between": "max(d - own_r - its_r, d_min)",
            "near": "clip((r_c - d)/fade, 0, 1)",
            "push": "near*min(sees*(eta*pace + closing)**2/between, f_max)",
            "to_wall": "max(-(vx*from_x + vy*from_y), 0)",
            "cos_w": "e_x*from_x + e_y*from_y",
            "r_w": "own_a*own_b/sqrt((own_b*cos_w)**2 + own_a**2*max(1 - cos_w**2, 0))",
            "room": "max(off - r_w, d_min)",
            "strength_w": "max(-cos_w, 0)*(eta_w*pace + to_wall)**2/room",
            "push_w": "clip((r_c - off)/fade, 0, 1)*min(strength_w, f_w)",
            # walls push along their normal: not who stands beyond their ends
            "wall": "choose(share*(1 - share), push_w, 0)",
        },
        "others": {"push_x": "push*n_x", "push_y": "push*n_y"},
        "walls": {"wall_x": "wall*from_x", "wall_y": "wall*from_y"},
        "rate": {"vx": "drive_to_x + push_x + wall_x", "vy": "drive_to_y + push_y + wall_y"},
        "source": "Chraibi, Seyfried & Schadschneider 2010: driving and repulsive force, ellipse",
    },
    # E(time) = k/time² exp(-time/t0), F = -dE/dx; times below t_min count as t_min, who overlaps
    # has the radius by which they do, the sum is at most cap, and the force of who would just
    # touch, which is infinite in the source, fades where (bodies' width times speed)² is graze
    "ttc": {
        "parameters": {
            "k": {"value": "1.5 m²", "low": "0 m²", "high": "50 m²"},
            "t0": {"value": "3 s", "low": "0.2 s", "high": "20 s"},
            "r": {"value": "0.25 m", "low": "0.05 m", "high": "0.4 m"},
            "tau": {"value": "0.54 s", **_TAU},
        },
        "constants": {"t_min": "0.2 s", "cap": "20 m/s²", "graze": "0.01 m⁴/s²"},
        "where": {
            **_DRIVE,
            "bodies": "choose(2*r - d, 2*r - d, 2*r)",
            "fast": "dvx**2 + dvy**2 + small_v**2",
            "closing": "-(dx*dvx + dy*dvy)",
            "room": "max(d**2 - bodies**2, 0)",
            "inside": "closing**2 - fast*room",
            "root": "sqrt(max(inside, 1e-6*graze))",
            "time": "max(room/(max(closing, 0) + root), t_min)",
            "strength": "k*exp(-time/t0)/time**2*(2/time + 1/t0)/fast",
            "fade": "max(inside, 0)/(max(inside, 0) + graze)",
            "meets": "choose(closing, fade*strength, 0)",
            "size": "sqrt(f_x**2 + f_y**2 + (1e-6*cap)**2)",
            "less": "cap/max(size, cap)",
        },
        "others": {
            "f_x": "meets*((closing*dvx + fast*dx)/root - dvx)",
            "f_y": "meets*((closing*dvy + fast*dy)/root - dvy)",
        },
        "rate": {"vx": "drive_to_x + less*f_x", "vy": "drive_to_y + less*f_y"},
        "source": "Karamouzas, Skinner & Guy 2014, F = -grad E, E(tau) = k/tau² exp(-tau/tau0)",
    },
    # A is the acceleration by someone at b = 2 r straight ahead: the source's 0.04 m/s², at b = 0,
    # times exp(-2 r/B); stride=0 s is the circular one
    "esf": {
        "parameters": {
            "A": {"value": "0.0342 m/s²", "low": "0 m/s²", "high": "50 m/s²"},
            "B": {"value": "3.22 m", "low": "0.02 m", "high": "5 m"},
            "stride": {"value": "0.5 s", "low": "0 s", "high": "3 s"},
            "lam": {"value": "0.06", "low": "0", "high": "1"},
            "tau": {"value": "0.5 s", **_TAU},
        },
        "constants": {"b_min": "0.05 m", "A_w": "5 m/s²", "B_w": "0.1 m"},
        "where": {
            **_DRIVE, **_WALL,
            "wall": "A_w*exp((r - off)/B_w)",
            "then_x": "dx + stride*dvx",
            "then_y": "dy + stride*dvy",
            "then": "sqrt(then_x**2 + then_y**2 + small_m**2)",
            "step": "stride**2*(dvx**2 + dvy**2)",
            "b": "sqrt(max(((d + then)**2 - step)/4, b_min**2))",
            "front": "lam + (1 - lam)*(1 - e_x*n_x - e_y*n_y)/2",
            "push": "front*A*exp((2*r - b)/B)*(d + then)/(4*b)",
        },
        "others": {
            "push_x": "push*(n_x + then_x/then)",
            "push_y": "push*(n_y + then_y/then)",
        },
        "walls": {"wall_x": "wall*from_x", "wall_y": "wall*from_y"},
        "rate": {"vx": "drive_to_x + push_x + wall_x", "vy": "drive_to_y + push_y + wall_y"},
        "source": "Johansson, Helbing & Shukla 2007, elliptical, with relative velocities",
    },
}  # fmt: skip


def without_walls(law: Mapping[str, Any]) -> dict[str, Any]:
    """A law whose walls nobody feels."""
    zero = dict.fromkeys(law.get("walls", {}), "0" if "x" in law["rate"] else "0 m/s²")
    kept = {key: value for key, value in law.items() if key != "walls"}
    return {**kept, "constants": {**law.get("constants", {}), **zero}}
