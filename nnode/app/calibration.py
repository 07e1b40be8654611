"""The result of a calibration, which the command writes and Python returns."""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd
import torch
from scipy.special import stdtrit

from nnode.app.drivers import (
    ALONE,
    AUTO,
    EXACT,
    NONE,
    Drivers,
    calibrated_drivers,
    separate_parameters,
)
from nnode.app.training import batches, positions
from nnode.calibrate.checkpoint import Checkpoint, copied, save_checkpoint
from nnode.calibrate.evaluate import Metrics, evaluate, sensitivity
from nnode.calibrate.optimizers.gauss_newton import GaussNewton
from nnode.calibrate.options import StartSpeeds
from nnode.calibrate.trainer import Trainer
from nnode.data.clusters import clusters
from nnode.data.dataset import SequenceDataset, SmoothSpeeds, Source, noise_of
from nnode.data.limits import BEARABLE
from nnode.data.sequence import Sequence
from nnode.data.sequences import Sequences
from nnode.data.smooth import Noise
from nnode.errors import ConfigError, DataError, SimulationError
from nnode.exchange.trajectories import simulated
from nnode.files import xarray
from nnode.model import System
from nnode.model.term import physical_bounds, short_names
from nnode.simulation import Solver

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

log = logging.getLogger(__name__)

_BOUND = {"low": "lower", "high": "upper"}
#: Columns of the table of parameters, by the names of :func:`nnode.calibrate.intervals.intervals`.
_COLUMNS = ("estimate", "low", "high", "unit", "at_bound", "identified", "std_error", "df", "scale")
#: Row of a parameter without an interval.
_NO_INTERVAL = {
    **dict.fromkeys(("low", "high", "std_error", "df"), float("nan")),
    "at_bound": "",
    "identified": None,
    "scale": "linear",
}
#: Relative change of the cost by the relative change of a parameter below which a minimum is
#: reached. For ``sf`` on Jülich data it is at most 5e-6 at minima, and 0.11 and 0.24 where L-BFGS
#: stalls from two starts. For ``lin`` on a noisy platoon it is 1.2e-3 at a minimum with the cost of
#: Gauss-Newton's: the curvature is so large that rounding leaves a slope. The level is the
#: geometric mean.
_LEVEL = 1e-2
#: An epoch is stalled if it lowered the cost by less than the first-order change by this relative
#: change of one parameter.
_MOVED = 1e-4
#: Share of the first cost below which the data are fitted exactly, as a model's own simulation.
#: Relative changes of such a cost are rounding errors.
_EXACT = 1e-6
#: Number of sequences that are simulated at once.
_TOGETHER = 32
STALLED = (
    "the line search stalled: the last epoch found no lower cost, although the gradient is not 0; "
    "these parameters may be no minimum. Start from other parameters, or take "
    "optimizer=gauss_newton"
)


#: Autocorrelation of residuals at one sample from which the summary warns of it.
_CORRELATED = 0.5


