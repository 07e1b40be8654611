"""Sealed sequences in a player, with the place that was named shaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from nnode.data.sequence import Sequence
from nnode.discover.found import Found
from nnode.discover.inputs import Inputs
from nnode.discover.options import DiscoverOptions
from nnode.discover.report.deviation import simulate, smooth_velocity
from nnode.discover.result import Diagnosis, NamedEffect
from nnode.pages.replay import ReplayBlock, Scene, Zone

#: Seconds of a crowd's sequence that are shown: later, small errors have grown to other ways.
SHOWN = 4.0
#: Sealed sequences that are simulated for the player.
SCENES = 16
#: What the two models are called, here and in the figures.
BEFORE, AFTER = "as it was given", "with the effects"


def telling(found: Found, sequences: list[Sequence]) -> list[Sequence]:
    """The sealed sequences, first the one that shows most: where most was gained, else missed."""
    rows = {str(row["name"]): row for row in found.diagnosis.sealed}

    def shown(s: Sequence) -> float:
        row = rows.get(s.name)
        if row is None:
            return -np.inf
        after = row["after"] if found.diagnosis.effects else 0.0
        gain = float(row["before"]) - float(after)
        return gain if np.isfinite(gain) else -np.inf

    return sorted((sequences[i] for i in found.sealed), key=shown, reverse=True)


def scenes(inputs: Inputs, found: Found, options: DiscoverOptions) -> list[Scene]:
    """Sealed sequences as measured and as simulated before and after, the most telling first.

    The still figure has the first one; a crowd's player begins with the one with most people.
    Those that a model cannot be simulated on are left out.
    """
    chosen = telling(found, inputs.sequences)[: SCENES if options.replay else 1]
    if inputs.domain == "crowd":
        chosen = [_begin(s) for s in chosen]
    models = {BEFORE: found.base}
    if found.diagnosis.effects:
        models[AFTER] = found.extended
    paths = {name: simulate(model, chosen, options.step) for name, model in models.items()}
    every = []
    for i, s in enumerate(chosen):
        there = {name: x for name, each in paths.items() if (x := each[i]) is not None}
        if len(there) == len(paths):
            every.append(Scene(s, there, getattr(found.base, "leader", "") == "measured"))
    return every


def _begin(s: Sequence) -> Sequence:
    keep = 1 + round(SHOWN / s.dt)
    goal = s.x[-1] if s.destination is None else s.destination
    return replace(
        s, time=s.time[:keep], x=s.x[:keep], v=smooth_velocity(s)[:keep], destination=goal
    )


def player(found: Found, every: list[Scene]) -> ReplayBlock:
    """The player of :func:`scenes`."""
    sealed = len(found.sealed)
    shaded = zones(found.diagnosis)
    named = f" Shaded: {', '.join(zone.label for zone in shaded)}." if shaded else ""
    return ReplayBlock(
        "replay",
        every,
        "Sealed sequences, on which nothing was calibrated, as measured and as simulated from "
        "their first moment on. Outlines are where agents were measured; arrows, the residuals, "
        f"go there from where they are simulated.{named}",
        f"Player of {len(every)} sealed sequences: agents as measured, and as simulated by "
        f"{len(every[0].simulated)} models.",
        shaded,
        sealed,
    )


def zones(d: Diagnosis) -> list[Zone]:
    """Places and times of the effects that were named; without any, where the model parts most."""
    found = [zone for effect in d.effects if (zone := _zone(effect)) is not None]
    if found:
        return found
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
    found = effect.coefficients
    at = {name: c.value for name, c in found.items()}
    return zone_of(effect.name, at, found["a"].unit if "a" in found else "")


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
