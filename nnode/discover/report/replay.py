"""Confirmation sequences in a player, with the named place shaded."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nnode.discover.outcome import DiagnosisOutcome
from nnode.discover.report.files import amount
from nnode.discover.result import Diagnosis, NamedEffect
from nnode.pages.replay import ReplayBlock, Scene, Zone

#: Largest number of confirmation sequences in the player.
SCENES = 16
#: Names of the two models, also in the figures.
BEFORE, AFTER = "without effects", "with effects"


def by_improvement(outcome: DiagnosisOutcome) -> list[int]:
    """Rows of ``diagnosis.sealed``, first the one whose error falls most, or without effects the
    one with the largest error. Rows without two finite errors are left out."""
    rows = outcome.diagnosis.sealed

    def gain(i: int) -> float:
        after = rows[i]["after"] if outcome.diagnosis.effects else 0.0
        return float(rows[i]["before"]) - float(after)

    finite = [i for i, row in enumerate(rows) if np.isfinite([row["before"], row["after"]]).all()]
    return sorted(finite, key=gain, reverse=True)


def scenes(outcome: DiagnosisOutcome) -> list[Scene]:
    """Confirmation sequences with the simulations of their errors, without and with effects, in the
    order of :func:`by_improvement`.

    The still figure has the first one; a crowd's player begins with the one with most people.
    """
    replayed = []
    for i in by_improvement(outcome)[:SCENES]:
        before, after = outcome.simulated[i]
        if before is None or after is None:
            continue
        row, paths = outcome.diagnosis.sealed[i], {BEFORE: before.x}
        errors = {BEFORE: float(row["before"])}
        if outcome.diagnosis.effects:
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
        "Sealed sequences, on which nothing was calibrated, as measured and in the simulations "
        "that the errors on this page were computed from. Outlines are where agents were measured; "
        "arrows, the residuals, go there from where they are simulated. Agents without a "
        "simulated position are given to the simulation and do not count in the error. The "
        "distance is the root mean square over the agents at the moment that is shown; the error "
        f"is the mean of its square over the sequence.{_restart_note(replayed)}{named}",
        f"Player of {len(replayed)} sealed sequences: agents as measured, and as simulated by "
        f"{len(replayed[0].simulated)} models.",
        shaded,
        n_confirmation,
    )


def _restart_note(replayed: list[Scene]) -> str:
    """A note on simulations that restart."""
    scene = replayed[0]
    if scene.restart is None:
        return ""
    seconds = scene.restart * scene.sequence.dt
    return f" Simulations start again from the measurement every {seconds:.2g} s."


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
                return [Zone("where they part", x=ends)]
            case "position y":
                return [Zone("where they part", y=ends)]
            case "clock time":
                return [Zone("when they part", t=ends)]
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