@dataclass(frozen=True, kw_only=True)
class Fit:
    """The goodness of fit of a calibrated model on its training sequences.

    It excludes agents that follow their measured paths, such as a measured leader, and the first
    sample of a sequence, where the simulation starts.

    Attributes:
        sequences, agents: their numbers; an agent counts once per sequence.
        observations: number of measured coordinates.
        clusters: number of independent clusters.
        parameters: number of calibrated parameters, including those of the variances.
        rmse: root mean square distance of simulated from measured positions, m.
        autocorrelation: autocorrelation of an agent's residuals at a lag of one sample.
        log_likelihood: logarithm of the likelihood of the positions (m) at the estimates.
        likelihood: ``independent normal errors`` of one variance; or ``mixed-effects model`` if
            drivers differ, which is the marginal likelihood with the covariance of disturbances.
    """

    sequences: int
    agents: int
    observations: int
    clusters: int
    parameters: int
    rmse: float
    autocorrelation: float
    log_likelihood: float
    likelihood: str = "independent normal errors"

    @property
    def aic(self) -> float:
        """Akaike's information criterion, 2 k - 2 log L."""
        return 2 * self.parameters - 2 * self.log_likelihood

    @property
    def bic(self) -> float:
        """The Bayesian information criterion, k log n - 2 log L."""
        return float(self.parameters * np.log(self.observations) - 2 * self.log_likelihood)


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A calibrated model with estimates, intervals and fit statistics.

    Attributes:
        model: a torch module, with the parameters of the best evaluation.
        parameters: a row per physical parameter, by its address such as ``idm.T``: ``estimate``,
            ``lower`` and ``upper`` ends of its 95 % interval by clusters (NaN without an interval:
            for models without exact tangents, or at a bound), ``unit``, ``at_bound`` (``low``,
            ``high`` or empty) and ``identified`` (None without intervals); then ``std_error``, the
            degrees of freedom ``df`` of Student's quantile, and ``scale``, in which the interval
            is symmetric: ``linear`` or ``log``.
        correlation: correlation of the estimates, by address; None without intervals.
        clusters: number of independent clusters for the intervals; None without intervals.
        cost: mean cost of a training sequence at the best evaluation; ``cost_start`` at the first.
        cost_heldout: the same for a held-out sequence; NaN if none is held out. ``heldout_start``
            is its value at the first evaluation.
        cost_unit: unit of all costs.
        epoch: epoch of the best evaluation.
        n_iter: number of epochs.
        history: one row per evaluation: epoch, costs, parameters.
        separate: for ``trainer.drivers=alone`` a row per training sequence with ``cluster``,
            ``cost_pooled`` (with the pooled parameters), ``cost``, the parameters, and the names of
            those ``at_bound``; otherwise None. ``parameters`` and ``cost_heldout`` are those of the
            pooled calibration.
        drivers: results for drivers who differ. ``drivers.variability`` has standard deviations of
            parameters between drivers (%, of logarithms), of disturbances (m/s or m/s²) and of
            measurement errors (m), and the correlation time of disturbances (s), with intervals of
            95 %. ``drivers.table`` has a row per driver with the driver's parameters, their
            standard errors, and ``shrinkage``, the posterior variance relative to the variance
            between drivers. ``parameters`` are then the medians over drivers. None if all drivers
            share their parameters.
        start_speeds: ``kind``, measured, smoothed or fitted; for fitted speeds ``sequences``, first
            speeds (m/s) by vehicle, and ``change``, their root mean square difference from the
            speeds with which simulations start otherwise.
        noise: noise of the measurement, see :class:`nnode.data.smooth.Noise`.
        filled: number of interpolated missing samples of the data.
        status: ``converged``; ``stalled``: the line search of L-BFGS found no lower cost although
            the gradient is not 0; ``stopped``: at the last epoch, or unknown for the optimiser.
        uncompiled: why compiled code was not used; empty if it was used or not requested.
        seconds: time of the training, s.
        checkpoint: all that rebuilds the model, with options, division of the data and versions.
        solver: the solver that simulates the model.
        measured: the training and held-out sequences, with the speeds of the simulations' starts.
    """

    model: System
    parameters: pd.DataFrame
    correlation: pd.DataFrame | None
    clusters: int | None
    cost: float
    cost_start: float
    cost_heldout: float
    heldout_start: float
    cost_unit: str
    epoch: int
    n_iter: int
    history: pd.DataFrame
    separate: pd.DataFrame | None
    drivers: Drivers | None
    start_speeds: dict[str, Any]
    noise: Noise
    filled: int
    status: str
    uncompiled: str
    seconds: float
    checkpoint: Checkpoint
    solver: Solver
    measured: Source

    @property
    def name(self) -> str:
        """Name of the model."""
        return str(self.checkpoint.config["model"]["name"])

    @cached_property
    def fit(self) -> Fit:
        """The goodness of fit on the training sequences, which are simulated once."""
        items = self._sequences("train")
        sums, agents, samples, dims = np.zeros(4), 0, 0, 1
        for s, path in zip(items, self.simulated(items), strict=True):
            error = (s.x - path.x)[1:, _counted(self.model, s)[-1]]
            dims = error.shape[2]
            agents, samples = agents + error.shape[1], samples + error.shape[0] * error.shape[1]
            now, past = error[1:], error[:-1]
            products = ((error, error), (past, past), (now, now), (now, past))
            sums += [(a * b).sum() for a, b in products]
        square, before, after, lagged = map(float, sums)
        number = max(samples * dims, 1)
        variance = max(square / number, np.finfo(float).tiny)
        trained = sum(p.numel() for p in self.model.parameters() if p.requires_grad)
        label = clusters(self.measured.index)[self._indices("train")]
        fit = Fit(
            sequences=len(items),
            agents=agents,
            observations=number,
            clusters=len(np.unique(label)),
            parameters=trained + 1,  # the variance
            rmse=float(np.sqrt(square / max(samples, 1))),
            autocorrelation=lagged / np.sqrt(before * after) if before * after > 0 else 0.0,
            log_likelihood=float(-0.5 * number * (np.log(2 * np.pi * variance) + 1)),
        )
        if self.drivers is None:
            return fit
        return replace(
            fit,
            observations=self.drivers.observations,
            parameters=trained + self.drivers.variances,
            log_likelihood=self.drivers.log_likelihood,
            likelihood="mixed-effects model",
        )

    def summary(self) -> str:
        """The fit, a table of parameters with intervals of 95 %, and remarks, as text."""
        fit, config = self.fit, self.checkpoint.config
        optimizer = config["groups"].get("optimizer", config["optimizer"]["name"])
        facts = [
            ("Model", self.name, "Observations", f"{fit.observations}"),
            ("Solver", config["solver"]["name"], "Agents", f"{fit.agents}"),
            ("Optimizer", optimizer, "Sequences", f"{fit.sequences}"),
            ("Status", self.status, "Clusters", f"{fit.clusters}"),
            ("Epochs", f"{self.n_iter}", "RMSE (m)", f"{fit.rmse:.4g}"),
            ("Parameters", f"{fit.parameters}", "Log-likelihood", f"{fit.log_likelihood:.6g}"),
            ("", "", "AIC", f"{fit.aic:.6g}"),
            ("", "", "BIC", f"{fit.bic:.6g}"),
        ]
        lines = [f"{a:<12}{b:<26}{c:<16}{d:>12}" for a, b, c, d in facts]
        table = self._table()
        lines += ["", *table] if table else []
        lines += ["", *self._costs(), *self._remarks()]
        return "\n".join(line.rstrip() for line in lines)

    def _table(self) -> list[str]:
        """The table of parameters, with remarks on estimates, line by line; none of networks, whose
        weights have no units."""
        if self.parameters.empty:
            return []
        short = short_names(map(str, self.parameters.index))
        heads = {"std_error": "std err", "lower": "[0.025", "upper": "0.975]"}
        cells = self.parameters[["estimate", *heads]].rename(index=short, columns=heads)
        table = cells.map(lambda value: f"{value:.4g}" if np.isfinite(value) else "-")
        table["unit"] = self.parameters["unit"].to_list()
        table[""] = [_remark(row) for row in _rows(self.parameters).values()]
        return [line.rstrip() for line in table.to_string().splitlines()]

    def _costs(self) -> list[str]:
        costs = {
            "training": (self.cost_start, self.cost),
            "held-out": (self.heldout_start, self.cost_heldout),
        }
        return [
            f"cost of a {part} sequence: {before:.4g} -> {after:.4g} {self.cost_unit}"
            for part, (before, after) in costs.items()
            if np.isfinite(after)
        ]

    def _remarks(self) -> list[str]:
        """Remarks on the data and the method."""
        unit, fit, lines = self.cost_unit, self.fit, []
        if self.status == "stalled":
            lines.append(STALLED)
        lines.append(f"{self.noise}{self._noise_of_speeds()}")
        if self.filled:
            lines.append(f"missing samples that were interpolated: {self.filled}")
        speeds = self.start_speeds
        if "change" in speeds:
            whose = "smoothed paths" if speeds.get("smoothed") else "the data"
            lines.append(
                f"first speeds of training sequences are fitted: {speeds['change']:.3g} "
                f"m/s (root mean square) from those of {whose}, which held-out sequences start with"
            )
        if self.separate is not None:
            lines.append(
                f"each training sequence calibrated separately: {self.separate['cost'].mean():.4g} "
                f"{unit} on the same sequences; other sequences have the pooled parameters"
            )
        if self.drivers is not None:
            lines += self.drivers.summary()
        elif fit.autocorrelation > _CORRELATED:
            lines.append(
                "the log-likelihood, AIC and BIC assume independent errors, but the "
                f"autocorrelation of the residuals is {fit.autocorrelation:.2f} at one sample: "
                "compare laws on held-out sequences"
            )
        if self.clusters == 1:
            lines.append(
                "no intervals: the training sequences are one cluster, of those that share agents "
                "or are near in time; intervals need at least two"
            )
        return lines

    def conf_int(self, alpha: float = 0.05) -> pd.DataFrame:
        """Confidence intervals of the parameters, ``lower`` and ``upper`` by address.

        They are robust to dependence within clusters (CR2 with Satterthwaite's degrees of freedom)
        and are clipped to the admissible set. Parameters without an interval have NaN.

        Args:
            alpha: one minus the level.

        Raises:
            ConfigError: a level that is not between 0 and 1.
        """
        if not 0 < alpha < 1:
            raise ConfigError(f"alpha={alpha}: expected a number between 0 and 1, such as 0.05")
        table = self.parameters
        value, error = (table[key].to_numpy(dtype=float) for key in ("estimate", "std_error"))
        half = stdtrit(table["df"].to_numpy(dtype=float), 1 - alpha / 2) * error
        in_logs = (table["scale"] == "log").to_numpy()
        relative = np.where(in_logs, half / value, 0.0)
        limits = [physical_bounds(self.model)[str(name)] for name in table.index]
        low, high = ([getattr(limit, end) for limit in limits] for end in ("low", "high"))
        has_interval = np.isfinite(table["lower"].to_numpy(dtype=float))
        ends = {}
        for end, sign in (("lower", -1), ("upper", 1)):
            edge = np.where(in_logs, value * np.exp(sign * relative), value + sign * half)
            ends[end] = np.where(has_interval, np.clip(edge, low, high), np.nan)
        return pd.DataFrame(ends, index=table.index)

    def residuals(self, part: str = "train") -> pd.DataFrame:
        """Measured minus simulated positions, m.

        Args:
            part: ``train`` or ``heldout``, the set of sequences.

        Returns:
            A row per sequence, time (s) and agent, with ``x``, ``x_simulated`` and ``residual``
            (for people also ``y``, ``y_simulated``, ``residual_x`` and ``residual_y``), in the
            order of the table and with its keys. The first sample of a sequence, where the
            simulation starts, and agents that follow their measured paths are excluded. If drivers
            differ, all are simulated with the typical driver's parameters.

        Raises:
            ConfigError: no such part.
            DataError: no sequence is held out.
        """
        items = self._sequences(part)
        if not items:
            raise DataError("no sequence is held out; fit with heldout=0.2, for example")
        paths = list(self.simulated(items))
        table, simulated_table = (
            Sequences(part_sequences).to_dataframe() for part_sequences in (items, paths)
        )
        counted = np.concatenate([_counted(self.model, s).ravel() for s in items])
        residuals = table[["sequence", "time", "agent"]].copy()
        axes = "xy"[: items[0].x.shape[2]]
        for axis in axes:
            residuals[axis], residuals[f"{axis}_simulated"] = table[axis], simulated_table[axis]
            name = "residual" if len(axes) == 1 else f"residual_{axis}"
            residuals[name] = table[axis] - simulated_table[axis]
        return residuals[counted].reset_index(drop=True)

    def _indices(self, part: str) -> list[int]:
        """Positions of a part's sequences among the measured ones."""
        if part not in ("train", "heldout"):
            raise ConfigError(f"part={part}: expected train or heldout")
        return positions(self.measured, self.checkpoint.split.get(part, []))

    def _sequences(self, part: str) -> list[Sequence]:
        return [self.measured[i] for i in self._indices(part)]

    def simulated(self, sequences: Iterable[Sequence]) -> Iterator[Sequence]:
        """The sequences as the model simulates them from their first measured states."""
        dtype = next(self.model.parameters()).dtype
        return simulated(lambda b: self.solver(self.model, b), sequences, dtype=dtype)

    def _noise_of_speeds(self) -> str:
        """The remark on noisy first speeds; empty if the noise is small."""
        if not self.noise.beyond or self.model.domain != "traffic" or self.model.order == 1:
            return ""
        beyond = f", more than the {BEARABLE:g} m/s that a law of second order bears: "
        if self.start_speeds.get("smoothed"):
            return (
                f"{beyond}speeds are those of smoothed paths (trainer.start_speeds=given takes the "
                "data's)"
            )
        if self.start_speeds["kind"] == "measured":
            return f"{beyond}estimates are biased; take trainer.start_speeds=auto"
        return ""

    def plot(self) -> Figure:
        """The calibrated speed curve, or the force between two people, over the training data.

        Points are measured gaps and speeds of followers, or positions of people relative to
        others. For laws of second order, the curve is the speed at which a platoon is in
        equilibrium.
        """
        from nnode.plots import force_figure  # loads Matplotlib, which takes a second

        return force_figure(self.model, self._sequences("train"))

    def to_dataframe(self) -> pd.DataFrame:
        """:attr:`parameters` with their addresses as a column, for a file."""
        return self.parameters.rename_axis("parameter").reset_index()

    def to_xarray(self) -> Dataset:
        """Parameters and their correlation along ``parameter``, costs along ``epoch``.

        Needs xarray: ``pip install 'nnode[xarray]'``.
        """
        table = self.parameters[["estimate", "lower", "upper", "unit"]].rename_axis("parameter")
        costs = self.history.set_index("epoch").filter(regex="^cost/")
        arrays = xarray().Dataset.from_dataframe
        dataset: Dataset = arrays(table).set_coords("unit")
        dataset = dataset.merge(arrays(costs.rename(columns=lambda name: name.replace("/", "_"))))
        if self.correlation is not None:
            names = table.index
            dataset = dataset.assign_coords(other=names.to_numpy())
            values = self.correlation.loc[names, names].to_numpy(dtype=float)
            dataset["correlation"] = (("parameter", "other"), values)
        return dataset.assign_attrs(model=self.name, cost_unit=self.cost_unit)

    def save(self, path: str | Path) -> Path:
        """Write a checkpoint that :func:`nnode.load` and the commands read.

        Raises:
            ConfigError: the model was built by hand, so no options describe it.
            WriteError: the disk is full or the folder is not writable.
        """
        if not self.checkpoint.config["model"].get("term"):
            raise ConfigError(
                f"{self.name} was built by hand, and no options describe it: keep its "
                "state_dict() with torch.save, and the code that builds it"
            )
        save_checkpoint(self.checkpoint, Path(path))
        return Path(path)

    def plain(self, paths: dict[str, str]) -> dict[str, Any]:
        """The content of ``result.json``."""
        config = self.checkpoint.config
        rows = _rows(self.parameters)
        heldout = self.cost_heldout if np.isfinite(self.cost_heldout) else None
        content: dict[str, Any] = {
            "summary": {
                "model": config["model"]["name"],
                "data": config["data"]["name"],
                "recording": config["data"]["recording"],
                "seed": config["seed"],
                "cost_start": self.cost_start,
                "cost_train": self.cost,
                "cost_heldout": heldout,
                "epoch": self.epoch,
                "status": self.status,
                **{name: row["estimate"] for name, row in rows.items()},
                "seconds": round(self.seconds, 1),
            },
            "parameters": {name: _as_json(row) for name, row in rows.items()},
        }
        if self.correlation is not None:
            content["correlation"] = {
                name: {other: _number(value) for other, value in row.items()}
                for name, row in _rows(self.correlation).items()
            }
            content["clusters"] = self.clusters
        if self.separate is not None:
            content["separate"] = self.separate.to_dict("records")
        if self.drivers is not None:
            content["drivers"] = self.drivers.plain()
        content["start_speeds"] = self.start_speeds
        content["noise"], content["filled"] = self.noise.plain(), self.filled
        content["solver"] = {
            "name": config["solver"]["name"],
            "uncompiled": self.uncompiled or None,
        }
        rows_of = self.history.to_dict("records")
        # NaN stands for values that an evaluation does not have
        history = [{key: v for key, v in row.items() if v == v} for row in rows_of]
        return {**content, "paths": paths, "history": history}

    def __repr__(self) -> str:
        lines = [*self._costs(), *self._table(), *self._remarks()]
        return "\n".join([f"{self.name}, calibrated", *(f"  {line}" for line in lines)])

    def _repr_html_(self) -> str:
        shown = self.parameters[["estimate", "lower", "upper", "unit"]]
        if self.clusters is None:
            shown = shown[["estimate", "unit"]]
        table = shown.to_html(float_format="{:.4g}".format, na_rep="–", border=0)
        rows = _rows(self.parameters).items()
        notes = [f"{name}: {_remark(row)}" for name, row in rows if _remark(row)]
        words = [f"{self.name}, calibrated", *self._costs()]
        foot = "".join(f"<p>{escape(note)}</p>" for note in notes)
        return "<p>" + "<br>".join(map(escape, words)) + f"</p>{table}{foot}"


def calibrated(trainer: Trainer, store: Source, seconds: float) -> Calibration:
    """The result of a finished training.

    Args:
        trainer: the trainer, whose sequences are those of ``store``.
        seconds: time of the training.
    """
    history, checkpoint = trainer.history, trainer.best_checkpoint()
    first = history[0]
    best = min(history, key=lambda row: abs(row["epoch"] - trainer.best_epoch))
    model = copy.deepcopy(trainer.model).cpu()
    model.load_state_dict(checkpoint.model)
    estimated, separate, speeds = _by_tangents(trainer, model, store)
    values = _logged_parameters(model, best)
    costs = {part: best.get(f"cost/{part}", float("nan")) for part in ("train", "heldout")}
    drivers = _drivers(trainer, store)
    if drivers is not None:
        model = drivers.model
        estimated = {
            key: getattr(drivers, key) for key in ("parameters", "correlation", "clusters")
        }
        checkpoint = replace(checkpoint, model=copied(dict(model.state_dict())))
        values = {name: float(value) for name, (value, _) in model.physical().items()}
        costs = {
            part: _metrics(trainer, model, part).J if part == "train" or trainer.heldout else cost
            for part, cost in costs.items()
        }
        speeds = {k: v for k, v in speeds.items() if k not in ("change", "sequences")}
        speeds["kind"] = "fitted to each driver"
        status = "converged" if drivers.converged else "stopped"
    else:
        status = _status(trainer, model, store)
    if status == "stalled":
        log.warning("%s", STALLED)
    intervals = estimated.get("parameters", {})
    rows = {
        name: {
            **_NO_INTERVAL,
            **{key: v for key, v in intervals.get(name, {}).items() if v is not None},
            "estimate": values[name],
            "unit": unit,
        }
        for name, (_, unit) in model.physical().items()
        if name in values
    }
    parameters = pd.DataFrame(rows.values(), index=list(rows), columns=_COLUMNS)
    correlation = estimated.get("correlation")
    return Calibration(
        model=model,
        parameters=parameters.rename(columns=_BOUND),
        correlation=None if correlation is None else pd.DataFrame.from_dict(correlation, "index"),
        clusters=estimated.get("clusters"),
        cost=costs["train"],
        cost_start=first["cost/train"],
        cost_heldout=costs["heldout"],
        heldout_start=first.get("cost/heldout", float("nan")),
        cost_unit=trainer.options.cost.unit,
        epoch=trainer.best_epoch,
        n_iter=trainer.epoch,
        history=pd.DataFrame(history),
        separate=separate,
        drivers=drivers,
        start_speeds=speeds,
        noise=noise_of(store),
        filled=sum(entry["samples"] for entry in store.manifest.get("filled", [])),
        status=status,
        uncompiled=getattr(trainer.solver, "uncompiled", "") or "",
        seconds=seconds,
        checkpoint=checkpoint,
        solver=trainer.solver,
        measured=cast(SequenceDataset, trainer.train.dataset).store,
    )


def _logged_parameters(model: System, row: dict[str, float]) -> dict[str, float]:
    """The physical parameters in a row of the history, by address.

    Rows of older checkpoints may have other addresses, which are ignored.
    """
    logged = {name: row.get(f"parameters/{name}") for name in model.physical()}
    return {name: value for name, value in logged.items() if value is not None}


def _counted(model: System, s: Sequence) -> np.ndarray:
    """``(K, N)`` True for the samples whose errors count, which excludes the first one and those of
    a measured leader."""
    counted = np.ones(s.x.shape[:2], dtype=bool)
    counted[0] = False
    if model.leader_measured:
        counted[:, -1] = False
    return counted


def _drivers(trainer: Trainer, store: Source) -> Drivers | None:
    """The calibration to drivers who differ; None if all share their parameters.

    Searches start at the last and at the first state of the training.
    """
    drivers = trainer.options.drivers
    if drivers in (NONE, ALONE):
        return None
    if (
        drivers in (None, AUTO)
        and (rmse := _metrics(trainer, trainer.model, "train").rmse) <= EXACT
    ):
        log.info(
            "all drivers share their parameters, which explain the paths to %.2g m "
            "(root mean square)",
            rmse,
        )
        return None
    indices = positions(store, trainer.provenance.split["train"])
    log.info("calibrating to %d sequences with drivers who differ", len(indices))
    seed = int(trainer.provenance.config["seed"])
    first = _logged_parameters(trainer.model, trainer.history[0])
    try:
        fit = calibrated_drivers(
            copy.deepcopy(trainer.model).cpu(),
            first,
            [store[i] for i in indices],
            drivers,
            clusters(store.index)[indices],
            seed,
        )
        if fit is None or drivers is not None or fit.converged:
            return fit
    except ConfigError:
        if drivers is not None:
            raise
    log.warning(
        "how drivers differ could not be estimated: all share their parameters, whose "
        "intervals do not contain that they differ"
    )
    return None


def _metrics(trainer: Trainer, model: System, part: str) -> Metrics:
    """Errors of a model on the training or on the held-out sequences."""
    loader = trainer.train if part == "train" else trainer.heldout
    assert loader is not None
    data = cast(SequenceDataset, loader.dataset)
    sequences = batches(data.store, list(data.indices), _TOGETHER, trainer.dtype)
    return evaluate(lambda b: trainer.solver(model, b), sequences, trainer.options.cost)


def _status(trainer: Trainer, model: System, store: Source) -> str:
    """The status of a training, see :class:`Calibration`."""
    if isinstance(trainer.optimizer, GaussNewton):
        return "converged" if trainer.optimizer.converged else "stopped"
    costs = [row["cost/train"] for row in trainer.history]
    if not isinstance(trainer.optimizer, torch.optim.LBFGS) or len(costs) < 2:
        return "stopped"
    indices = positions(store, trainer.provenance.split["train"])
    (batch,) = batches(store, indices, 0, trainer.dtype)
    model = copy.deepcopy(model).cpu()
    try:
        slope = sensitivity(model, trainer.solver, batch, trainer.options.cost)
    except SimulationError:
        return "stopped"
    if slope <= _LEVEL or costs[-1] <= _EXACT * costs[0]:
        return "converged"
    return "stalled" if 1 - costs[-1] / costs[-2] < _MOVED * slope else "stopped"


def _by_tangents(
    trainer: Trainer, model: System, store: Source
) -> tuple[dict[str, Any], pd.DataFrame | None, dict[str, Any]]:
    """Intervals of the best parameters, separate parameters of sequences and first speeds, as far
    as they are requested. They need the Gauss-Newton optimiser."""
    config, options = trainer.provenance.config, trainer.options
    speeds: dict[str, Any] = {"kind": config["data"].get("start_speeds", "measured")}
    data = trainer.train.dataset
    if isinstance(data, SequenceDataset) and isinstance(data.store, SmoothSpeeds):
        store, speeds = data.store, {"kind": "smoothed", "smoothed": True}
    if not isinstance(trainer.optimizer, GaussNewton):
        return {}, None, speeds
    # compiled code takes a second to import
    from nnode.calibrate.intervals import intervals
    from nnode.calibrate.problem import ResidualProblem
    from nnode.simulation.fused import FusedSolver

    assert isinstance(trainer.solver, FusedSolver)
    indices = positions(store, trainer.provenance.split["train"])
    (batch,) = batches(store, indices, 0)
    double = copy.deepcopy(model).double()
    problem = ResidualProblem(
        double, batch, trainer.solver, options.cost, start_speeds=options.start_speeds
    )
    row = problem.vector.row.numpy()
    estimated, separate = intervals(problem, row, clusters(store.index)[indices]), None
    if options.start_speeds is StartSpeeds.fitted:
        by_name = problem.start_speeds(row)
        first = {s.name: s.velocity()[0, :, 0] for s in (store[i] for i in indices)}
        change_of_speeds = np.concatenate(
            [(np.array(v) - first[n])[:-1] for n, v in by_name.items()]
        )
        change = float(np.sqrt(np.mean(change_of_speeds**2)))
        speeds |= {"kind": options.start_speeds.value, "change": change, "sequences": by_name}
    if options.drivers == ALONE:
        sequences = [store[i] for i in indices]
        separate = separate_parameters(problem, sequences, int(config["seed"]))
    return estimated, separate, speeds


def _rows(table: pd.DataFrame) -> dict[str, Any]:
    """The rows of a table by name."""
    return {str(name): row for name, row in table.to_dict("index").items()}


def _remark(row: dict[str, Any]) -> str:
    """The remark on an estimate; empty for none."""
    if row["at_bound"]:
        return f"at the {_BOUND[row['at_bound']]} bound of what is admissible"
    return "" if row["identified"] in (None, True) else "not identified by these data"


def _as_json(row: dict[str, Any]) -> dict[str, Any]:
    content = {"low": _number(row["lower"]), "high": _number(row["upper"])}
    content |= {"value": row["estimate"], "unit": row["unit"]}
    if row["identified"] is not None:
        content |= {"at_bound": row["at_bound"] or None, "identified": row["identified"]}
    return content


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None
