"""What a calibration found, as an object: the command writes it, Python hands it over."""

from __future__ import annotations

import copy
import logging
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from nnode.app.drivers import AUTO, EXACT, NONE, Drivers, calibrated_drivers
from nnode.app.training import straight_loader, stream
from nnode.calibrate.checkpoint import Checkpoint, copied, save_checkpoint
from nnode.calibrate.evaluate import Metrics, evaluate, sensitivity
from nnode.calibrate.optimizers.gauss_newton import GaussNewton
from nnode.calibrate.options import Pooling, StartSpeeds
from nnode.calibrate.trainer import Trainer
from nnode.data.clusters import clusters
from nnode.data.dataset import SequenceDataset, SmoothSpeeds, Source, noise_of
from nnode.data.smooth import BEARABLE, Noise
from nnode.errors import ConfigError, SimulationError
from nnode.files import xarray
from nnode.model import System
from nnode.model.term import short_names
from nnode.plots import force_figure

if TYPE_CHECKING:
    from xarray import Dataset

    from nnode.calibrate.pooling import Own

log = logging.getLogger(__name__)

_BOUND = {"low": "lower", "high": "upper"}
#: Relative change of a cost by relative change of a parameter below which a minimum is reached.
#: Of ``sf`` on Jülich data it is 5e-6 at most at minima, and 0.11 and 0.24 where L-BFGS stalls
#: from two starts. Of ``lin`` on a noisy platoon it is 1.2e-3 at a minimum as deep as Gauss and
#: Newton's: the cost is so curved that rounding leaves a slope. The level is the geometric mean.
_LEVEL = 1e-2
#: An epoch moved nothing where it lowered the cost by less than moving one parameter by this share
#: does at first order.
_MOVED = 1e-4
#: Share of the first cost below which the data are fitted without any error, as those of a model's
#: own simulation are: relative changes of such a cost say nothing.
_EXACT = 1e-6
#: Sequences that are simulated at once.
_TOGETHER = 32
STALLED = (
    "the line search stalled: the last epoch found no lower cost, although the gradient is not 0; "
    "these parameters may be no minimum. Start from other parameters, or take "
    "optimizer=gauss_newton"
)


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A calibrated model, and what the data say of it.

    Attributes:
        model: a torch module, with the parameters of the best evaluation.
        parameters: a row per physical parameter, by its address such as ``idm.T``: ``estimate``,
            ``lower`` and ``upper`` ends of its interval of 95 % by clusters (NaN where there is
            none: models without exact tangents, or at a bound), ``unit``, ``at_bound`` (``low``,
            ``high`` or empty) and ``identified`` (None where there are no intervals).
        correlation: of the estimates, by address; None without intervals.
        clusters: number of independent clusters behind the intervals; None without.
        cost: mean cost of a training sequence, at the best evaluation; ``cost_start`` at the first.
        cost_heldout: that of a held-out sequence; NaN where none is held out. ``heldout_start``.
        cost_unit: of all costs.
        epoch: of the best evaluation.
        n_iter: epochs that were done.
        history: one row per evaluation: epoch, costs, parameters.
        own: parameters of each training sequence's own, where ``trainer.pooling`` asks for them: a
            row per sequence with ``cost_pool`` (with those of all) and ``cost``; None: there are
            none. ``parameters`` and ``cost_heldout`` are the pool's, which another sequence gets.
        pooling: how they came about, and costs of second halves, which they were not calibrated on.
        drivers: what was found of drivers who differ, with ``drivers.variability``: standard
            deviations of parameters between drivers (%, of logarithms), of the pushes that disturb
            them (m/s or m/s²) and of the errors of measurement (m), and the time that pushes last
            (s), with intervals of 95 %; and ``drivers.table``: a row per driver with the own
            parameters, their standard errors, and ``shrinkage``, the share of the variance between
            drivers that the driver's data leave. ``parameters`` are then the medians over drivers.
            None: all drivers share their parameters.
        start_speeds: ``kind``, measured, smoothed or fitted; of fitted ones ``sequences``, first
            speeds (m/s) by vehicle, and their root mean square ``change`` from those that
            simulations start with otherwise.
        noise: of the measurement, see :class:`nnode.data.smooth.Noise`.
        filled: number of missing samples of the data that were interpolated.
        status: ``converged``; ``stalled``: the line search of L-BFGS found no lower cost although
            the gradient says that there is one; ``stopped``: at the last epoch, or of a method that
            does not say.
        uncompiled: why compiled code was not taken; empty where it was, or was not asked for.
        seconds: that the training took.
        checkpoint: enough to build the model again, with options, division of the data, versions.
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
    own: pd.DataFrame | None
    pooling: dict[str, Any]
    drivers: Drivers | None
    start_speeds: dict[str, Any]
    noise: Noise
    filled: int
    status: str
    uncompiled: str
    seconds: float
    checkpoint: Checkpoint

    @property
    def name(self) -> str:
        """Of the model."""
        return str(self.checkpoint.config["model"]["name"])

    def summary(self) -> str:
        """Costs, and parameters with units and intervals, a line each."""
        unit = self.cost_unit
        lines = [f"cost of a training sequence: {self.cost_start:.4g} -> {self.cost:.4g} {unit}"]
        if np.isfinite(self.cost_heldout):
            before, after = self.heldout_start, self.cost_heldout
            lines.append(f"cost of a held-out sequence: {before:.4g} -> {after:.4g} {unit}")
        if self.status == "stalled":
            lines.append(STALLED)
        lines.append(f"{self.noise}{self._started()}")
        if self.filled:
            lines.append(f"missing samples that were interpolated: {self.filled}")
        if "change" in self.start_speeds:
            whose = "smoothed paths" if self.start_speeds.get("smoothed") else "the data"
            lines.append(
                f"first speeds of training sequences are fitted: {self.start_speeds['change']:.3g} "
                f"m/s (root mean square) from those of {whose}, which held-out sequences start with"
            )
        if self.pooling:
            lines.append(
                f"with parameters of each sequence's own ({self.pooling['kind']}): "
                f"{self.pooling['cost']:.4g} {unit} where they were calibrated; on second halves, "
                "calibrated on the first: "
                + ", ".join(f"{k} {v:.4g}" for k, v in self.pooling["second_half"].items())
                + f" {unit}; another sequence gets the pool's parameters"
            )
        if self.drivers is not None:
            lines += self.drivers.summary()
        if self.clusters == 1:
            lines.append(
                "no intervals: the training sequences are one cluster, of those that share agents "
                "or are near in time; intervals need at least two"
            )
        short = short_names(map(str, self.parameters.index))
        rows = _rows(self.parameters).items()
        return "\n".join([*lines, *(f"{short[name]} = {_words(row)}" for name, row in rows)])

    def _started(self) -> str:
        """What was done about first speeds that noise makes wrong."""
        bad = self.noise.beyond and self.model.domain == "traffic" and self.model.order > 1
        if not bad:
            return ""
        if self.start_speeds.get("smoothed"):
            return (
                f", more than the {BEARABLE:g} m/s that a law of second order bears: speeds are "
                "those of smoothed paths (trainer.start_speeds=given takes the data's)"
            )
        if self.start_speeds["kind"] != "measured":
            return ""
        return (
            f", more than the {BEARABLE:g} m/s that a law of second order bears: estimates are "
            "biased; take trainer.start_speeds=auto"
        )

    def plot(self) -> Figure:
        """The calibrated speed curve, or the force between two people."""
        return force_figure(self.model)

    def to_dataframe(self) -> pd.DataFrame:
        """:attr:`parameters` with their addresses as a column, for a file."""
        return self.parameters.rename_axis("parameter").reset_index()

    def to_xarray(self) -> Dataset:
        """Parameters and their correlation along ``parameter``, costs along ``epoch``.

        Needs xarray: ``pip install 'nnode[xarray]'``.
        """
        names = [str(name) for name in self.parameters.index]
        found = {
            key: ("parameter", self.parameters[key].to_numpy(dtype=float))
            for key in ("estimate", "lower", "upper")
        }
        if self.correlation is not None:
            table = self.correlation.loc[names, names].to_numpy(dtype=float)
            found["correlation"] = (("parameter", "other"), table)  # type: ignore[assignment]
        for key in (key for key in self.history if str(key).startswith("cost/")):
            found[str(key).replace("/", "_")] = ("epoch", self.history[key].to_numpy(dtype=float))
        coords = {
            "parameter": names,
            "unit": ("parameter", self.parameters["unit"].to_list()),
            "epoch": self.history["epoch"].to_numpy(dtype=int),
        } | ({} if self.correlation is None else {"other": names})
        return xarray().Dataset(found, coords, {"model": self.name, "cost_unit": self.cost_unit})

    def save(self, path: str | Path) -> Path:
        """Write a checkpoint that :func:`nnode.load` and the commands read.

        Raises:
            ConfigError: the model was built by hand, so that no options describe it.
            WriteError: no room, or not allowed.
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
        found: dict[str, Any] = {
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
            found["correlation"] = {
                name: {other: _number(value) for other, value in row.items()}
                for name, row in _rows(self.correlation).items()
            }
            found["clusters"] = self.clusters
        if self.own is not None:
            found["pooling"] = {**self.pooling, "sequences": self.own.to_dict("records")}
        if self.drivers is not None:
            found["drivers"] = self.drivers.plain()
        found["start_speeds"] = self.start_speeds
        found["noise"], found["filled"] = self.noise.plain(), self.filled
        found["solver"] = {"name": config["solver"]["name"], "uncompiled": self.uncompiled or None}
        rows_of = self.history.to_dict("records")
        # what was not measured at an evaluation is not there
        history = [{key: v for key, v in row.items() if v == v} for row in rows_of]
        return {**found, "paths": paths, "history": history}

    def __repr__(self) -> str:
        lines = self.summary().splitlines()
        return "\n".join([f"{self.name}, calibrated", *(f"  {line}" for line in lines)])

    def _repr_html_(self) -> str:
        lines = [line for line in self.summary().splitlines() if line.startswith("cost")]
        shown = self.parameters[["estimate", "lower", "upper", "unit"]]
        if self.clusters is None:
            shown = shown[["estimate", "unit"]]
        table = shown.to_html(float_format="{:.4g}".format, na_rep="–", border=0)
        rows = _rows(self.parameters).items()
        notes = [f"{name}: {_remark(row)}" for name, row in rows if _remark(row)]
        words = [f"{self.name}, calibrated", *lines]
        foot = "".join(f"<p>{escape(note)}</p>" for note in notes)
        return "<p>" + "<br>".join(map(escape, words)) + f"</p>{table}{foot}"


def calibrated(trainer: Trainer, store: Source, seconds: float) -> Calibration:
    """What a training came to, when it has ended.

    Args:
        trainer: its loader's sequences are those of ``store``.
        seconds: that it took.
    """
    history, checkpoint = trainer.history, trainer.best_checkpoint()
    first = history[0]
    best = min(history, key=lambda row: abs(row["epoch"] - trainer.best_epoch))
    model = copy.deepcopy(trainer.model).cpu()
    model.load_state_dict(checkpoint.model)
    found, own, speeds = _by_tangents(trainer, model, store)
    # an epoch of an older checkpoint that was resumed may know its parameters by other names
    known = {name: best.get(f"parameters/{name}") for name in model.physical()}
    values = {name: value for name, value in known.items() if value is not None}
    costs = {part: best.get(f"cost/{part}", float("nan")) for part in ("train", "heldout")}
    drivers = _drivers(trainer, store)
    if drivers is not None:
        model = drivers.model
        found = {key: getattr(drivers, key) for key in ("parameters", "correlation", "clusters")}
        checkpoint = replace(checkpoint, model=copied(dict(model.state_dict())))
        values = {name: float(value) for name, (value, _) in model.physical().items()}
        costs = {part: _cost(trainer, model, part) for part in costs}
        speeds = {k: v for k, v in speeds.items() if k not in ("change", "sequences")}
        speeds["kind"] = "fitted to each driver"
        status = "converged" if drivers.converged else "stopped"
    else:
        status = _status(trainer, model, store)
    if status == "stalled":
        log.warning("%s", STALLED)
    told = found.get("parameters", {})
    rows = {
        name: _row(values[name], unit, told.get(name))
        for name, (_, unit) in model.physical().items()
        if name in values
    }
    columns = ["estimate", "lower", "upper", "unit", "at_bound", "identified"]
    correlation = found.get("correlation")
    return Calibration(
        model=model,
        parameters=pd.DataFrame.from_dict(rows, orient="index", columns=columns),
        correlation=None if correlation is None else pd.DataFrame.from_dict(correlation, "index"),
        clusters=found.get("clusters"),
        cost=costs["train"],
        cost_start=first["cost/train"],
        cost_heldout=costs["heldout"],
        heldout_start=first.get("cost/heldout", float("nan")),
        cost_unit=trainer.options.cost.unit,
        epoch=trainer.best_epoch,
        n_iter=trainer.epoch,
        history=pd.DataFrame(history),
        own=None if own is None else own.table,
        pooling=own.facts if own else {},
        drivers=drivers,
        start_speeds=speeds,
        noise=noise_of(store),
        filled=sum(one["samples"] for one in store.manifest.get("filled", [])),
        status=status,
        uncompiled=getattr(trainer.solver, "uncompiled", "") or "",
        seconds=seconds,
        checkpoint=checkpoint,
    )


def _drivers(trainer: Trainer, store: Source) -> Drivers | None:
    """What the data tell of drivers who differ, where that is asked for.

    Searches start at the last state of the training and at its first, which a run that is resumed
    has as well.
    """
    drivers = trainer.options.drivers
    if drivers == NONE:
        return None
    names = trainer.provenance.split["train"]
    if drivers == AUTO:
        rmse = _metrics(trainer, trainer.model, "train").rmse
        if rmse <= EXACT:
            log.info(
                "all drivers share their parameters, which explain the paths to %.2g m "
                "(root mean square)",
                rmse,
            )
            return None
    places = {entry["name"]: i for i, entry in enumerate(store.index)}
    indices = [places[name] for name in names]
    log.info("calibrating to %d sequences with drivers who differ", len(indices))
    seed, row = int(trainer.provenance.config["seed"]), trainer.history[0]
    known = {name: row.get(f"parameters/{name}") for name in trainer.model.physical()}
    first = {name: value for name, value in known.items() if value is not None}
    return calibrated_drivers(
        copy.deepcopy(trainer.model).cpu(),
        first,
        [store[i] for i in indices],
        drivers,
        clusters(store.index)[indices],
        seed,
    )


def _metrics(trainer: Trainer, model: System, part: str) -> Metrics:
    """Errors of a model on the training or on the held-out sequences."""
    loader = trainer.train if part == "train" else trainer.heldout
    assert loader is not None
    data = cast(SequenceDataset, loader.dataset)
    batches = stream(straight_loader(data.store, list(data.indices), _TOGETHER), trainer.dtype)
    return evaluate(lambda b: trainer.solver(model, b), batches, trainer.options.cost)


def _cost(trainer: Trainer, model: System, part: str) -> float:
    """Mean cost of a sequence; NaN where none is held out."""
    if part == "heldout" and trainer.heldout is None:
        return float("nan")
    return _metrics(trainer, model, part).J


def _status(trainer: Trainer, model: System, store: Source) -> str:
    """How a training ended, see :class:`Calibration`."""
    if isinstance(trainer.optimizer, GaussNewton):
        return "converged" if trainer.optimizer.converged else "stopped"
    costs = [row["cost/train"] for row in trainer.history]
    if not isinstance(trainer.optimizer, torch.optim.LBFGS) or len(costs) < 2:
        return "stopped"
    indices = [
        i for i, e in enumerate(store.index) if e["name"] in trainer.provenance.split["train"]
    ]
    (batch,) = stream(straight_loader(store, indices, 0), trainer.dtype)
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
) -> tuple[dict[str, Any], Own | None, dict[str, Any]]:
    """Intervals of the best parameters, each sequence's own and first speeds where they are asked
    for, of models that have exact tangents; otherwise none."""
    config, options = trainer.provenance.config, trainer.options
    speeds: dict[str, Any] = {"kind": config["data"].get("start_speeds", "measured")}
    data = trainer.train.dataset
    if isinstance(data, SequenceDataset) and isinstance(data.store, SmoothSpeeds):
        store, speeds = data.store, {"kind": "smoothed", "smoothed": True}
    if not isinstance(trainer.optimizer, GaussNewton):
        return {}, None, speeds
    # compiled code takes a second to import
    from nnode.calibrate.intervals import intervals
    from nnode.calibrate.pooling import own_parameters
    from nnode.calibrate.problem import ResidualProblem
    from nnode.simulation.fused import FusedSolver

    assert isinstance(trainer.solver, FusedSolver)
    make = partial(
        ResidualProblem,
        solver=trainer.solver,
        convention=options.cost,
        start_speeds=options.start_speeds,
    )
    places = {entry["name"]: i for i, entry in enumerate(store.index)}
    indices = [places[name] for name in trainer.provenance.split["train"]]
    (batch,) = stream(straight_loader(store, indices, 0))
    double = copy.deepcopy(model).double()
    problem = make(double, batch)
    row = problem.vector.row.numpy()
    found, own = intervals(problem, row, clusters(store.index)[indices]), None
    if options.start_speeds is StartSpeeds.fitted:
        by_name = problem.start_speeds(row)
        first = {s.name: s.velocity()[0, :, 0] for s in (store[i] for i in indices)}
        away = np.concatenate([(np.array(v) - first[n])[:-1] for n, v in by_name.items()])
        change = float(np.sqrt(np.mean(away**2)))
        speeds |= {"kind": options.start_speeds.value, "change": change, "sequences": by_name}
    if options.pooling is not Pooling.pooled:
        chosen = [store[i] for i in indices]
        own = own_parameters(options.pooling, double, chosen, make, int(config["seed"]))
    return found, own, speeds


def _row(value: float, unit: str, known: dict[str, Any] | None) -> tuple[Any, ...]:
    """A line of the table of parameters."""
    own = {"low": None, "high": None, "at_bound": None, "identified": None, **(known or {})}
    ends = [float("nan") if own[end] is None else own[end] for end in ("low", "high")]
    return value, *ends, unit, own["at_bound"] or "", own["identified"]


def _rows(table: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """A table's rows by name."""
    columns = [str(name) for name in table]
    values = zip(*(table[name].to_list() for name in table), strict=True)
    return {
        str(name): dict(zip(columns, row, strict=True))
        for name, row in zip(table.index, values, strict=True)
    }


def _remark(row: dict[str, Any]) -> str:
    """What is wrong with an estimate."""
    if row["at_bound"]:
        return f"at the {_BOUND[row['at_bound']]} bound of what is admissible"
    return "" if row["identified"] in (None, True) else "not identified by these data"


def _words(row: dict[str, Any]) -> str:
    """An estimate with its interval, and what is wrong with it."""
    text = f"{row['estimate']:.4g} {row['unit']}"
    if np.isfinite(row["lower"]):
        text += f"  [{row['lower']:.4g}, {row['upper']:.4g}]"
    remark = _remark(row)
    return f"{text}, {remark}" if remark else text


def _as_json(row: dict[str, Any]) -> dict[str, Any]:
    found = {"low": _number(row["lower"]), "high": _number(row["upper"])}
    found |= {"value": row["estimate"], "unit": row["unit"]}
    if row["identified"] is not None:
        found |= {"at_bound": row["at_bound"] or None, "identified": row["identified"]}
    return found


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None
