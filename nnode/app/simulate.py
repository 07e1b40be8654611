"""Motion sampled from a run's model, and its scores: ``nnode simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from nnode.app.calibration import Calibration
from nnode.app.cli.saved import load_run
from nnode.app.drivers import law_parameters, variances_of
from nnode.app.python.inputs import Table
from nnode.app.saved_run import SavedRun, choose, drivers_of
from nnode.app.training import threads_given_back
from nnode.calibrate.resampling import paired
from nnode.data.clusters import clusters
from nnode.data.sequences import Sequences
from nnode.errors import ConfigError
from nnode.exchange.trajectories import check_format
from nnode.generate.fit import FittedNoise, fit_noise
from nnode.generate.noise import Noise, constant_speed, free_running
from nnode.generate.scores import LEAST
from nnode.generate.simulated import SampledModel, Sampling, Simulated, batches
from nnode.model import System

#: Largest number of randomly drawn training sequences for the fit of the noise.
FITTED = 200


@threads_given_back()
def simulate_run(
    run: str | Path | Calibration,
    data: Table | Sequences | None = None,
    *,
    samples: int = 99,
    part: str = "auto",
    seed: int = 0,
) -> Simulated:
    """Sample the motion of vehicles or people from a calibrated model, and score it.

    Where the run estimated differences between drivers, drivers and disturbances are drawn from
    them. Otherwise the noise is fitted to the sequences that the model was calibrated to; see
    ``docs/sampling.md``.

    Args:
        run: folder of a training or of a diagnosis, a checkpoint, or the result of
            :func:`nnode.fit`.
        data: the data of the run's calibration, if they were a table in memory; None reads the
            run's files.
        samples: number of samples of every sequence, at least 39.
        part: part of the data, ``heldout``, ``train``, ``unseen``, ``all``; ``auto`` is the first
            that exists, except train.
        seed: seed of all random numbers.

    Raises:
        CheckpointError: the run does not exist.
        ConfigError: too few samples, or an unknown part.
        DataError: the data do not exist, or sequences are too short for the fit of the noise.
    """
    _check(samples)
    place = "" if isinstance(run, Calibration) else str(run)
    saved = SavedRun.of_python(run, data, part)
    return _simulated(saved, drivers_of(run), place, samples, seed)


def simulate(config: DictConfig, folder: Path) -> None:
    """The command: :func:`simulate_run` on the requested data, and its files.

    Raises:
        NNodeError: the run or the data do not exist, or there are too few samples.
    """
    _check(config.samples)
    checkpoint = load_run(config.run)
    if config.format is not None:  # checked before the long computation
        check_format("format", config.format, checkpoint.build().domain)
    run = SavedRun.of_command(checkpoint, config, folder)
    drivers, place = drivers_of(config.run), str(config.run)
    result = _simulated(run, drivers, place, int(config.samples), int(config.seed))
    print(result)
    files = result.write(folder, format=config.format)
    for path in dict.fromkeys(p.parent if p.suffix == ".txt" else p for p in reversed(files)):
        print(f"{path.name.partition('.')[0]}: {path}")


def _check(samples: int) -> None:
    if samples < LEAST:
        raise ConfigError(
            f"samples={samples}: a band of 95 % needs at least {LEAST}; take samples=99"
        )


def _simulated(run: SavedRun, drivers: Any, place: str, samples: int, seed: int) -> Simulated:
    model, name, store = free_running(run.model), run.name, run.source
    label = clusters(store.index)
    training_indices = _some(choose(store, run.checkpoint, "train")[1], seed)
    training_batches = [batch for batch, _ in batches(store, training_indices, 1)]
    solver = run.config["solver"]
    steps = {"dt": solver.get("dt"), "method": solver.get("method")}
    constant_speed_model = constant_speed(model.domain)
    estimated = _estimated_noise(model, drivers, len(set(label[training_indices])))
    noise = {
        name: estimated
        or fit_noise(model, training_batches, label[training_indices], seed=seed, **steps),
        "constant_speed": fit_noise(
            constant_speed_model, training_batches, label[training_indices], seed=seed
        ),
    }
    samplers = {
        name: SampledModel(model, noise[name].noise, steps),
        f"{name}, no noise": SampledModel(model, Noise(0.0, 1.0), steps),
        "constant_speed": SampledModel(constant_speed_model, noise["constant_speed"].noise, {}),
    }
    job = Sampling(store, run.indices, samples, seed)
    scores = {key: job.scored(sampled_model) for key, sampled_model in samplers.items()}
    _, numbers = np.unique(label[run.indices], return_inverse=True)
    first = scores[name].sequence_means()
    return Simulated(
        run=place,
        model=name,
        data=run.data,
        part=run.part,
        trained_on=run.trained,
        clusters=int(numbers.max()) + 1,
        noise=noise,
        means={key: score.means(label[run.indices]) for key, score in scores.items()},
        minus={
            key: paired(first, score.sequence_means(), numbers, 0)
            for key, score in scores.items()
            if key != name
        },
        sampling=job,
        sampled_model=samplers[name],
    )


def _estimated_noise(model: System, drivers: Any, clusters: int) -> FittedNoise | None:
    """The noise and the differences between drivers of a run; None if it did not estimate them.

    Args:
        drivers: what :meth:`nnode.app.drivers.Drivers.plain` gave. clusters: their number.
    """
    variances = variances_of(drivers)
    if variances is None:
        return None
    from nnode.population.drivers import full_names  # compiled code takes a second

    values, _ = variances
    rows = drivers["variability"]
    addresses = full_names(drivers["differ"], law_parameters(model))
    sigma, tau = (
        None if row.get("lower") is None else (row["lower"], row.get("upper", np.inf))
        for row in (rows["push"], rows["push_time"])
    )
    noise = Noise(
        values["push"],
        values["push_time"],
        values["measurement"] ** 2 + values.get("lasting_error", 0.0) ** 2,
        parameters={
            address: values[name]
            for name, address in zip(drivers["differ"], addresses, strict=True)
        },
    )
    return FittedNoise(noise, sigma, tau, None, clusters)


def _some(indices: list[int], seed: int) -> list[int]:
    """At most :data:`FITTED` of the indices, drawn at random."""
    if len(indices) <= FITTED:
        return indices
    return sorted(np.random.default_rng(seed).choice(indices, FITTED, replace=False).tolist())
