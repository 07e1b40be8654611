"""Followers predicted from the first seconds of their paths: ``nnode predict``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from omegaconf import DictConfig
from scipy.special import ndtri

from nnode.app.calibration import Calibration
from nnode.app.cli.saved import load_run
from nnode.app.drivers import variances_of
from nnode.app.python.inputs import Table
from nnode.app.saved_run import SavedRun, drivers_of
from nnode.app.training import threads_given_back
from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.resampling import Paired, paired
from nnode.data.clusters import clusters
from nnode.data.sequences import Sequences
from nnode.errors import ConfigError
from nnode.files import write_csv, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Shortest known beginning, s. With 1 s, the linearisation failed for one of 96 simulated drivers,
#: whose error reached 13 standard deviations of its band; with 2 s, the largest was 3.3.
SHORTEST = 2.0
#: Level of the bands.
LEVEL = 0.95
#: Number of followers in the figure.
SHOWN = 6


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """Followers predicted from the first seconds of their paths.

    Attributes:
        table: a row per follower and sample: ``sequence``, ``agent``, ``time`` (s after the start),
            ``given`` (whether the prediction uses the sample), ``ahead``, the measured position of
            the vehicle ahead (m); ``measured``, ``predicted`` and ``typical`` positions (m), where
            ``typical`` is the prediction with the parameters of the typical driver; ``low`` and
            ``high`` (m), the ends of the 95 % band of the measured position.
        seconds: length of the known beginning.
        rmse, rmse_typical: root mean square errors of predicted positions, m.
        covered: share of measured positions in the band.
        difference: of mean square errors (m²), prediction minus typical driver, with its interval
            by clusters.
    """

    table: pd.DataFrame
    seconds: float
    rmse: float
    rmse_typical: float
    covered: float
    difference: Paired

    def plain(self) -> dict[str, Any]:
        """The content of ``prediction.json``."""
        return {
            "seconds": self.seconds,
            "followers": self._number,
            "rmse": self.rmse,
            "rmse_typical": self.rmse_typical,
            "covered": self.covered,
            "level": LEVEL,
            "mse_minus_typical": asdict(self.difference),
        }

    @property
    def _number(self) -> int:
        return len(self.table.groupby(["sequence", "agent"]))

    def __repr__(self) -> str:
        d = self.difference
        return (
            f"{self._number} followers predicted from their first {self.seconds:g} s: RMSE "
            f"{self.rmse:.3g} m, {self.rmse_typical:.3g} m with the typical driver's parameters "
            f"(mean square error {d.difference:+.3g} m² [{d.low:.3g}, {d.high:.3g}]); "
            f"{self.covered:.0%} of measured positions in the band of {LEVEL:.0%}"
        )

    def plot(self) -> Figure:
        """Measured and predicted gaps of six followers, with bands."""
        from nnode.plots.bands import Bands, band_panels  # loads Matplotlib, which takes a second

        groups = list(self.table.groupby(["sequence", "agent"], sort=False))
        shown = []
        for (sequence, _), rows in groups[:: max(1, len(groups) // SHOWN)][:SHOWN]:
            gap = {
                key: (rows["ahead"] - rows[key]).to_numpy()
                for key in ("measured", "predicted", "low", "high")
            }
            shown.append(
                Bands(
                    name=str(sequence),
                    time=rows["time"].to_numpy(),
                    measured=gap["measured"],
                    median=gap["predicted"],
                    bands={LEVEL: (gap["high"], gap["low"])},
                )
            )
        return band_panels(shown, median="predicted", band="band", begins=self.seconds)

    def write(self, folder: Path) -> list[Path]:
        """Write ``prediction.csv``, ``prediction.json`` and ``prediction.png``."""
        from nnode.plots.style import save

        table, scores = folder / "prediction.csv", folder / "prediction.json"
        write_csv(table, self.table)
        write_json(scores, self.plain())
        return [save(self.plot(), folder / "prediction.png"), table, scores]


@threads_given_back()
def predict_run(
    run: str | Path | Calibration,
    data: Table | Sequences | None = None,
    *,
    seconds: float = 3.0,
    part: str = "auto",
) -> Predictions:
    """Predict followers of a lane from the first seconds of their paths.

    A driver's parameters are estimated from these seconds, given the differences between drivers
    that the run found; see ``docs/method.md``. Vehicles ahead move as measured.

    Args:
        run: folder of a training with drivers who differ, a checkpoint, or the result of
            :func:`nnode.fit`.
        data: other data; None takes those of the run.
        seconds: length of the known beginning, at least 2.
        part: part of the data, ``heldout``, ``train``, ``unseen``, ``all``; ``auto`` is the first
            that exists, except train.

    Raises:
        CheckpointError: the run does not exist.
        ConfigError: the run has no differences between drivers, the beginning is too short, or no
            sequence is longer.
    """
    return _predicted(SavedRun.of_python(run, data, part), *_variances(run), seconds)


def predict(config: DictConfig, folder: Path) -> None:
    """The command: :func:`predict_run` on the requested data, and its files.

    Raises:
        NNodeError: see :func:`predict_run`.
    """
    variances = _variances(config.run)
    run = SavedRun.of_command(load_run(config.run), config, folder)
    predictions = _predicted(run, *variances, float(config.seconds))
    print(predictions)
    for path in predictions.write(folder):
        print(f"{'plot' if path.suffix == '.png' else path.name.partition('.')[0]}: {path}")


def _variances(run: str | Path | Calibration) -> tuple[dict[str, float], float]:
    """See :func:`nnode.app.drivers.variances_of`."""
    variances = variances_of(drivers_of(run))
    if variances is None:
        raise ConfigError(
            "the run has no differences between drivers, from which a driver's parameters are "
            "predicted; train with trainer.drivers=auto, in Python nnode.fit(..., drivers='auto')"
        )
    return variances


def _predicted(
    run: SavedRun, variances: Mapping[str, float], apart: float, seconds: float
) -> Predictions:
    from nnode.population.drivers import STEP, obstacle  # compiled code takes a second
    from nnode.population.followers import longest_step, paths_of
    from nnode.population.likelihood import NOISE
    from nnode.population.prediction import predict as predict_paths

    if not SHORTEST <= seconds < np.inf:
        raise ConfigError(
            f"seconds={seconds:g}: expected at least {SHORTEST:g} s, as bands after shorter "
            "beginnings are too narrow"
        )
    model, store = run.model.double(), run.source
    chosen = {i: store[i] for i in run.indices}
    chosen = {i: s for i, s in chosen.items() if s.time[-1] - s.time[0] > seconds + s.dt}
    sequences = list(chosen.values())
    if not sequences:
        raise ConfigError(
            f"seconds={seconds:g}: none of the {len(run.indices)} sequences is longer; give fewer"
        )
    if reason := obstacle(model, sequences, needed=1):
        raise ConfigError(f"followers cannot be predicted: {reason}")
    step = longest_step(model, ParameterVector(model).row[None], STEP)
    paths = paths_of(sequences, step).apart(apart)
    prediction = predict_paths(model, paths, variances, seconds)
    alike = {name: value for name, value in variances.items() if name in NOISE}
    typical = predict_paths(model, paths, alike, seconds).mean
    error = np.hypot(variances["measurement"], variances.get("lasting_error", 0.0))
    half = ndtri(0.5 + LEVEL / 2) * np.hypot(prediction.deviation, error)
    rows = []
    for f, (b, place) in enumerate(zip(paths.sequence, paths.place, strict=True)):
        s, k = sequences[b], slice(sequences[b].n_samples)
        rows.append(
            pd.DataFrame(
                {
                    "sequence": s.name,
                    "agent": s.agents[place] if s.agents else str(place),
                    "time": s.time - s.time[0],
                    "given": prediction.given[k],
                    "ahead": s.x[:, place + 1, 0],
                    "measured": s.x[:, place, 0],
                    "predicted": prediction.mean[f, k],
                    "typical": typical[f, k],
                    "low": (prediction.mean - half)[f, k],
                    "high": (prediction.mean + half)[f, k],
                }
            )
        )
    table = pd.concat(rows, ignore_index=True)
    unknown = table[~table["given"]]
    squares = pd.DataFrame(
        {
            "sequence": unknown["sequence"],
            **{key: (unknown[key] - unknown["measured"]) ** 2 for key in ("predicted", "typical")},
        }
    )
    means = squares.groupby("sequence", sort=False).mean()
    _, label = np.unique(clusters(store.index)[list(chosen)], return_inverse=True)
    return Predictions(
        table=table,
        seconds=seconds,
        rmse=float(np.sqrt(squares["predicted"].mean())),
        rmse_typical=float(np.sqrt(squares["typical"].mean())),
        covered=float(unknown["measured"].between(unknown["low"], unknown["high"]).mean()),
        difference=paired(
            means["predicted"].to_numpy(), means["typical"].to_numpy(), label, seed=0
        ),
    )
