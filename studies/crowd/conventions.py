"""Conventions that the paper leaves open: how sequences are cut, and what a person is told.

The velocity at the start, 25 or 26 samples a sequence, the frame at which cutting begins, and
where people walk to are varied against each other; sums and means follow from the same costs.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.data.options import JuelichOptions
from nnode.data.readers.juelich import cut_people, juelich_files, load_people
from nnode.data.sequence import Batch, Sequence, collate
from studies.crowd.data import RECORDING, WALLS
from studies.crowd.fit import calibrate, costs, new_system, row_of
from studies.crowd.printed import PARAMETERS

Result = dict[str, Any]

#: Frames from the start of one sequence to that of the next: the paper's 1 s.
STRIDE = 25

#: Of the first sample: differences to the next, to both and to the last frame of the recording;
#: the way through the whole sequence over its time; or nobody moves at first.
VELOCITIES = ("forward", "central", "backward", "mean", "none")
#: Without and with the sample that two sequences share.
SAMPLES = (25, 26)
#: A person's last position in the sequence, or in the recording; or straight on to the corridor's
#: end on his side.
DESTINATIONS = ("sequence", "trajectory", "corridor")


@dataclass(frozen=True)
class Convention:
    """One way to cut the recording; see VELOCITIES, SAMPLES and DESTINATIONS."""

    velocity: str = "forward"
    samples: int = 26
    destination: str = "sequence"

    def __str__(self) -> str:
        return f"{self.velocity}, {self.samples}, {self.destination}"


EVERY = [Convention(*how) for how in product(VELOCITIES, SAMPLES, DESTINATIONS)]


@dataclass(frozen=True)
class Tracks:
    """A whole recording.

    Attributes:
        x: ``(F, P, 2)`` m, all people in all frames, NaN where absent.
        first, last: ``(P, 2)`` m, of each person.
        walls: ``(2, 4)`` m.
        rate: frames per second.
    """

    x: np.ndarray
    first: np.ndarray
    last: np.ndarray
    walls: np.ndarray
    rate: float

    @classmethod
    @lru_cache(maxsize=1)
    def of(cls, path: str) -> Tracks:
        """Read the text file of the paper's recording."""
        options = JuelichOptions(recording=RECORDING, walls=WALLS)
        rows, dt = load_people(Path(path), options)
        walls = cut_people((rows, dt), options, None)[0].walls
        assert walls is not None
        table = pd.DataFrame({"id": rows.agent.astype(int), "frame": np.round(rows.time / dt)})
        table[["x", "y"]] = rows.x
        wide = table.pivot(index="frame", columns="id", values=["x", "y"])
        wide = wide.reindex(np.arange(wide.index.min(), wide.index.max() + 1))
        x = np.stack([wide["x"].to_numpy(), wide["y"].to_numpy()], -1)
        there = np.isfinite(x[..., 0])
        who = np.arange(x.shape[1])
        last = len(x) - 1 - there[::-1].argmax(0)
        return cls(x, x[there.argmax(0), who], x[last, who], walls, 1 / dt)

    def cut(self, how: Convention, offset: int) -> Batch:
        """Consecutive sequences from frame ``offset`` on, of those tracked in all their frames."""
        found = []
        for number, begin in enumerate(range(offset, len(self.x) - how.samples + 1, STRIDE)):
            path = self.x[begin : begin + how.samples]
            who = np.flatnonzero(np.isfinite(path[..., 0]).all(0))
            if not len(who):
                continue
            path = path[:, who]
            before = self.x[begin - 1, who] if begin else np.full_like(path[0], np.nan)
            sequence = Sequence(
                name=f"{RECORDING}/{number:03d}",
                recording=RECORDING,
                time=(begin + np.arange(how.samples)) / self.rate,
                x=path,
                v=np.broadcast_to(self.rate * _step(how.velocity, before, path), path.shape).copy(),
                destination=self._destination(how.destination, path, who),
                walls=self.walls,
            )
            found.append(sequence)
        return collate(found)

    def _destination(self, kind: str, path: np.ndarray, who: np.ndarray) -> np.ndarray:
        if kind == "sequence":
            return path[-1]
        if kind == "trajectory":
            return self.last[who]
        ends = np.nanmin(self.x[..., 0]), np.nanmax(self.x[..., 0])
        to_right = self.last[who, 0] > self.first[who, 0]
        return np.stack([np.where(to_right, ends[1], ends[0]), path[0, :, 1]], -1)


def _step(velocity: str, before: np.ndarray, path: np.ndarray) -> np.ndarray:
    """``(N, 2)`` way in one frame at the first sample, m; forward for who was not there before."""
    ahead = path[1] - path[0]
    behind = np.where(np.isnan(before), ahead, path[0] - before)
    return {
        "forward": ahead,
        "central": (ahead + behind) / 2,
        "backward": behind,
        "mean": (path[-1] - path[0]) / (len(path) - 1),
        "none": np.zeros_like(ahead),
    }[velocity]


def recording_file(source: str | None, download: str) -> str:
    """Path of the paper's recording, downloaded where it is missing."""
    options = JuelichOptions(recording=RECORDING, source=source, download=download)
    return str(juelich_files(options)[RECORDING].absolute())


# -- tasks -----------------------------------------------------------------------------------


def scan(path: str, how: dict[str, Any], cuts: int, seed: int) -> Result:
    """Mean costs of a sequence without the time step, m², in one convention.

    Args:
        path: of the recording.
        how: a :class:`Convention`.
        cuts: so many first frames, equally spaced over a second.
        seed: of the random start of the social force.

    Returns:
        ``offsets``, and of each ``printed``, the cost with the printed parameters, and
        ``people``, their mean number; where cutting begins with the first frame also
        ``relaxation``, without any interaction, and ``sf``, calibrated, with its ``row``: NaN
        where everyone starts at rest, and so stays there.
    """
    tracks, convention = Tracks.of(path), Convention(**how)
    offsets = sorted({STRIDE * cut // cuts for cut in range(cuts)})
    found: Result = {"offsets": offsets, "printed": [], "people": []}
    for offset in offsets:
        batch = tracks.cut(convention, offset)
        found["printed"].append(_mean("sf", list(PARAMETERS.values()), batch))
        found["people"].append(float(batch.agent.sum(1).double().mean()))
    batch = tracks.cut(convention, 0)
    found |= {"relaxation": _mean("sf", [0.0, 0.0, 0.0], batch), "sf": float("nan"), "row": []}
    if convention.velocity != "none":
        row = calibrate("sf", batch, row_of(new_system("sf", seed))).row
        found |= {"sf": _mean("sf", row, batch), "row": row.tolist()}
    return found


def network(path: str, how: dict[str, Any], model: str, seed: int, steps: int) -> Result:
    """Networks calibrated in one convention, cut from the first frame, from one random start.

    Args:
        model: ``nn``, or ``nn_self`` with the summand j = i.
        steps: see :func:`studies.crowd.fit.calibrate`.
    """
    batch = Tracks.of(path).cut(Convention(**how), 0)
    fit = calibrate(model, batch, row_of(new_system(model, seed)), steps=steps)
    return {"J": _mean(model, fit.row, batch), "row": fit.row.tolist()}


def _mean(model: str, row: Any, batch: Batch) -> float:
    return float(costs(model, row, batch).mean()) / batch.dt


def key(how: Convention) -> str:
    """Of the task that scans a convention."""
    return f"convention-{how.velocity}-{how.samples}-{how.destination}"


def arguments(path: str, how: Convention) -> dict[str, Any]:
    """What both tasks are told."""
    return {"path": path, "how": asdict(how)}
