"""Sampled motion of measured sequences and its scores as an object."""

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

#: Largest number of agents, counted per sample, that are simulated at once.
_AT_ONCE = 4000
#: Number of sequences in the figure.
_SHOWN = 6


@dataclass(frozen=True)
class SampledModel:
    """A model, its noise, and ``dt`` and ``method`` of its steps."""

    system: System
    noise: Noise
    steps: dict[str, Any]


@dataclass(frozen=True)
class Sampling:
    """The sampled sequences.

    Attributes:
        store: store of sequences.
        indices: indices of the sampled sequences.
        samples: S, the number of samples of each sequence.
        seed: seed of all random numbers; repeated calls give the same samples.
    """

    store: Source
    indices: list[int]
    samples: int
    seed: int

    def moved(
        self, sampled_model: SampledModel, indices: list[int] | None = None
    ) -> Iterator[tuple[Sequence, np.ndarray, np.ndarray | None]]:
        """Every sequence with sampled positions and speeds ``(S, K, N, D)``, m and m/s."""
        places = self.indices if indices is None else indices
        for i, (batch, sequences) in enumerate(batches(self.store, places, self.samples)):
            trajectory = sample(
                sampled_model.system,
                batch,
                sampled_model.noise,
                self.samples,
                seed=(self.seed, i),
                **sampled_model.steps,
            )
            apart = (self.samples, len(batch))
            x = trajectory.x.unflatten(1, apart).numpy()
            v = None if trajectory.v is None else trajectory.v.unflatten(1, apart).numpy()
            for b, s in enumerate(sequences):
                part = (slice(s.n_samples), slice(None), b, slice(s.n_agents))
                speeds = None if v is None else v[part].swapaxes(0, 1)
                yield s, x[part].swapaxes(0, 1), speeds

    def scored(self, sampled_model: SampledModel) -> Scores:
        """Scores of a sampled model on all sequences."""
        rng = np.random.default_rng(self.seed)
        scores = Scores(self.store[self.indices[0]].dt)
        for s, x, _ in self.moved(sampled_model):
            error = sampled_model.noise.measurement**0.5 * rng.normal(size=x.shape)
            scores.add(s.name, x, s.x, error)
        return scores

    def sampled(self, sampled_model: SampledModel) -> Iterator[Sequence]:
        """The samples ``NAME~1``, ``NAME~2``, ... of each sequence."""
        for s, x, v in self.moved(sampled_model):
            if s.x.shape[2] > 1 and s.destination is None:  # the simulation's destination
                s = replace(s, destination=s.x[-1])
            for i, name in enumerate(numbered((s.name,), self.samples)):
                yield replace(s, name=name, x=x[i], v=None if v is None else v[i])


