"""Calibrated laws as a vehicle type for SUMO.

``idm`` and ``krauss`` are SUMO's IDM and KraussOrig1, parameter by parameter. SUMO has no
car-following model of first order. Krauss' model without noise replaces laws of the gap. Its gap
at a constant speed v is length + minGap + tau v. The parameters are chosen such that the gap at
rest, the gap at the recorded speed, and the greatest speed are the law's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any
from xml.etree import ElementTree

import numpy as np
from torch.nn import Module

from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.exchange.counterpart import (
    Counterpart,
    Intervals,
    effects_without,
    field_law,
    interval_lines,
)
from nnode.model import Law, System

#: SUMO's length of a passenger car, m, for data without lengths.
DEFAULT_LENGTH = 5.0
#: Laws that SUMO has, to SUMO's names.
SAME = {"idm": "IDM", "krauss": "KraussOrig1"}
#: Parameters of these laws, except the gap at rest, to SUMO's names.
_SAME = {"v0": "maxSpeed", "T": "tau", "a": "accel", "b": "decel"}


def traffic_of(sequences: Iterable[Sequence]) -> tuple[float, float | None]:
    """Median of the measured speeds (m/s), and of the known lengths (m)."""
    speeds, lengths = [], []
    for s in sequences:
        speeds.append(s.velocity().ravel())
        if s.length is not None:
            lengths.append(s.length[np.isfinite(s.length)])
    of_vehicles = np.concatenate(lengths) if lengths else np.empty(0)
    speed = float(np.median(np.concatenate(speeds)))
    return speed, float(np.median(of_vehicles)) if len(of_vehicles) else None


def equilibrium_gap(law: Law, speed: float, time_gap: float = 0.0) -> float:
    """Equilibrium gap (m, front to front) of a law at ``speed`` (m/s); infinite from v0 on.

    Args:
        time_gap: parameter h of the effect ``time_gap``, s.
    """
    v0, standstill = _value(law, "v0"), _value(law, "L") + time_gap * speed
    if law.entry == "log":
        return standstill * math.exp(speed / v0)
    return standstill / (1 - speed / v0) if speed < v0 else math.inf


def has_type(system: System) -> bool:
    """Whether SUMO has a counterpart of a model's law."""
    return system.find_law("lin", "log") is not None or field_law(system, SAME) is not None


def sumo_type(
    system: System,
    name: str,
    speed: float,
    length: float | None,
    intervals: Intervals | None = None,
) -> Counterpart:
    """An additional file with one ``vType``.

    Args:
        system: ``idm``, ``krauss`` or a law of the gap, with or without effects.
        name: name of the vehicle type.
        speed: speed (m/s) at which gaps agree for laws of the gap, the median of the data.
        length: length of the vehicles, m; None takes SUMO's default.
        intervals: intervals of the parameters, for the file's comments.

    Raises:
        ConfigError: SUMO has no counterpart of the law.
    """
    law = field_law(system, SAME)
    if law is not None:
        counterpart = _same_law(system, law, name, length)
    else:
        counterpart = _krauss_of_gap(system, name, speed, length)
    counterpart.notes[:0] = interval_lines(system, intervals or {})
    counterpart.text = _document(counterpart)
    return counterpart


def _same_law(system: System, law: str, name: str, length: float | None) -> Counterpart:
    """The counterpart of a law that SUMO has."""
    counterpart = Counterpart()
    term: Any = system.terms[0]
    s0 = _value(term, "s0")
    body, min_gap = (length, s0) if length is not None else _split_standstill(s0, DEFAULT_LENGTH)
    counterpart.values = {
        "id": name,
        "carFollowModel": SAME[law],
        "sigma": "0",
        "speedFactor": "1",
        "speedDev": "0",
        "length": _exactly(body),
        "minGap": _exactly(min_gap),
        **{_SAME[p]: _exactly(_value(term, p)) for p in _SAME},
    }
    if law == "idm":
        del counterpart.values["sigma"]
    if length is None:
        counterpart.notes.append(
            f"length + minGap = s0 = {s0:.4g} m: the data have no lengths, so s0 contains a length"
        )
        if law == "idm":
            counterpart.missing.append(
                "gaps from front to front: SUMO's IDM divides by the gap between bumpers, and the "
                "run's law by a gap that contains a length; calibrate with lengths for equal paths"
            )
    else:
        counterpart.notes.append(f"length: the data's median, {body:.4g} m")
    counterpart.notes.append(
        "maxSpeed: lanes also limit the speed; keep speedFactor at 1 and speed limits above v0"
    )
    if law == "krauss":
        counterpart.missing.append(
            "the last metre behind a vehicle at rest, where SUMO's speed is decel times one step"
        )
    counterpart.missing += effects_without(system)
    return counterpart


