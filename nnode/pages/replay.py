"""A player of measured and simulated agents, one sequence at a time."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nnode.data.sequence import Sequence, evenly
from nnode.plots.style import GREY, OKABE_ITO

#: Largest number of bytes and of sequences of a player.
BYTES, MOST = 1_000_000, 60
#: Shortest time between the samples of a player, s. Agents move evenly between samples.
FINEST = 0.1
#: Positions farther away, m, result from a diverged simulation and are not shown.
FAR = 1e7
#: Drawn length of cars of unknown length, m.
CAR = 4.5
#: Drawn radius of people, m.
BODY = 0.2

#: Colours of up to three simulations, the same as in figures.
COLOURS = (OKABE_ITO["vermillion"], OKABE_ITO["blue"], OKABE_ITO["green"])


@dataclass(frozen=True)
class Zone:
    """A shaded place or time with a name.

    Attributes:
        label: the name.
        x, y: intervals, m; None for everywhere.
        t: interval on the recording's clock, s; None for all times.
        circle: centre x, y and radius, m.
    """

    label: str
    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None
    t: tuple[float, float] | None = None
    circle: tuple[float, float, float] | None = None

    def plain(self) -> dict[str, Any]:
        """The zone in plain types."""
        return {key: value for key, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class Scene:
    """A measured sequence and its simulations.

    Attributes:
        sequence: the measured sequence.
        simulated: title to positions ``(K, N, D)``, m, in the order of :data:`COLOURS`. NaN is not
            shown.
        notes: title to a note that the player adds, such as the error of the simulation.
        restart: number of samples after which simulations restart from the measurement; None for
            simulations of the whole sequence.
        led: whether the leader follows its measured path; the shown error excludes it.
    """

    sequence: Sequence
    simulated: dict[str, np.ndarray]
    notes: dict[str, str] = field(default_factory=dict)
    restart: int | None = None
    led: bool = False


@dataclass
class ReplayBlock:
    """A player on a page; in Markdown, a link to it.

    Attributes:
        name: name of the player; ``[text](#figure-<name>)`` refers to it.
        scenes: the sequences, in order. At most as many as :data:`BYTES` and :data:`MOST` allow are
            kept, at equal steps. The player opens on the :func:`typical` scene.
        caption: caption in Markdown.
        alt: description for readers who cannot see the player.
        zones: zones that are shaded in all scenes.
        total: number of sequences from which the scenes were chosen; by default their number.
    """

    name: str
    scenes: Iterable[Scene]
    caption: str
    alt: str
    zones: list[Zone] = field(default_factory=list)
    total: int | None = None

    def data(self) -> tuple[str, str]:
        """The data of the page as JSON, and remarks on them."""
        scenes = list(self.scenes)
        total = len(scenes) if self.total is None else self.total
        scenes = evenly(scenes, MOST)
        packed = [_json(_scene(scene)) for scene in scenes]
        kept = list(range(len(scenes)))
        while len(kept) > 1 and sum(len(packed[i]) for i in kept) > BYTES:
            kept = evenly(range(len(scenes)), len(kept) - 1)
        shown = [scenes[i].sequence for i in kept]
        head = {
            "first": typical([scenes[i] for i in kept]),
            "colours": {"measured": GREY, "simulated": COLOURS},
            "car": CAR,
            "body": BODY,
            "zones": [zone.plain() for zone in self.zones],
        }
        text = f'{_json(head)[:-1]},"scenes":[{",".join(packed[i] for i in kept)}]}}'
        said = []
        if len(kept) < total:
            said.append(f"The player contains {len(kept)} of {total} sequences.")
        if any(s.x.shape[2] == 1 and not _lengths(s) for s in shown):
            said.append(f"Cars of unknown length are drawn {CAR:g} m long.")
        if any(s.x.shape[2] == 2 for s in shown):
            said.append(f"People are drawn with a radius of {BODY:g} m.")
        return text, " ".join(said)


def typical(scenes: list[Scene]) -> int:
    """Index of the scene whose first simulation has the median error."""

    def error(scene: Scene) -> float:
        square = (next(iter(scene.simulated.values())) - scene.sequence.x) ** 2
        compared = square[np.isfinite(square)]
        return float(compared.mean()) if len(compared) else math.inf

    order = sorted(range(len(scenes)), key=lambda i: error(scenes[i]))
    return order[(len(order) - 1) // 2] if order else 0


def _json(value: Any) -> str:
    # a "<" could end the element that holds the text
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c")


def _lengths(s: Sequence) -> bool:
    return s.length is not None and bool(np.isfinite(s.length).any())


def _scene(scene: Scene) -> dict[str, Any]:
    s = scene.sequence
    every = max(1, int(FINEST / s.dt + 1e-6)) if s.n_samples > 1 else 1
    keep = slice(None, None, every)
    content: dict[str, Any] = {
        "name": s.name,
        "start": round(float(s.time[0]), 3),
        "dt": round(every * s.dt, 6) if s.n_samples > 1 else 1.0,
        "dims": s.x.shape[2],
        "measured": packed(s.x[keep]),
        "simulated": [
            {"title": t, "note": scene.notes.get(t, ""), "x": packed(x[keep])}
            for t, x in scene.simulated.items()
        ],
    }
    if scene.led:
        content["led"] = 1
    if s.length is not None and _lengths(s):
        content["length"] = [round(float(x), 2) if np.isfinite(x) else CAR for x in s.length]
    if s.walls is not None and len(s.walls):
        content["walls"] = np.round(s.walls, 2).tolist()
    return content


def packed(x: np.ndarray) -> list[list[int | None]]:
    """Positions ``(K, N, D)`` in m as ``N D`` rows of whole centimetres.

    A number is the difference from the previous one in its row, which keeps the text short. Absent
    positions are None.
    """
    columns = np.asarray(x, float).reshape(len(x), -1).T
    rows: list[list[int | None]] = []
    for column in columns:
        present = np.abs(np.nan_to_num(column, nan=np.inf)) < FAR
        steps = np.diff(np.round(100 * column[present]).astype(int), prepend=0)
        row: list[int | None] = [None] * len(column)
        for place, step in zip(np.flatnonzero(present).tolist(), steps.tolist(), strict=True):
            row[place] = step
        rows.append(row)
    return rows
