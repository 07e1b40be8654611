"""Confirmation sequences in a player, with the named place shaded."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nnode.data.sequence import evenly
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.report.files import amount
from nnode.diagnosis.result import Diagnosis, NamedEffect
from nnode.pages.replay import ReplayBlock, Scene, Zone

#: Largest number of confirmation sequences in the player.
SCENES = 16
#: Names of the two models, also in the figures.
BEFORE, AFTER = "without effects", "with effects"


def scenes(outcome: DiagnosisOutcome) -> list[Scene]:
    """Confirmation sequences with the simulations of their errors, without and with effects.

    They are ordered by decreasing error without effects; of many sequences, at most :data:`SCENES`
    are taken at equal steps of this order. Sequences without finite errors are left out.
    """
    d = outcome.diagnosis
    compared = [
        (row, before, after)
        for row, (before, after) in zip(d.confirmation_errors, outcome.simulated, strict=False)
        if before is not None
        and after is not None
        and np.isfinite([row["before"], row["after"]]).all()
    ]
    compared.sort(key=lambda item: -item[0]["before"])
    replayed = []
    for row, before, after in evenly(compared, SCENES):
        paths, errors = {BEFORE: before.x}, {BEFORE: float(row["before"])}
        if d.effects:
            paths[AFTER], errors[AFTER] = after.x, float(row["after"])
        notes = {title: f"error {amount(error)} m²" for title, error in errors.items()}
        replayed.append(Scene(before.sequence, paths, notes=notes, restart=before.restart))
    return replayed


def player(outcome: DiagnosisOutcome, replayed: list[Scene]) -> ReplayBlock:
    """The player of :func:`scenes`."""
    n_confirmation = len(outcome.confirmation)
    shaded = zones(outcome.diagnosis)
    named = f" Shaded: {', '.join(zone.label for zone in shaded)}." if shaded else ""
    return ReplayBlock(
        "replay",
        replayed,
        "Confirmation sequences by decreasing error, as measured and as simulated; the player "
        "opens on the sequence with the median error. Outlines are measured agents, and arrows "
        "lead from the simulated to the measured position. Agents without a simulated position "
        "are inputs of the simulation. The distance is the root mean square over the agents at "
        "the moment shown, and the error is the mean of its square over the sequence."
        f"{_restart_note(replayed)}{named}",
        f"Player of {len(replayed)} confirmation sequences: agents as measured and as simulated "
        f"by {len(replayed[0].simulated)} models.",
        shaded,
        n_confirmation,
    )


def _restart_note(replayed: list[Scene]) -> str:
    """A note on simulations that restart."""
    scene = replayed[0]
    if scene.restart is None:
        return ""
    seconds = scene.restart * scene.sequence.dt
    return f" Simulations restart from the measurement every {seconds:.2g} s."


def zones(d: Diagnosis) -> list[Zone]:
    """Places and times of the named effects; without any, the largest deviation."""
    effect_zones = [zone for effect in d.effects if (zone := _zone(effect)) is not None]
    if effect_zones:
        return effect_zones
    for place in d.places:
        ends = (place.low, place.high)
        if not np.isfinite(ends).all():
            continue
        match place.variable.split(",")[0]:
            case "position" | "position x":
                return [Zone("largest deviation", x=ends)]
            case "position y":
                return [Zone("largest deviation", y=ends)]
            case "clock time":
                return [Zone("largest deviation", t=ends)]
    return []


def _zone(effect: NamedEffect) -> Zone | None:
    coefficients = effect.coefficients
    values = {name: c.value for name, c in coefficients.items()}
    return zone_of(effect.name, values, coefficients["a"].unit if "a" in coefficients else "")


def zone_of(name: str, at: Mapping[str, float], unit: str) -> Zone | None:
    """Where or when an effect acts: its interval [a, b], or around its place.

    Args:
        name: of the effect.
        at: its parameters.
        unit: of a and b, where it has these: m or s.
    """
    if {"x_o", "y_o", "B_o"} <= set(at):
        return Zone(name, circle=(at["x_o"], at["y_o"], at["B_o"]))
    if {"a", "b"} <= set(at) and unit in ("m", "s"):
        ends = (at["a"], at["b"])
        return Zone(name, x=ends) if unit == "m" else Zone(name, t=ends)
    return None