def _split_standstill(whole: float, length: float) -> tuple[float, float]:
    """A gap at rest from front to front as a vehicle length and a gap between bumpers, m."""
    of_body = min(length, whole)
    return of_body, whole - of_body


def _krauss_of_gap(system: System, name: str, speed: float, length: float | None) -> Counterpart:
    """Krauss' model as the counterpart of a law of the gap."""
    law = system.find_law("lin", "log")
    if law is None:
        raise ConfigError(
            f"to=sumo: the run's model is neither {' nor '.join(SAME)} nor a law with a gap at "
            "rest, and SUMO has no counterpart of it; leave sumo out of to=, or control SUMO's "
            "vehicles by the model: nnode drive"
        )
    counterpart = Counterpart()
    effects = {str(term.name): term for term in list(system.terms)[1:]}
    L, v0 = _value(law, "L"), _value(law, "v0")
    of_body, min_gap = _split_standstill(L, DEFAULT_LENGTH if length is None else length)
    values = {
        "id": name,
        "carFollowModel": "Krauss",
        "sigma": "0",
        "speedDev": "0",
        "length": _digits(of_body),
        "minGap": _digits(min_gap),
    }
    text = f"{of_body:.3g} m of it are the length, "
    text += "SUMO's default, at most L" if length is None else "the data's median, at most L"
    counterpart.notes.append(f"length + minGap = L = {L:.4g} m, the gap at rest; {text}")

    limits = [v0] if law.entry == "lin" else []
    counted = set()
    if "free_flow_speed" in effects:
        limits.append(_value(effects["free_flow_speed"], "v_max"))
        counted.add("free_flow_speed")
    if limits:
        values["maxSpeed"] = _digits(min(limits))
    else:
        counterpart.missing.append(
            f"v0 = {v0:.4g} m/s: the logarithmic law has no greatest speed, so maxSpeed is SUMO's "
            "default"
        )
    time_gap = 0.0
    if "time_gap" in effects:
        time_gap = _value(effects["time_gap"], "h")
        counted.add("time_gap")
    gap = equilibrium_gap(law, speed, time_gap)
    if speed > 0 and L < gap < math.inf:
        tau = (gap - L) / speed
        values["tau"] = _digits(tau)
        counterpart.notes.append(
            f"tau: at the data's median speed of {speed:.4g} m/s, the gap is that of the law, "
            f"{gap:.4g} m; SUMO's steps must not be longer than tau, {tau:.3g} s"
        )
    else:
        counterpart.missing.append(
            f"tau: the law has no gap at the data's median speed of {speed:.4g} m/s, so tau is "
            "SUMO's default"
        )
    if "reaction_delay" in effects:
        delay = _value(effects["reaction_delay"], "T")
        values["actionStepLength"] = _digits(delay)
        counterpart.notes.append(
            "actionStepLength: the reaction delay; SUMO's drivers decide at these intervals, so "
            "their mean delay is half an interval"
        )
        counted.add("reaction_delay")
    counterpart.missing.append(
        "the law's curvature, and speed as a function of the gap alone: Krauss' drivers also react "
        "to the speed ahead, and their accelerations are limited by SUMO's default accel and decel"
    )
    counterpart.missing += effects_without(system, 1, counted)
    counterpart.values = values
    return counterpart


def _value(effect: Module, parameter: str) -> float:
    return float(getattr(effect, parameter).detach())


def _digits(value: float) -> str:
    return f"{value:.6g}"


def _exactly(value: float) -> str:
    return f"{value:.12g}"


def _document(counterpart: Counterpart) -> str:
    root = ElementTree.Element("additional")
    for line in counterpart.lines:
        root.append(ElementTree.Comment(f" {line.replace('--', '- -')} "))
    ElementTree.SubElement(root, "vType", counterpart.values)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=False) + "\n"
