"""Figures of a diagnosis' page, with captions and alternative texts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from nnode.diagnosis.inputs import Inputs
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.report.deviation import SPAN, Deviation, deviation
from nnode.diagnosis.report.figures.maps import (
    approach_maps,
    neighbour_maps,
    plane_maps,
    time_space_maps,
)
from nnode.diagnosis.report.figures.marks import (
    coefficient_intervals,
    confirmation_costs,
    flexible_curve,
    place_curves,
)
from nnode.diagnosis.report.figures.paths import as_drawn, trajectories
from nnode.diagnosis.report.files import amount, individual, interval
from nnode.diagnosis.report.replay import AFTER, BEFORE, player, scenes
from nnode.errors import ConfigError
from nnode.model import System
from nnode.pages.page import FigureBlock
from nnode.pages.replay import ReplayBlock, typical
from nnode.pages.tables import markdown
from nnode.plots.quality import faults_figure

#: Largest numbers of faulty sequences and of variables that are drawn.
FAULTY, PLACES = 10, 9

#: Units of maps of deviations.
UNITS = {"traffic": "m/s", "crowd": "m/s²"}


#: The figures of a page, by section.
Figures = dict[str, list[FigureBlock | ReplayBlock]]


def unit_of(system: System) -> str:
    """The unit of a law's rate: a speed, or an acceleration."""
    return "m/s" if system.order == 1 else "m/s²"


def figures(inputs: Inputs, outcome: DiagnosisOutcome, options: DiscoverOptions) -> Figures:
    """Draw all figures of a diagnosis."""
    d, maps = outcome.diagnosis, _map_figures(inputs, outcome, options)
    drawn: Figures = {
        "map": [*maps[:1]],
        "gap": [_confirmation_errors(outcome)] if d.confirmation_errors else [],
        "effects": [],
        "places": [*_places(outcome), *maps[1:]],
        "unknown": [],
        "faults": [_faults(inputs)] if inputs.faulty else [],
        "paths": _paths(outcome, options),
    }
    if d.effects:
        drawn["effects"] = [
            FigureBlock(
                "coefficients",
                coefficient_intervals(d.effects),
                "Coefficients with 95 % intervals. Dotted line: value without the effect.",
                "; ".join(f"{effect.name}: {interval(effect)}" for effect in d.effects),
            )
        ]
    if d.unknown is not None and d.unknown.curve:
        variable = d.unknown.variables[0] if d.unknown.variables else "the first variable"
        drawn["unknown"] = [
            FigureBlock(
                "unknown",
                flexible_curve(d.unknown, unit_of(outcome.base)),
                f"Nonparametric estimate of the missing term by {variable}.",
                f"Curve of the missing term by {variable}.",
            )
        ]
    return drawn


def figure(
    which: str, inputs: Inputs, outcome: DiagnosisOutcome, options: DiscoverOptions
) -> Figure:
    """One figure of a diagnosis by its name on the page.

    Args:
        which: ``map`` of the deviations before and after, ``confirmation`` for errors of the
            confirmation sequences, ``coefficients`` of the effects, or others that it names.

    Raises:
        ConfigError: the diagnosis has no such figure; names those that it has.
    """
    drawn = figures(inputs, outcome, replace(options, replay=False))
    by_name = {
        block.name: block.figure
        for section in ("map", "gap", "effects", "places", "unknown")
        for block in drawn[section]
        if isinstance(block, FigureBlock)
    }
    if which not in by_name:
        raise ConfigError(f"there is no figure {which!r}; this diagnosis has {', '.join(by_name)}")
    return by_name[which]


def _confirmation_errors(outcome: DiagnosisOutcome) -> FigureBlock:
    d = outcome.diagnosis
    names, before, after = (
        [row[key] for row in d.confirmation_errors] for key in ("name", "before", "after")
    )
    smaller = sum(a < b for a, b in zip(after, before, strict=True))
    counted = f" With effects, {smaller} of {len(names)} errors are smaller." * bool(d.effects)
    return FigureBlock(
        "confirmation",
        confirmation_costs(
            list(map(str, names)), before, after if d.effects else None, d.gap.noise_floor
        ),
        f"Mean square error of each confirmation sequence, in decreasing order.{counted}",
        f"Marks of {len(names)} sequences, from the largest error to the smallest.{counted}",
    )


