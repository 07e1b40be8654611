"""Sampled motion of measured sequences with its scores, as an object."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nnode.calibrate.resampling import Paired
from nnode.data.dataset import Source
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.sequences import Sequences
from nnode.exchange.trajectories import check_format, write_trajectories, write_walls
from nnode.files import write_json
from nnode.generate.fit import FittedNoise
from nnode.generate.noise import Noise, numbered, sample
from nnode.generate.scores import BANDS, Mean, Scores, band
from nnode.model import System

#: At most so many vehicles or people, samples counted, move at once.
_AT_ONCE = 4000
#: Sequences in the picture.
_SHOWN = 6


@dataclass(frozen=True)
class Way:
    """A way to move: a model, its noise, and ``dt`` and ``method`` of its steps."""

    system: System
    noise: Noise
    steps: dict[str, Any]


@dataclass(frozen=True)
class Sampling:
    """What is sampled.

    Attributes:
        store: of sequences.
        indices: of those that are sampled.
        samples: S, of each.
        seed: of all draws: the same ones come again.
    """

    store: Source
    indices: list[int]
    samples: int
    seed: int

    def moved(
        self, way: Way, indices: list[int] | None = None
    ) -> Iterator[tuple[Sequence, np.ndarray, np.ndarray | None]]:
        """Every sequence with places and speeds ``(S, K, N, D)``, m and m/s."""
        places = self.indices if indices is None else indices
        for i, (batch, sequences) in enumerate(batches(self.store, places, self.samples)):
            found = sample(
                way.system, batch, way.noise, self.samples, seed=(self.seed, i), **way.steps
            )
            apart = (self.samples, len(batch))
            x = found.x.unflatten(1, apart).numpy()
            v = None if found.v is None else found.v.unflatten(1, apart).numpy()
            for b, s in enumerate(sequences):
                part = (slice(s.n_samples), slice(None), b, slice(s.n_agents))
                own = None if v is None else v[part].swapaxes(0, 1)
                yield s, x[part].swapaxes(0, 1), own

    def scored(self, way: Way) -> Scores:
        """Scores, sequence by sequence."""
        rng = np.random.default_rng(self.seed)
        found = Scores(self.store[self.indices[0]].dt)
        for s, x, _ in self.moved(way):
            error = way.noise.measurement**0.5 * rng.normal(size=x.shape)
            found.add(s.name, x, s.x, error)
        return found

    def sampled(self, way: Way) -> Iterator[Sequence]:
        """Sequences ``NAME~1``, ``NAME~2``, ... of each."""
        for s, x, v in self.moved(way):
            if s.x.shape[2] > 1 and s.destination is None:  # what the simulation was told
                s = replace(s, destination=s.x[-1])
            for i, name in enumerate(numbered((s.name,), self.samples)):
                yield replace(s, name=name, x=x[i], v=None if v is None else v[i])


@dataclass(frozen=True, repr=False)
class Simulated:
    """Motion sampled from a calibrated model, scored on what was measured.

    Attributes:
        run: folder or checkpoint that the model is of; empty where it is of none.
        model: its name.
        data, part: what is sampled; trained_on: sequences of it that the model was calibrated to,
            None where that cannot be told.
        clusters: their number.
        noise: of the model and of ``constant_speed``, with intervals and moments.
        means: by model, by score: mean and 95 % interval. Scores are ``crps_position_m``,
            ``crps_gap_m`` (of people ``crps_nearest_m``, of how far the nearest other is),
            ``coverage_position_50``, ..., and ``SCORE@10s`` that 10 s after the start.
        minus: the model's CRPS of places minus another one's, m, by sequence.
        sampling: what is sampled.
        way: how the model itself moves.
    """

    run: str
    model: str
    data: str
    part: str
    trained_on: int | None
    clusters: int
    noise: dict[str, FittedNoise]
    means: dict[str, dict[str, Mean]]
    minus: dict[str, Paired]
    sampling: Sampling
    way: Way

    @property
    def crps(self) -> Mean:
        """CRPS of the model's places, m."""
        return self.means[self.model]["crps_position_m"]

    @property
    def coverage(self) -> dict[float, Mean]:
        """Band (0.5, 0.95) to the share of measured places that it holds."""
        own = self.means[self.model]
        return {level: own[f"coverage_position_{100 * level:g}"] for level in BANDS}

    @property
    def scores(self) -> pd.DataFrame:
        """``mean``, ``low``, ``high``, with a row per model and score."""
        rows = {(m, k): asdict(mean) for m, own in self.means.items() for k, mean in own.items()}
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis(["model", "score"])

    @cached_property
    def trajectories(self) -> Sequences:
        """The samples, sequences ``NAME~1``, ``NAME~2``, ... of each; those that were scored."""
        return Sequences(self.sampling.sampled(self.way))

    def to_dataframe(self) -> pd.DataFrame:
        """The samples as a tidy table, one row per sequence, time and agent, m, s and m/s."""
        return self.trajectories.to_dataframe()

    def plot(self) -> Figure:
        """Gaps of six sequences, or how far ahead of their measured places people are: measured,
        and bands of the samples."""
        from nnode.plots.bands import Bands, band_panels  # loads Matplotlib, which takes a second

        indices = self.sampling.indices
        chosen = indices[:: max(1, len(indices) // _SHOWN)][:_SHOWN]
        shown = []
        for s, x, _ in self.sampling.moved(self.way, chosen):
            if s.x.shape[2] == 1:
                measured, gap = s.x[:, -1, 0] - s.x[:, -2, 0], x[:, :, -1, 0] - x[:, :, -2, 0]
            else:  # along the way of the first person
                way = s.x[-1, 0] - s.x[0, 0]
                gap = (x[:, :, 0] - s.x[:, 0]) @ (way / max(float(np.linalg.norm(way)), 1e-9))
                measured = np.zeros(s.n_samples)
            shown.append(
                Bands(
                    name=s.name,
                    time=s.time - s.time[0],
                    measured=measured,
                    median=np.median(gap, axis=0),
                    bands={level: band(gap, level) for level in BANDS},
                )
            )
        crowd = self.way.system.domain == "crowd"
        return band_panels(shown, "ahead (m)" if crowd else "gap (m)")

    def plain(self) -> dict[str, Any]:
        """The content of ``scores.json``."""
        job = self.sampling
        return {
            "run": self.run,
            "model": self.model,
            "data": self.data,
            "part": self.part,
            "trained_on": self.trained_on,
            "sequences": len(job.indices),
            "clusters": self.clusters,
            "samples": job.samples,
            "seed": job.seed,
            "noise": {key: asdict(one) for key, one in self.noise.items()},
            "scores": {k: {n: asdict(m) for n, m in own.items()} for k, own in self.means.items()},
            "crps_position_minus": {key: asdict(one) for key, one in self.minus.items()},
        }

    def write(self, folder: str | Path, *, format: str | None = "parquet") -> list[Path]:
        """Write ``scores.json``, ``bands.png`` and the samples, see ``docs/sampling.md``.

        Args:
            folder: made where it is missing.
            format: of the samples, ``parquet`` or ``csv`` (with ``walls.csv`` of people, where all
                sequences have the same ones), ``pedpy`` (people) or ``fcd`` (vehicles); None: no
                samples.

        Raises:
            ConfigError: no such format, or one that is not for the model's vehicles or people.
        """
        from nnode.plots.style import save

        system = self.way.system
        if format is not None:
            check_format("format", format, system.domain)
        place = Path(folder)
        place.mkdir(parents=True, exist_ok=True)
        paths = [place / "scores.json", place / "bands.png"]
        write_json(paths[0], self.plain())
        save(self.plot(), paths[1])
        if format is not None:
            samples = self.sampling.sampled(self.way)
            paths += write_trajectories(place, "samples", format, samples, system.dim)
        if format in ("parquet", "csv"):
            measured = (self.sampling.store[i] for i in self.sampling.indices)
            walls, _ = write_walls(place / "walls.csv", measured)
            paths += [] if walls is None else [walls]
        return paths

    def _head(self) -> list[str]:
        noise = [_told(name, one, self.way.system) for name, one in self.noise.items()]
        job = self.sampling
        number = f"{len(job.indices)} sequences, {job.samples} samples"
        return [*noise, f"{self.data}, {self.part}: {number}"]

    def _table(self) -> pd.DataFrame:
        heads = {"crps_position_m": "CRPS place (m)"}
        crowd = self.way.system.domain == "crowd"
        heads |= {"crps_nearest_m": "CRPS nearest (m)"} if crowd else {"crps_gap_m": "CRPS gap (m)"}
        heads |= {f"coverage_position_{100 * p:g}": f"in {100 * p:g} % band" for p in BANDS}
        rows = {
            model: {head: _cell(own[name]) for name, head in heads.items() if name in own}
            for model, own in self.means.items()
        }
        return pd.DataFrame.from_dict(rows, orient="index")

    def __repr__(self) -> str:
        return "\n".join([*self._head(), self._table().to_string()])

    def _repr_html_(self) -> str:
        words = "<br>".join(map(escape, self._head()))
        return f"<p>{words}</p>{self._table().to_html(border=0)}"


def batches(
    store: Source, indices: list[int], samples: int
) -> Iterator[tuple[Batch, list[Sequence]]]:
    """Sequences in batches of at most so many vehicles with all their samples."""
    group: list[Sequence] = []
    for s in (store[i] for i in indices):
        widest = max(one.n_agents for one in [*group, s])
        if group and (len(group) + 1) * widest * samples > _AT_ONCE:
            yield collate(group), group
            group = []
        group.append(s)
    yield collate(group), group


def _told(name: str, fitted: FittedNoise, system: System) -> str:
    noise = fitted.noise
    order = 2 if name == "constant_speed" else system.order  # whatever the model's own
    unit = "m/s" if order == 1 else "m/s²"

    def interval(ends: tuple[float, float] | None) -> str:
        return "" if ends is None else f" [{ends[0]:.3g}, {ends[1]:.3g}]"

    drivers = ""
    if noise.drivers:
        what = "drivers' pace" if order == 1 else "drivers' time gap"
        what = "preferred speeds" if system.domain == "crowd" else what
        drivers = f"; {what} ± {100 * noise.drivers:.3g} %"
    return (
        f"noise of {name}: {noise.sigma:.3g} {unit}{interval(fitted.sigma)} for {noise.tau:.3g} s"
        f"{interval(fitted.tau)}; measured places ± {noise.measurement**0.5:.2g} m{drivers}"
    )


def _cell(mean: Mean) -> str:
    ends = "" if mean.low is None else f" [{mean.low:.3g}, {mean.high:.3g}]"
    return f"{mean.mean:.3g}{ends}"
