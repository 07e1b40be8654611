"""The crowd study's sections on restarts and forces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from nnode.pages.page import Block, FigureBlock, Heading, TableBlock, Text
from nnode.plots.crowd import force_contours
from nnode.plots.interaction import Part, Vector
from nnode.plots.settings import SETTINGS, Setting, six_settings
from studies.crowd import forces, printed
from studies.crowd.data import ALL, chosen, mean_speed, sequences
from studies.crowd.figures import acceleration_by_speed, forces_by_distance
from studies.crowd.fit import NAMES, system_of
from studies.crowd.results import LABELS, MODELS, Crowd, One

#: Starts within this share of the least cost count as equally good.
NEAR = 0.05
#: Correlations from here on count as agreement, differences of them from here on as clear.
ALIKE, CLEARLY = 0.9, 0.3


@dataclass
class Starts:
    """All starts of a kind at the first horizon, all sequences training."""

    study: Crowd
    kind: str
    measured: forces.Measured

    @cached_property
    def fits(self) -> list[One]:
        """Least cost first."""
        return self.study.fits(self.kind, ALL, self.study.horizons[0])

    @cached_property
    def parts(self) -> list[dict[str, np.ndarray]]:
        """Accelerations of the measured people, see :func:`forces.accelerations`."""
        return [forces.accelerations(one.system, self.measured) for one in self.fits]

    def table(self) -> pd.DataFrame:
        """A row per start."""
        rows = {}
        for one, parts in zip(self.fits, self.parts, strict=True):
            row = {"J (m² s)": one.J, "evaluations": one.evaluations}
            if self.kind == "sf":
                row |= dict(zip(("A", "k", "κ"), one.row, strict=True))
            for part in ("pair", "wall", "sum"):
                row[f"size, {part}"] = forces.size(parts[part])
                row[f"likeness, {part}"] = forces.likeness(parts[part], self.parts[0][part])
            rows[(LABELS[self.kind], one.seed)] = row
        return pd.DataFrame(rows).T.rename_axis(["model", "start"])

    def near(self) -> int:
        """Starts that end within NEAR of the least cost."""
        return sum(one.J <= (1 + NEAR) * self.fits[0].J for one in self.fits)

    def least_likeness(self, part: str) -> float:
        """Of the starts within NEAR of the least cost, with the best of them."""
        good = [
            parts[part]
            for one, parts in zip(self.fits, self.parts, strict=True)
            if one.J <= (1 + NEAR) * self.fits[0].J
        ]
        return min((forces.likeness(other, good[0]) for other in good[1:]), default=float("nan"))


def _measured(study: Crowd) -> forces.Measured:
    folder = study.folder("main", study.horizons[0])
    return forces.Measured.of(chosen(folder, range(len(sequences(folder)))))


def restart_blocks(study: Crowd) -> list[Block]:
    """Where the starts end, and whether they agree on the forces."""
    measured = _measured(study)
    kinds = {kind: Starts(study, kind, measured) for kind in MODELS}
    table = pd.concat([starts.table() for starts in kinds.values()])
    first = study.horizons[0]
    lines = [_spread(kinds["sf"])]
    for kind in ("nn", "wall"):
        starts = kinds[kind]
        lines.append(
            f"{LABELS[kind]}: {starts.near()} of {len(starts.fits)} starts end within {NEAR:.0%} "
            f"of the least cost, {starts.fits[0].J:.4f} m² s (worst: {starts.fits[-1].J:.4f})."
        )
    lines.append(_agreement(kinds["nn"]))
    curves = {
        LABELS["sf"]: [forces.away_by_distance(kinds["sf"].fits[0].system, measured)],
        LABELS["nn"]: [forces.away_by_distance(o.system, measured) for o in kinds["nn"].fits],
    }
    speeds = {LABELS[k]: forces.along_by_speed(kinds[k].parts[0]) for k in MODELS}
    speed = mean_speed(sequences(study.folder("main", first)))
    pulls = []
    for kind in MODELS:
        rate, to = forces.slope(kinds[kind].parts[0])
        pulls.append(
            f"{LABELS[kind]} pulls the speed along the corridor to {to:.2f} m/s at {rate:.2f} "
            "per second"
            if rate > 0.05
            else f"{LABELS[kind]} does not pull people to a speed ({-rate:+.2f} per second)"
        )
    return [
        Heading("Restarts: what the data fix, and what a start decides"),
        Text(
            f"All sequences of {first:g} s. *Size* is the root mean square acceleration (m/s²) of "
            "the measured people, *likeness* the correlation of these accelerations with those "
            "of the model's best start.\n\n" + "\n".join(f"- {line}" for line in lines)
        ),
        TableBlock(
            "crowd_restarts",
            table,
            "Starts, best first. Parts of the force may differ where their sum agrees.",
            digits={"J (m² s)": 5, "evaluations": 0, "A": 4, "k": 2, "κ": 2},
        ),
        FigureBlock(
            "crowd_range",
            forces_by_distance(curves),
            "Mean force of one measured person on another by their distance. Where curves of "
            "different starts part although their costs agree, the force is no property of the "
            "data.",
            "Two panels of force against distance, people facing each other and walking the same "
            "way; a line per start of the networks and one for the social force.",
        ),
        Text(
            "The relaxation has no speed of its own: a person keeps the speed that two noisy "
            f"positions gave him. The mean speed is {speed:.2f} m/s. " + "; ".join(pulls) + "."
        ),
        FigureBlock(
            "crowd_speed",
            acceleration_by_speed(speeds),
            "Mean acceleration of the measured people along their own way by their speed, from "
            "other people and from walls. A falling line is a pull to the speed at which it "
            "crosses zero. Bars: how many people have that speed.",
            "Three panels, one per model: acceleration from people, from walls and their sum "
            "against own speed.",
        ),
    ]


def _spread(starts: Starts) -> str:
    rows = np.array([one.row for one in starts.fits])
    best = rows[0]
    away = np.abs(rows / np.where(best > 0, best, 1) - 1).max(0)
    same = float(away.max()) < 0.01
    text = f"SF: {starts.near()} of {len(rows)} starts end within {NEAR:.0%} of the least cost"
    return text + (
        "; all find the same A, k and κ to within 1 %."
        if same
        else "; the largest relative differences of their parameters are "
        + ", ".join(f"{name} {value:.2g}" for name, value in zip(NAMES, away, strict=True))
        + "."
    )


def _agreement(starts: Starts) -> str:
    """Whether NN's parts, or only their sum, are the same from every good start."""
    if starts.near() < 2:
        return "Only one start of NN ends near its least cost: nothing can be said of agreement."
    like = {part: starts.least_likeness(part) for part in ("pair", "wall", "sum")}
    told = ", ".join(f"{part} {value:.2f}" for part, value in like.items())
    text = f"Among the good starts of NN the least likeness with the best one is: {told}. "
    if min(like["pair"], like["wall"]) >= ALIKE:
        return text + "The starts agree on both forces: their range is a property of the data."
    if like["sum"] - max(like["pair"], like["wall"]) >= CLEARLY:
        return text + (
            "They agree far better on the sum than on its parts: what is between people and what "
            "is from walls, and with it the range of the force between people, is decided by the "
            "start. This is what the paper meets when only the sum of its two networks makes "
            "sense."
        )
    return text + "They agree neither on the parts nor on the sum: the data do not fix the force."


