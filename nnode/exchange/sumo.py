"""Calibrated laws of the gap as a vehicle type for SUMO.

SUMO has no car-following model of first order. Krauss' model without its noise is taken, whose
gap at a constant speed v is length + minGap + tau v; the type keeps from a law what such a state
shows: the gap at rest, the gap at the recorded speed, and the greatest speed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from xml.etree import ElementTree

import numpy as np
from torch.nn import Module

from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.exchange.counterpart import Counterpart, effects_without
from nnode.models import Linear, Logarithmic, System

#: SUMO's own length of a passenger car, m, where the data tell none.
DEFAULT_LENGTH = 5.0


def traffic_of(sequences: Iterable[Sequence]) -> tuple[float, float | None]:
    """Median of the measured speeds (m/s), and of the known lengths (m)."""
    speeds, lengths = [], []
    for s in sequences:
        speeds.append(s.velocity().ravel())
        if s.length is not None:
            lengths.append(s.length[np.isfinite(s.length)])
    known = np.concatenate(lengths) if lengths else np.empty(0)
    speed = float(np.median(np.concatenate(speeds)))
    return speed, float(np.median(known)) if len(known) else None


def equilibrium_gap(law: Linear | Logarithmic, speed: float, time_gap: float = 0.0) -> float:
    """Gap (m, front to front) that a law asks for at ``speed`` (m/s); infinite from v0 on.

    Args:
        time_gap: h of the effect of this name, s.
    """
    v0, standstill = float(law.v0.detach()), float(law.L.detach()) + time_gap * speed
    if isinstance(law, Logarithmic):
        return standstill * math.exp(speed / v0)
    return standstill / (1 - speed / v0) if speed < v0 else math.inf


def sumo_type(system: System, name: str, speed: float, length: float | None) -> Counterpart:
    """An additional file with one ``vType``.

    Args:
        system: a law of the gap, with or without effects.
        name: of the vehicle type.
        speed: m/s at which gaps are to agree, the median of the data.
        length: of the vehicles, m; None takes SUMO's own.

    Raises:
        ConfigError: the model has no gap at rest.
    """
    law = system.find(Linear) or system.find(Logarithmic)
    if law is None:
        raise ConfigError(
            "to=sumo: the run's model is no law with a gap at rest, and SUMO has no counterpart "
            "to it; leave it out of to="
        )
    found = Counterpart()
    effects = {str(term.name): term for term in list(system.terms)[1:]}
    L, v0 = float(law.L.detach()), float(law.v0.detach())
    own = min(DEFAULT_LENGTH if length is None else length, L)
    values = {
        "id": name,
        "carFollowModel": "Krauss",
        "sigma": "0",
        "speedDev": "0",
        "length": _digits(own),
        "minGap": _digits(L - own),
    }
    told = f"{own:.3g} m of it are the length, "
    told += "SUMO's own, cut to L" if length is None else "the data's median, cut to L"
    found.notes.append(f"length + minGap = L = {L:.4g} m, the gap at rest; {told}")

    limits = [v0] if isinstance(law, Linear) else []
    counted = set()
    if "free_flow_speed" in effects:
        limits.append(_value(effects["free_flow_speed"], "v_max"))
        counted.add("free_flow_speed")
    if limits:
        values["maxSpeed"] = _digits(min(limits))
    else:
        found.missing.append(
            f"v0 = {v0:.4g} m/s: it is no greatest speed in the logarithmic law, which knows none; "
            "maxSpeed stays SUMO's"
        )
    time_gap = 0.0
    if "time_gap" in effects:
        time_gap = _value(effects["time_gap"], "h")
        counted.add("time_gap")
    gap = equilibrium_gap(law, speed, time_gap)
    if speed > 0 and L < gap < math.inf:
        tau = (gap - L) / speed
        values["tau"] = _digits(tau)
        found.notes.append(
            f"tau: at the data's median speed of {speed:.4g} m/s gaps are the law's, {gap:.4g} m; "
            f"SUMO's steps must not be longer than tau, {tau:.3g} s"
        )
    else:
        found.missing.append(
            f"tau: the law has no gap at the data's median speed of {speed:.4g} m/s; SUMO's stays"
        )
    if "reaction_delay" in effects:
        delay = _value(effects["reaction_delay"], "T")
        values["actionStepLength"] = _digits(delay)
        found.notes.append(
            "actionStepLength: the reaction delay; SUMO's drivers decide at such intervals, which "
            "delays them by half of it on average"
        )
        counted.add("reaction_delay")
    found.missing.append(
        "the law's curvature, and speed as a function of the gap alone: Krauss' drivers also mind "
        "the speed ahead and accelerate by at most accel, decel, which stay SUMO's"
    )
    found.missing += effects_without(system, 1, counted)
    found.text = _document(values, found)
    return found


def _value(effect: Module, parameter: str) -> float:
    return float(getattr(effect, parameter).detach())


def _digits(value: float) -> str:
    return f"{value:.6g}"


def _document(values: dict[str, str], found: Counterpart) -> str:
    root = ElementTree.Element("additional")
    lines = [*found.notes, *(f"no counterpart: {text}" for text in found.missing)]
    for line in lines:
        root.append(ElementTree.Comment(f" {line.replace('--', '- -')} "))
    ElementTree.SubElement(root, "vType", values)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=False) + "\n"
