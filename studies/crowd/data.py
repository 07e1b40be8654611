"""Sequences of the crowd study: horizons, blocks of time that are held out, other runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nnode.data.prepare import prepare
from nnode.data.readers.juelich import JuelichOptions
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.store import Store
from studies.options import StudyOptions
from studies.stores import sequences

#: The recording that the paper calibrates on, and its walls, m.
RECORDING, WALLS = "bi_corr_400_b_03", {"*": [0.0, 4.0]}
#: Two-way flows of other widths and densities: corridors of 3.0 and 3.6 m.
OTHERS = (
    "bo-360-050-050",
    "bo-360-090-090",
    "boa-300-065-105",
    "bot-300-075-075",
    "bot-300-100-100",
    "bot-360-160-160",
)
OTHER_WALLS = {"*-300-*": [0.0, 3.0], "*-360-*": [0.0, 3.6]}
#: Part of the other corridors that is looked at, m along the walking axis.
VIEW = [-4.0, 4.0]

#: Sequences that begin within so many seconds share most of their people: resampled together.
GROUP = 10.0

#: All sequences train; or one block of time is held out (``fold-0``, ``fold-1``, ...).
ALL = "all"


def prepared(options: StudyOptions, folder: Path, kind: str, horizon: float, **extra: Any) -> Store:
    """Cut the paper's recording, or the other runs, into sequences of ``horizon`` seconds.

    Only people who are tracked through a whole sequence are part of it: the longer it is, the
    fewer and the slower they are.

    Args:
        folder: of the study.
        kind: ``main`` or ``others``.
        more: further options of the data source.
    """
    chosen: dict[str, Any] = {"recording": RECORDING, "walls": WALLS}
    if kind == "others":
        chosen = {
            "name": "hermes",
            "recording": list(OTHERS),
            "frame_rate": 16.0,
            "unit": "cm",
            "walking_axis": "y",
            "walls": OTHER_WALLS,
            "view": VIEW,
        }
    data = folder / "data"
    download = options.download or str(data / "raw")
    source = JuelichOptions(
        source=options.source, download=download, t_seq=horizon, **chosen, **extra
    )
    return prepare(source, data / f"{kind}-{horizon:g}s")


def fold_of(
    starts: np.ndarray, ends: np.ndarray, folds: int, span: tuple[float, float]
) -> np.ndarray:
    """``(S,)`` number of the block of time that holds a whole sequence, -1 across a border.

    Args:
        starts, ends: ``(S,)`` s.
        span: first and last time of the recording, s; it is divided into equal blocks.
    """
    width = (span[1] - span[0]) / folds
    tiny = 1e-6 * width
    first = np.floor((starts - span[0] + tiny) / width).astype(int)
    last = np.floor((ends - span[0] - tiny) / width).astype(int)
    return np.where(first == last, first.clip(0, folds - 1), -1)


def parts(
    folder: str, scope: str, folds: int, span: tuple[float, float]
) -> tuple[list[int], list[int]]:
    """Positions of the sequences that train and of those that are held out.

    Whoever shares a person with a held-out sequence does not train. The blocks are the same
    spans of time at every horizon.

    Args:
        folder: of the prepared sequences.
        scope: ``all``, or ``fold-<n>``: everything but the n-th block of time.
        folds: number of blocks.
        span: first and last time of the recording, s.
    """
    every = sequences(folder)
    if scope == ALL:
        return list(range(len(every))), []
    number = int(scope.removeprefix("fold-"))
    starts, ends = (np.array([s.time[k] for s in every]) for k in (0, -1))
    held = np.flatnonzero(fold_of(starts, ends, folds, span) == number).tolist()
    people = {agent for i in held for agent in every[i].agents}
    out = set(held)
    return [i for i, s in enumerate(every) if i not in out and people.isdisjoint(s.agents)], held


def chosen(folder: str, index: Iterable[int]) -> Batch:
    """Some sequences of a folder as one batch."""
    every = sequences(folder)
    return collate(every[i] for i in index)


def time_groups(items: Iterable[Sequence]) -> np.ndarray:
    """``(S,)`` number of the stretch of GROUP seconds, within its recording, of each sequence."""
    keys = [(s.recording, int((s.time[0] + 1e-6) // GROUP)) for s in items]
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([number[key] for key in keys])


def mean_speed(items: Iterable[Sequence]) -> float:
    """Mean over people of their mean speed in a sequence, m/s."""
    return float(
        np.concatenate(
            [np.linalg.norm(s.x[-1] - s.x[0], axis=-1) / (s.time[-1] - s.time[0]) for s in items]
        ).mean()
    )


def turned(sequence: Sequence) -> Sequence:
    """A corridor along y turned by a quarter to the right, so that people walk along x.

    Networks see directions: what they learned in one corridor holds in another one only if both
    lie the same way.
    """
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])  # rows times this: (x, y) to (y, -x)
    walls = sequence.walls
    if walls is not None:
        walls = (walls.reshape(-1, 2, 2) @ turn).reshape(-1, 4)
    return replace(
        sequence,
        x=sequence.x @ turn,
        v=None if sequence.v is None else sequence.v @ turn,
        destination=None if sequence.destination is None else sequence.destination @ turn,
        walls=walls,
    )