def force_blocks(study: Crowd) -> list[Block]:
    """Contours, and the six settings, of both models."""
    first = study.horizons[0]
    found: list[Block] = [Heading("Forces")]
    for model in ("sf", "nn"):
        name, system = LABELS[model], study.chosen(model, ALL, first).system
        found.append(Heading(f"{name}: contours", 3))
        parts: tuple[Part, ...] = ("sum", "pair", "wall") if model == "nn" else ("pair", "wall")
        for part in parts:
            for i, letter in enumerate("xy"):
                found.append(
                    FigureBlock(
                        f"{model}_{part}_{letter}",
                        force_contours(system, i, part=part),
                        f"{name}, F_{letter}, {'pair and wall added' if part == 'sum' else part}, "
                        "at four relative velocities; walking is along x. Solid lines are "
                        "positive, dashed ones negative.",
                        f"Contour plots of the {letter} component of the {part} force of {name}.",
                    )
                )
        found += _settings(study, model)
    return [*found, *_settings_along(study)]


def _settings(study: Crowd, model: str) -> list[Block]:
    name = LABELS[model]
    figure, table = six_settings(study.chosen(model, ALL, study.horizons[0]).system)
    ours = printed.settings(model, table)
    text = ""
    if model == "sf":
        exact = printed.settings(
            "sf", six_settings(system_of("sf", list(printed.PARAMETERS.values())))[1]
        )
        away = max(float((exact[f] - exact[f"{f} printed"]).abs().max()) for f in ("F_x", "F_y"))
        text = (
            f"With the printed parameters the printed forces come out to within {away:.4f} N. "
            "The forces below are those of the parameters found here."
        )
    else:
        forces_here = ours[["F_x", "F_y"]].to_numpy()
        told = ours[["F_x printed", "F_y printed"]].to_numpy()
        ratio = np.sqrt((forces_here**2).sum() / (told**2).sum())
        text = (
            f"Forces here are {ratio:.1f} times the printed ones in root mean square; their "
            f"correlation with the printed ones is {forces.likeness(forces_here, told):.2f}. "
            "Walls enter at the same relative place and velocity as the other person, as the "
            f"paper adds its two networks. {_across(_measured(study))}"
        )
    return [
        Heading(f"{name}: six settings", 3),
        Text(text),
        FigureBlock(
            f"settings_{model}",
            figure,
            f"Forces on two people in the paper's six settings, {name}. Left they face each "
            "other, right they walk the same way.",
            f"Six panels with two people, their velocities and the forces on them, {name}.",
        ),
        TableBlock(
            f"settings_{model}",
            ours,
            f"The six settings, {name}: forces (N) here beside the printed ones.",
            digits=4,
        ),
    ]