@dataclass(frozen=True, repr=False)
class Simulated:
    """Motion sampled from a calibrated model, scored on measurements.

    Attributes:
        run: folder or checkpoint of the model; empty without one.
        model: name of the model.
        data, part: the sampled data and their part.
        trained_on: number of the sampled sequences in the model's calibration; None if unknown.
        clusters: number of clusters.
        noise: noise of the model and of ``constant_speed``, with intervals and moments.
        means: model to score to its mean and 95 % interval. Scores are ``crps_position_m``,
            ``crps_gap_m`` (for people ``crps_nearest_m``, of the distance to the nearest person),
            ``coverage_position_50``, ..., and ``SCORE@10s``, the score 10 s after the start.
        minus: the model's CRPS of positions minus that of another model, m, paired by sequence.
        sampling: the sampled sequences.
        sampled_model: the calibrated model with its noise.
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
    sampled_model: SampledModel

    @property
    def crps(self) -> Mean:
        """CRPS of the model's positions, m."""
        return self.means[self.model]["crps_position_m"]

    @property
    def coverage(self) -> dict[float, Mean]:
        """Level of a band (0.5, 0.95) to the share of measured positions in it."""
        means = self.means[self.model]
        return {level: means[f"coverage_position_{100 * level:g}"] for level in BANDS}

    @property
    def scores(self) -> pd.DataFrame:
        """A row per model and score with ``mean``, ``low`` and ``high``."""
        rows = {
            (m, k): asdict(mean)
            for m, by_score in self.means.items()
            for k, mean in by_score.items()
        }
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis(["model", "score"])

    @cached_property
    def trajectories(self) -> Sequences:
        """The scored samples, ``NAME~1``, ``NAME~2``, ... of each sequence."""
        return Sequences(self.sampling.sampled(self.sampled_model))

    def to_dataframe(self) -> pd.DataFrame:
        """The samples as a tidy table, one row per sequence, time and agent, m, s and m/s."""
        return self.trajectories.to_dataframe()

    def plot(self) -> Figure:
        """Measured values and bands of the samples for six sequences: gaps of vehicles, or the
        distance of people ahead of their measured positions."""
        from nnode.plots.bands import Bands, band_panels  # loads Matplotlib, which takes a second

        indices = self.sampling.indices
        chosen = indices[:: max(1, len(indices) // _SHOWN)][:_SHOWN]
        shown = []
        for s, x, _ in self.sampling.moved(self.sampled_model, chosen):
            if s.x.shape[2] == 1:
                measured, gap = s.x[:, -1, 0] - s.x[:, -2, 0], x[:, :, -1, 0] - x[:, :, -2, 0]
            else:  # along the path of the first person
                direction = s.x[-1, 0] - s.x[0, 0]
                gap = (x[:, :, 0] - s.x[:, 0]) @ (
                    direction / max(float(np.linalg.norm(direction)), 1e-9)
                )
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
        crowd = self.sampled_model.system.domain == "crowd"
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
            "noise": {key: asdict(entry) for key, entry in self.noise.items()},
            "scores": {
                k: {n: asdict(m) for n, m in by_score.items()} for k, by_score in self.means.items()
            },
            "crps_position_minus": {key: asdict(entry) for key, entry in self.minus.items()},
        }

    def write(self, folder: str | Path, *, format: str | None = "parquet") -> list[Path]:
        """Write ``scores.json``, ``bands.png`` and the samples, see ``docs/sampling.md``.

        Args:
            folder: folder, created if it is missing.
            format: format of the samples, ``parquet`` or ``csv`` (for people with ``walls.csv``, if
                all sequences have the same walls), ``pedpy`` (people) or ``fcd`` (vehicles); None
                writes no samples.

        Raises:
            ConfigError: the format is unknown, or does not support the model's domain.
        """
        from nnode.plots.style import save

        system = self.sampled_model.system
        if format is not None:
            check_format("format", format, system.domain)
        place = Path(folder)
        place.mkdir(parents=True, exist_ok=True)
        paths = [place / "scores.json", place / "bands.png"]
        write_json(paths[0], self.plain())
        save(self.plot(), paths[1])
        if format is not None:
            samples = self.sampling.sampled(self.sampled_model)
            paths += write_trajectories(place, "samples", format, samples, system.dim)
        if format in ("parquet", "csv"):
            measured = (self.sampling.store[i] for i in self.sampling.indices)
            walls, _ = write_walls(place / "walls.csv", measured)
            paths += [] if walls is None else [walls]
        return paths

    def _head(self) -> list[str]:
        noise = [
            _noise_text(name, fitted, self.sampled_model.system)
            for name, fitted in self.noise.items()
        ]
        job = self.sampling
        number = f"{len(job.indices)} sequences, {job.samples} samples"
        return [*noise, f"{self.data}, {self.part}: {number}"]

    def _table(self) -> pd.DataFrame:
        heads = {"crps_position_m": "CRPS place (m)"}
        crowd = self.sampled_model.system.domain == "crowd"
        heads |= {"crps_nearest_m": "CRPS nearest (m)"} if crowd else {"crps_gap_m": "CRPS gap (m)"}
        heads |= {f"coverage_position_{100 * p:g}": f"in {100 * p:g} % band" for p in BANDS}
        rows = {
            model: {head: _cell(by_score[name]) for name, head in heads.items() if name in by_score}
            for model, by_score in self.means.items()
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
    """Sequences in batches that limit the number of agents with all their samples."""
    group: list[Sequence] = []
    for s in (store[i] for i in indices):
        widest = max(sequence.n_agents for sequence in [*group, s])
        if group and (len(group) + 1) * widest * samples > _AT_ONCE:
            yield collate(group), group
            group = []
        group.append(s)
    yield collate(group), group


def _noise_text(name: str, fitted: FittedNoise, system: System) -> str:
    noise = fitted.noise
    order = 2 if name == "constant_speed" else system.order
    unit = "m/s" if order == 1 else "m/s²"

    def interval(ends: tuple[float, float] | None) -> str:
        return "" if ends is None else f" [{ends[0]:.3g}, {ends[1]:.3g}]"

    drivers = ""
    if noise.drivers:
        what = "drivers' pace" if order == 1 else "drivers' time gap"
        what = "preferred speeds" if system.domain == "crowd" else what
        drivers = f"; {what} ± {100 * noise.drivers:.3g} %"
    if noise.parameters:
        parts = [f"{name} ± {100 * size:.3g} %" for name, size in noise.parameters.items()]
        drivers = f"; between drivers {', '.join(parts)}"
    return (
        f"noise of {name}: {noise.sigma:.3g} {unit}{interval(fitted.sigma)} for {noise.tau:.3g} s"
        f"{interval(fitted.tau)}; measured places ± {noise.measurement**0.5:.2g} m{drivers}"
    )


def _cell(mean: Mean) -> str:
    ends = "" if mean.low is None else f" [{mean.low:.3g}, {mean.high:.3g}]"
    return f"{mean.mean:.3g}{ends}"
