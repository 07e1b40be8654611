"""Sampled motion of a run's model, and its scores: ``scripts/simulate.py``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table

from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.saved import merge_saved
from nnode.app.evaluate import choose
from nnode.app.export import checkpoint_of
from nnode.app.training import set_threads
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.data.clusters import clusters
from nnode.data.options import DataOptions
from nnode.data.prepare import open_data
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.store import Store
from nnode.errors import ConfigError
from nnode.exchange.trajectories import write_parquet
from nnode.files import write_json
from nnode.generate.fit import FittedNoise, fit_noise
from nnode.generate.noise import Noise, behind_measured, constant_speed, numbered, sample
from nnode.generate.scores import BANDS, LEAST, Scores, band
from nnode.models import Traffic
from nnode.study.statistics import paired

#: At most so many training sequences, drawn by the seed, tell the noise.
FITTED = 200
#: At most so many vehicles, samples counted, move at once.
_AT_ONCE = 4000
#: Sequences in the picture.
_SHOWN = 6


def simulate(config: DictConfig, folder: Path) -> None:
    """Fit the noise, sample, score, and write ``scores.json``, ``bands.png`` and the samples.

    Raises:
        NNodeError: no such run or data, a model of people, too few samples.
    """
    if config.samples < LEAST:
        raise ConfigError(
            f"samples={config.samples}: a band of 95 % needs at least {LEAST}; take samples=99"
        )
    checkpoint = load_checkpoint(checkpoint_of(config.run))
    config = with_prepared(merge_saved(config, checkpoint.config, ("data", "solver")))
    model = behind_measured(checkpoint.build())
    data: DataOptions = OmegaConf.to_object(config.data)  # type: ignore[assignment]
    set_threads(checkpoint.config["trainer"]["threads"], data.domain)
    store = open_data(data, folder / "data")
    part, indices, trained = choose(store, checkpoint, config.part)
    label = clusters(store.index)
    steps = {"dt": config.solver.get("dt"), "method": config.solver.get("method")}
    open_ = _some(choose(store, checkpoint, "train")[1], int(config.seed))
    batches = [batch for batch, _ in _batches(store, open_, 1)]
    name = str(checkpoint.config["model"]["name"])
    models = {name: model, "constant_speed": constant_speed()}
    fitted: dict[str, FittedNoise] = {}
    for key, system in models.items():
        own = steps if key == name else {}
        fitted[key] = fit_noise(system, batches, label[open_], seed=int(config.seed), **own)
        print(f"noise of {key}: {_told(fitted[key], system.order)}")
    ways: dict[str, tuple[Traffic, Noise, dict[str, Any]]] = {
        name: (model, fitted[name].noise, steps),
        f"{name}, no noise": (model, Noise(0.0, 1.0), steps),
        "constant_speed": (models["constant_speed"], fitted["constant_speed"].noise, {}),
    }
    job = _Sampling(store, indices, int(config.samples), int(config.seed))
    scores = {key: job.scored(*way) for key, way in ways.items()}
    own_label = label[indices]
    means = {key: score.means(own_label) for key, score in scores.items()}
    first = scores[name].sequence_means()
    _, numbers = np.unique(own_label, return_inverse=True)
    write_json(
        folder / "scores.json",
        {
            "run": str(config.run), "model": name, "data": data.name, "part": part,
            "trained_on": trained, "sequences": len(indices), "clusters": int(numbers.max()) + 1,
            "samples": int(config.samples), "seed": int(config.seed),
            "noise": {key: asdict(one) for key, one in fitted.items()},
            "scores": {key: {k: asdict(m) for k, m in one.items()} for key, one in means.items()},
            "crps_position_minus": {
                key: asdict(paired(first, score.sequence_means(), numbers, 0))
                for key, score in scores.items() if key != name
            },
        },
    )  # fmt: skip
    _print(means, f"{data.name}, {part}: {len(indices)} sequences, {config.samples} samples")
    _picture(job, ways[name], folder / "bands.png")
    if config.table:
        path = write_parquet(folder / "samples.parquet", job.sampled(*ways[name]), model.dim)
        print(f"samples: {path}")
    print(f"bands: {folder / 'bands.png'}")
    print(f"scores: {folder / 'scores.json'}")


class _Sampling:
    """The sequences that are sampled.

    Args:
        indices: their places in the store.
        samples: S.
    """

    def __init__(self, store: Store, indices: list[int], samples: int, seed: int) -> None:
        self.store, self.indices, self.samples, self.seed = store, indices, samples, seed

    def moved(
        self, system: Traffic, noise: Noise, steps: dict[str, Any], indices: list[int] | None = None
    ) -> Iterator[tuple[Sequence, np.ndarray, np.ndarray | None]]:
        """Every sequence with places and speeds ``(S, K, N, 1)``; without noise those of one
        sample, repeated where no drivers are drawn."""
        places = self.indices if indices is None else indices
        for i, (batch, sequences) in enumerate(_batches(self.store, places, self.samples)):
            found = sample(system, batch, noise, self.samples, seed=(self.seed, i), **steps)
            apart = (self.samples, len(batch))
            x = found.x.unflatten(1, apart).numpy()
            v = None if found.v is None else found.v.unflatten(1, apart).numpy()
            for b, s in enumerate(sequences):
                part = (slice(s.n_samples), slice(None), b, slice(s.n_agents))
                own = None if v is None else v[part].swapaxes(0, 1)
                yield s, x[part].swapaxes(0, 1), own

    def scored(self, system: Traffic, noise: Noise, steps: dict[str, Any]) -> Scores:
        rng = np.random.default_rng(self.seed)
        found = Scores(self.store[self.indices[0]].dt)
        for s, x, _ in self.moved(system, noise, steps):
            error = noise.measurement**0.5 * rng.normal(size=x.shape[:-1])
            found.add(s.name, x[..., 0], s.x[..., 0], error)
        return found

    def sampled(self, system: Traffic, noise: Noise, steps: dict[str, Any]) -> Iterator[Sequence]:
        """Sequences ``NAME~1``, ``NAME~2``, ... of each."""
        for s, x, v in self.moved(system, noise, steps):
            for i, name in enumerate(numbered((s.name,), self.samples)):
                yield replace(s, name=name, x=x[i], v=None if v is None else v[i])


def _batches(
    store: Store, indices: list[int], samples: int
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


def _some(indices: list[int], seed: int) -> list[int]:
    """At most :data:`FITTED` of them."""
    if len(indices) <= FITTED:
        return indices
    return sorted(np.random.default_rng(seed).choice(indices, FITTED, replace=False).tolist())


def _told(fitted: FittedNoise, order: int) -> str:
    noise, unit = fitted.noise, "m/s" if order == 1 else "m/s²"

    def interval(ends: tuple[float, float] | None) -> str:
        return "" if ends is None else f" [{ends[0]:.3g}, {ends[1]:.3g}]"

    drivers = ""
    if noise.drivers:
        what = "pace" if order == 1 else "time gap"
        drivers = f"; drivers' {what} ± {100 * noise.drivers:.3g} %"
    return (
        f"{noise.sigma:.3g} {unit}{interval(fitted.sigma)} for {noise.tau:.3g} s"
        f"{interval(fitted.tau)}; measured places ± {noise.measurement**0.5:.2g} m{drivers}"
    )


def _print(means: dict[str, dict[str, Any]], title: str) -> None:
    table = Table(title=title)
    table.add_column("")
    columns = ["crps_position_m", "crps_gap_m"]
    columns += [f"coverage_position_{100 * level:g}" for level in BANDS]
    for head in ("CRPS place (m)", "CRPS gap (m)", *(f"in {100 * p:g} % band" for p in BANDS)):
        table.add_column(head, justify="right")
    for key, own in means.items():
        table.add_row(key, *(_cell(own[name]) for name in columns))
    Console().print(table)


def _cell(mean: Any) -> str:
    ends = "" if mean.low is None else f" [{mean.low:.3g}, {mean.high:.3g}]"
    return f"{mean.mean:.3g}{ends}"


def _picture(job: _Sampling, way: tuple[Traffic, Noise, dict[str, Any]], path: Path) -> None:
    from nnode.plots.bands import Bands, band_panels  # loads Matplotlib, which takes a second
    from nnode.plots.style import save

    chosen = job.indices[:: max(1, len(job.indices) // _SHOWN)][:_SHOWN]
    shown = []
    for s, x, _ in job.moved(*way, chosen):
        gap = x[:, :, -1, 0] - x[:, :, -2, 0]
        shown.append(
            Bands(
                name=s.name,
                time=s.time - s.time[0],
                measured=s.x[:, -1, 0] - s.x[:, -2, 0],
                median=np.median(gap, axis=0),
                bands={level: band(gap, level) for level in BANDS},
            )
        )
    save(band_panels(shown), path)
