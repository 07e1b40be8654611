"""Laws that the field uses, as formulas: what ``model.law`` says of each.

Gaps are bumper to bumper where lengths are known; without them the standstill gap contains the
vehicle's length. A law sees a gap of at least 0.1 m, so that it brakes after a collision, too.

Laws that are smooth are stepped by Runge and Kutta's method of fourth order (``step: rk4``). Gipps'
law, which says the speed one reaction time later, keeps ballistic steps, and the laws that say what
holds one step later keep their own.
"""

from __future__ import annotations

from typing import Any

_NET = {"net": "max(gap - length_1, least)"}
_LEAST = {"least": "0.1 m"}


def _quantity(value: float, low: float, high: float, unit: str) -> dict[str, str]:
    return {"value": f"{value} {unit}", "low": f"{low} {unit}", "high": f"{high} {unit}"}


def _speed(value: float = 30) -> dict[str, str]:
    return _quantity(value, 1, 60, "m/s")


_TIME_GAP, _STANDSTILL = _quantity(1.2, 0.05, 5, "s"), _quantity(2, 0, 20, "m")
_ACCELERATION, _BRAKING = _quantity(1.3, 0.05, 8, "m/s²"), _quantity(1.7, 0.05, 10, "m/s²")
_RATE = _quantity(0.5, 0.01, 5, "1/s")
_OPTIMAL = {
    "inflection": "tanh(s_c/w)",
    "optimal": "v0*(tanh((net - s_c)/w) + inflection)/(1 + inflection)",
}
_NETWORK = {
    "parameters": {},
    "rate": {"v": "NN(gap/20, v/10, dv/2)"},
    "step": "rk4",
    "source": "acceleration as a network of gap, speed and speed difference, in 20 m, 10 and 2 m/s",
}

#: Name of the law to its description; see :class:`nnode.model.formula_law.FormulaLaw`.
CAR_FOLLOWING_LAWS: dict[str, dict[str, Any]] = {
    "idm": {
        "parameters": {
            "v0": _speed(),
            "T": _TIME_GAP,
            "s0": _STANDSTILL,
            "a": _ACCELERATION,
            "b": _BRAKING,
        },
        "constants": _LEAST,
        "where": {**_NET, "wish": "s0 + max(v*T + v*dv/(2*sqrt(a*b)), 0)"},
        "rate": {"v": "a*(1 - (v/v0)**4 - (wish/net)**2)"},
        "step": "rk4",
        "source": "Intelligent Driver Model: Treiber, Hennecke & Helbing 2000",
    },
    "ovm": {
        "parameters": {
            "kappa": _RATE,
            "v0": _speed(),
            "s_c": _quantity(15, 0, 60, "m"),
            "w": _quantity(12, 1, 80, "m"),
        },
        "constants": _LEAST,
        "where": {**_NET, **_OPTIMAL},
        "rate": {"v": "kappa*(optimal - v)"},
        "step": "rk4",
        "source": "optimal velocity: Bando, Hasebe, Nakayama, Shibata & Sugiyama 1995",
    },
    "fvdm": {
        "parameters": {
            "kappa": _RATE,
            "lam": _quantity(0.5, 0, 5, "1/s"),
            "v0": _speed(),
            "s_c": _quantity(15, 0, 60, "m"),
            "w": _quantity(12, 1, 80, "m"),
        },
        "constants": _LEAST,
        "where": {**_NET, **_OPTIMAL},
        "rate": {"v": "kappa*(optimal - v) - lam*dv"},
        "step": "rk4",
        "source": "full velocity difference: Jiang, Wu & Zhu 2001",
    },
    "gipps": {
        "parameters": {
            "v0": _speed(),
            "T": _quantity(1, 0.1, 4, "s"),
            "s0": _STANDSTILL,
            "a": _ACCELERATION,
            "b": _quantity(2, 0.05, 10, "m/s²"),
            "b_1": _quantity(2, 0.05, 10, "m/s²"),
        },
        # the speed one reaction time T later, as the acceleration that leads to it
        "constants": {**_LEAST, "unit": "1 m²/s²"},
        "where": {
            **_NET,
            "freely": "v + 2.5*a*T*(1 - v/v0)*sqrt(0.025 + v/v0)",
            "left": "(b*T)**2 + b*(2*(net - s0) - v*T + v_1**2/b_1)",
            "safely": "choose(left, sqrt(max(left, unit*1e-12)) - b*T, 0)",
        },
        "rate": {"v": "(max(min(freely, safely), 0) - v)/T"},
        "source": "Gipps 1981",
    },
    "krauss": {
        "parameters": {
            "v0": _speed(),
            "T": _quantity(1, 0.1, 4, "s"),
            "s0": _STANDSTILL,
            "a": _quantity(2.6, 0.05, 8, "m/s²"),
            "b": _quantity(4.5, 0.05, 10, "m/s²"),
        },
        # a map: the speed one step later
        "constants": {"unit": "1 m²/s²"},
        "where": {
            "left": "(b*T)**2 + v_1**2 + 2*b*(gap - length_1 - s0)",
            "safely": "choose(gap - length_1 - s0, sqrt(max(left, unit*1e-12)) - b*T, 0)",
            "next": "min(min(v + a*dt, v0), safely)",
        },
        "rate": {"v": "(max(next, 0) - v)/dt"},
        "step": "semi_implicit",
        "source": "Krauss, Wagner & Gawron 1997, without its random part; SUMO's KraussOrig1",
    },
    "helly": {
        "parameters": {
            "c_s": _quantity(0.1, 0, 2, "1/s²"),
            "c_v": _quantity(0.5, 0, 5, "1/s"),
            "T": _TIME_GAP,
            "s0": _STANDSTILL,
        },
        "where": {"net": "gap - length_1"},
        "rate": {"v": "c_s*(net - s0 - T*v) - c_v*dv"},
        "step": "rk4",
        "source": "Helly 1959; the usual form of adaptive cruise control",
    },
    "newell": {
        "parameters": {
            "v0": _speed(),
            "T": _quantity(1, 0, 3, "s"),
            "d": _quantity(6, 0, 40, "m"),
        },
        # the leader's path, T later and d further back, and no step faster than v0; what is
        # remembered is how far the leader is from where its first speed would have brought it
        "states": {"begun": ["m/s", "0", "v_1"]},
        "delayed": {"off": ["x_1 - t*begun", "m", "max(T - dt, 0)"]},
        "remembered": 30,
        "where": {
            "ahead": "off + (t - max(T - dt, 0))*begun + max(dt - T, 0)*v_1",
            "next": "(ahead - length_1 - d - x)/dt",
        },
        "rate": {"v": "(clip(next, 0, v0) - v)/dt"},
        "step": "semi_implicit",
        "source": "Newell 2002",
    },
    "a2": _NETWORK,
    "a4": _NETWORK,
    "a10": _NETWORK,
}

#: Neurons of the hidden layer of those that are networks.
NEURONS = {"a2": 2, "a4": 4, "a10": 10}