def _across(measured: forces.Measured) -> str:
    """How far the printed settings are from what was measured."""
    fast = float((np.abs(measured.dv[:, 1]) >= 1.0).mean())
    wide = float(np.abs(measured.dx[:, 1]).max())
    return (
        "In these settings people walk along y and stand up to 8 m apart along y. In the "
        f"recording they walk along x: of the measured pairs nearer than {forces.FAR:g} m "
        f"{fast:.1%} differ by 1 m/s or more in their velocity along y, and none is more than "
        f"{wide:.1f} m apart along y. What a network says there is not learned from data"
        + (", unlike the same settings along x, below." if fast < 0.05 else ".")
    )


def _settings_along(study: Crowd) -> list[Block]:
    """The six settings with x and y exchanged: people walk as those of the recording do."""

    def swap(one: Vector) -> Vector:
        return one[1], one[0]

    settings = [
        Setting(s.name, swap(s.x_blue), swap(s.x_red), swap(s.v_blue), swap(s.v_red))
        for s in SETTINGS["long"]
    ]
    name, system = LABELS["nn"], study.chosen("nn", ALL, study.horizons[0]).system
    figure, table = six_settings(system, settings)
    pairs = six_settings(system, settings, part="pair")[1]
    walls = six_settings(system, settings, part="wall")[1]
    rows = {}
    parts = {"pair": pairs, "wall": walls, "sum": table}
    for i, setting in enumerate(settings):
        for person in ("blue", "red"):
            rows[(setting.name, person)] = {
                f"F_{letter}, {part}": frame[f"force_{person}"].tolist()[i][c]
                for c, letter in enumerate("xy")
                for part, frame in parts.items()
            }
    forces_along = pd.DataFrame(rows).T.rename_axis(["setting", "person"])
    return [
        Heading(f"{name}: six settings along the corridor", 3),
        FigureBlock(
            "settings_nn_along",
            figure,
            f"The settings with x and y exchanged, {name}: people walk along the corridor.",
            f"Six panels with two people walking along x, and the forces on them, {name}.",
        ),
        TableBlock(
            "settings_nn_along",
            forces_along,
            "Forces (N) from the other person, from a wall point at his place, and their sum.",
            digits=3,
        ),
    ]