def _faults(inputs: Inputs) -> FigureBlock:
    shown = inputs.faulty[:FAULTY]
    cut = f" The first {FAULTY} of {len(inputs.faulty)}." if len(inputs.faulty) > FAULTY else ""
    return FigureBlock(
        "faults",
        faults_figure([*inputs.faulty, *inputs.sequences], inputs.faults, inputs.domain, FAULTY),
        f"Sequences with a fault of the measurement; the fault is marked.{cut}",
        "Position over time of " + ", ".join(s.name for s in shown) + ", faults marked.",
    )


def _places(outcome: DiagnosisOutcome) -> list[FigureBlock]:
    unit = unit_of(outcome.base)
    curves = [place for place in outcome.diagnosis.places if place.curve][:PLACES]
    if not curves:
        return []
    return [
        FigureBlock(
            "where",
            place_curves(curves, unit),
            f"Term ({unit}) that is missing from the model without effects, by variable, with "
            "standard errors, estimated to first order together with the model's parameters. "
            "These parameters can compensate for a part of a curve, often a constant. A curve "
            "therefore shows the shape of the missing term, and may differ from measured minus "
            "simulated rates in size and sign. The interval of the table is shaded.",
            "; ".join(
                f"{p.variable} {amount(p.low)} to {amount(p.high)} {p.unit}: "
                f"{amount(p.deviation)} ± {amount(p.error, 2)} {unit}"
                for p in curves
            ),
        )
    ]


def _map_figures(
    inputs: Inputs, outcome: DiagnosisOutcome, options: DiscoverOptions
) -> list[FigureBlock]:
    """Maps of deviations by place, and by the nearest agent; none if nothing was simulated."""
    maps, unit = _maps(inputs, outcome, options), UNITS[inputs.domain]
    if not len(next(iter(maps.values())).time):
        return []
    spreads = ", ".join(f"{name}: {_spread(map_)} {unit} rms" for name, map_ in maps.items())
    note = "".join(
        f" {effect} acts only on agents of the exploration sequences."
        for effect in individual(outcome.extended)
    )
    if inputs.domain == "traffic":
        number = len({s.recording for s in inputs.sequences})
        superimposed = f" The {number} recordings are superimposed." if number > 1 else ""
        space, neighbour_map = time_space_maps(maps), approach_maps(maps)
        words = (
            "Measured minus simulated speed by time and position, in all sequences. The "
            f"simulation restarts every {SPAN['traffic']:g} s. Grey: no vehicle."
            f"{superimposed}{note}",
            "Measured minus simulated speed by gap and relative speed of the vehicle ahead.",
        )
    else:
        space = plane_maps(maps, inputs.sequences[0].walls)
        neighbour_map = neighbour_maps(maps)
        words = (
            "Mean of measured minus simulated acceleration by position, in all sequences. The "
            f"simulation restarts every {SPAN['crowd']:g} s. Thick lines: walls.{note}",
            "Mean of measured minus simulated acceleration by the position of the nearest person, "
            "in the frame of the own walking direction (triangle).",
        )
    return [
        FigureBlock("map", space, words[0], f"Map of the deviations by position. {spreads}."),
        FigureBlock("map_beside", neighbour_map, words[1], f"Map by the nearest agent. {spreads}."),
    ]


def _spread(map_: Deviation) -> str:
    sizes = np.linalg.norm(map_.value, axis=1)
    return amount(float(np.sqrt(np.mean(sizes**2))), 2)


def _maps(
    inputs: Inputs, outcome: DiagnosisOutcome, options: DiscoverOptions
) -> dict[str, Deviation]:
    systems = {"before": (BEFORE, outcome.base)}
    if outcome.diagnosis.effects:
        systems["after"] = (AFTER, outcome.extended)
    return {
        title: outcome.maps.get(key) or deviation(system, inputs.sequences, options.step)
        for key, (title, system) in systems.items()
    }


def _paths(outcome: DiagnosisOutcome, options: DiscoverOptions) -> list[FigureBlock | ReplayBlock]:
    replayed = scenes(outcome)
    if not replayed:
        return []
    scene = replayed[typical(replayed)]
    s, simulated = scene.sequence, as_drawn(scene)
    errors = ", ".join(simulation.heading for simulation in simulated)
    moving = [player(outcome, replayed)] if options.replay else []
    return [
        FigureBlock(
            "trajectories",
            trajectories(s, simulated),
            f"Measured and simulated paths of the confirmation sequence {markdown(s.name)}, "
            "which has the median error.",
            f"Paths of the sequence {s.name}; {errors}.",
        ),
        *moving,
    ]
