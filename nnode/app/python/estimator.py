"""Calibration in Python by an estimator with scikit-learn's interface."""

from __future__ import annotations

import copy
import sys
import time
from collections.abc import Mapping
from collections.abc import Sequence as ListLike
from dataclasses import dataclass, fields
from html import escape
from pathlib import Path
from typing import Any, Self

import pandas as pd
from omegaconf import DictConfig, OmegaConf

from nnode.app.calibration import Calibration, calibrated
from nnode.app.cli.saved import options_of, plain
from nnode.app.python.inputs import (
    Table,
    choice,
    data_of,
    merged,
    model_options,
    sequences,
)
from nnode.app.training import (
    build_solver,
    check,
    check_domain,
    model_of,
    set_threads,
    threads_given_back,
    trainer_of,
)
from nnode.calibrate.options import Device, TrainerOptions
from nnode.data.dataset import Source, sound_speeds
from nnode.data.sequences import Sequences
from nnode.errors import ConfigError, NotFittedError, suggestion
from nnode.model import System
from nnode.model.build import add_effects
from nnode.model.laws import CAR_FOLLOWING_LAWS


@dataclass(eq=False, repr=False)
class Calibrator:
    """Calibrates a model to trajectories, with scikit-learn's interface but without requiring it.

    A sample is a sequence. The methods take a tidy table, or :func:`nnode.sequences` of one, which
    scikit-learn's splitters can divide:
    ``cross_val_score(Calibrator("idm"), X, groups=X.groups, cv=GroupKFold(5))``. All work is done
    on the CPU; the command can use a GPU.

    Args:
        model: a name as in ``conf/model``; options with their ``term``; or a
            :class:`nnode.model.System`, which is copied.
        effects: additional effects, names or ``{"name": ..., parameter: value}``.
        leader: ``constant`` or ``measured``, the motion of the first vehicle; None takes the
            model's default.
        cost: the cost, see :class:`nnode.calibrate.cost.Convention`.
        drivers: ``none``, ``auto`` or names of parameters such as ``["T", "v0"]``, which differ
            between drivers; ``auto`` selects those whose variance the data determine. Laws of lanes
            are then calibrated by a mixed-effects model, see ``docs/method.md``. None is ``auto``
            for laws of second order unless positions were smoothed or have large errors, and
            otherwise ``none``. ``alone`` calibrates each sequence separately as well, see
            ``result_.separate``.
        start_speeds: ``auto``, ``given``, or ``fitted`` for each training sequence; see
            :class:`nnode.calibrate.options.StartSpeeds`.
        optimizer: a name as in ``conf/optimizer``, or options with their ``name``. None takes
            Gauss-Newton for car-following laws, as the command does, and for ``sf``; and L-BFGS
            for all others (for which the command takes the paper's stochastic descent).
        solver: ``fused`` (compiled) or ``torchdiffeq``; None is fused.
        method: method of stepping; None takes the solver's default.
        dt: step, s; None takes the solver's default.
        epochs: largest number of epochs; some optimisers end earlier.
        heldout: share of the sequences that are held out, to monitor their cost.
        seed: seed of start values, of the order of mini-batches and of the division.

    Attributes:
        result_: the complete :class:`nnode.app.calibration.Calibration`.
        model_: the calibrated model, a torch module.
        parameters_: data frame with ``estimate``, ``lower``, ``upper`` and ``unit``.
        cost_: mean cost of a training sequence.
        n_iter_: number of epochs.
        history_: data frame, a row per evaluation.
    """

    model: str | Mapping[str, Any] | System = "idm"
    effects: ListLike[str | Mapping[str, Any]] = ()
    leader: str | None = None
    cost: str = "integral"
    drivers: str | ListLike[str] | None = None
    start_speeds: str = "auto"
    optimizer: str | Mapping[str, Any] | None = None
    solver: str | None = None
    method: str | None = None
    dt: float | None = None
    epochs: int = 200
    heldout: float = 0.0
    seed: int = 0

    @threads_given_back()
    def fit(self, X: Any, y: object = None, groups: object = None) -> Self:
        """Calibrate.

        Args:
            X: a data frame or the path of a table, :func:`nnode.sequences`, or a list of
                :class:`nnode.data.sequence.Sequence`.
            y: not used.
            groups: not used; clusters follow from the agents and times of sequences.

        Raises:
            NNodeError: invalid table, model or options; the message says what to do.
        """
        given = Sequences.of(X)
        config = self._config(given)
        check(config)
        model, solver = self._built(config, given), build_solver(options_of(config.solver))
        trainer = trainer_of(config, model, solver, given, plain=plain(config))
        start = time.monotonic()
        trainer.fit()
        self.result_: Calibration = calibrated(trainer, given, time.monotonic() - start)
        self.model_: System = self.result_.model
        self.parameters_: pd.DataFrame = self.result_.parameters
        self.cost_: float = self.result_.cost
        self.n_iter_: int = self.result_.n_iter
        self.history_: pd.DataFrame = self.result_.history
        return self

    @threads_given_back()
    def predict(self, X: Any) -> Sequences:
        """Simulate every sequence from its measured start.

        Returns:
            The simulated trajectories, at the times and of the agents of ``X``;
            ``.to_dataframe()`` is their tidy table with the keys of the given table.

        Raises:
            NotFittedError: :meth:`fit` has not been called.
            NNodeError: the table is invalid, or a simulation blows up.
        """
        if not hasattr(self, "result_"):
            raise _unfitted()
        given: Source = Sequences.of(X)
        model = self.model_
        if self.start_speeds == "auto":
            given = sound_speeds(given, model.domain, model.order)
        set_threads(None, model.domain)
        manifest = {"simulated": self.result_.name, "led": model.leader_measured}
        return Sequences(self.result_.simulated(given), manifest)

    def score(self, X: Any, y: object = None) -> float:
        """Minus the root mean square distance (m) of simulated from measured positions.

        It is over all simulated agents and samples after the first, as ``nnode evaluate`` prints
        it; higher is better. A measured leader is excluded.
        """
        given = Sequences.of(X)
        return self.predict(given).score(given)

    # -- scikit-learn's interface of estimators ------------------------------------------------

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The arguments of the constructor by name; ``deep`` changes nothing."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def set_params(self, **params: Any) -> Self:
        """Change arguments of the constructor.

        Raises:
            ConfigError: an unknown argument.
        """
        names = self.get_params()
        for name, value in params.items():
            if name not in names:
                raise ConfigError(
                    f"a Calibrator has no parameter {name}, it has {', '.join(names)}"
                    f"{suggestion(name, names.keys())}"
                )
            setattr(self, name, value)
        return self

    def __sklearn_tags__(self) -> Any:
        from sklearn.utils import InputTags, Tags, TargetTags

        return Tags(
            estimator_type=None,
            target_tags=TargetTags(required=False),
            input_tags=InputTags(two_d_array=False),
            no_validation=True,
        )

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "result_")

    def __repr__(self) -> str:
        defaults = {field.name: field.default for field in fields(self)}
        arguments = {
            k: v for k, v in self.get_params().items() if v is not defaults[k] and v != defaults[k]
        }
        return f"Calibrator({', '.join(f'{k}={v!r}' for k, v in arguments.items())})"

    def _repr_html_(self) -> str:
        head = f"<p><code>{escape(repr(self))}</code></p>"
        return head + (self.result_._repr_html_() if hasattr(self, "result_") else "")

    # -- from arguments to a configuration -----------------------------------------------------

    def _config(self, given: Sequences) -> DictConfig:
        """The same configuration as the command's."""
        field = isinstance(self.model, str) and (
            self.model in CAR_FOLLOWING_LAWS
            or (self.model == "sf" and self.solver in (None, "fused"))
        )
        solver = choice("solver", self.solver or "fused", {"method": self.method, "dt": self.dt})
        optimizer = choice("optimizer", self.optimizer or ("gauss_newton" if field else "lbfgs"))
        drivers = self.drivers
        trainer = {
            "max_epochs": self.epochs,
            "figure_every": 0,
            "cost": self.cost,
            "drivers": drivers if drivers is None or isinstance(drivers, str) else list(drivers),
            "start_speeds": self.start_speeds,
            "device": Device.cpu,
        }
        data = OmegaConf.structured(data_of(given))
        data.split.heldout = self.heldout
        if isinstance(self.model, System):
            model: dict[str, Any] = {"name": type(self.model).__name__, "term": ""}
        else:
            model = model_options(self.model, self.leader, self.effects)
        return OmegaConf.create(
            {
                "model": model,
                "data": data,
                "solver": solver,
                "optimizer": optimizer,
                "trainer": merged("trainer", TrainerOptions, trainer),
                "seed": int(self.seed),
                "groups": {
                    "model": model["name"],
                    "data": str(data.name),
                    "solver": str(solver.name),
                    "optimizer": str(optimizer.name),
                },
            }
        )

    def _built(self, config: DictConfig, given: Sequences) -> System:
        """The model with its start values."""
        if not isinstance(self.model, System):
            return model_of(config)
        model = copy.deepcopy(self.model)
        check_domain(model, str(config.model.name), given.domain, str(config.data.name))
        add_effects(model, self.effects)
        set_threads(None, model.domain)
        return model


def _unfitted() -> NotFittedError:
    """The error before a fit, which is also scikit-learn's NotFittedError if that is loaded."""
    loaded = sys.modules.get("sklearn.exceptions")
    kinds = (NotFittedError, *([loaded.NotFittedError] if loaded else []))
    error: NotFittedError = type("NotFittedError", kinds, {})(
        "this Calibrator is not fitted yet; call fit(table) first"
    )
    return error


def fit(
    data: pd.DataFrame | str | Path | Sequences,
    domain: str | None = None,
    *,
    model: str | Mapping[str, Any] | System = "lin",
    walls: str | Path | None = None,
    leader: str | None = None,
    drivers: str | ListLike[str] | None = None,
    epochs: int = 100,
    heldout: float = 0.2,
    seed: int = 0,
    **reading: Any,
) -> Calibration:
    """Calibrate a model to a table in one call, with :class:`Calibrator`.

    Args:
        data: CSV or Parquet, or a data frame, whose columns and units are recognised, see
            :func:`nnode.sequences` and ``docs/data.md``; or the sequences that it returns.
        domain: ``traffic`` or ``crowd``; None recognises it from the columns.
        walls: CSV with x1, y1, x2, y2, m.
        model: see :class:`Calibrator`, as for leader, drivers, epochs and seed.
        leader: ``constant`` or ``measured``.
        drivers: ``auto``, ``none``, or names of parameters that differ.
        epochs: largest number of epochs.
        heldout: share of the sequences that are held out.
        seed: of all random numbers.
        reading: options for reading the table, as for :func:`nnode.sequences`: ``columns={...}``,
            ``position_unit="ft"``, ``faults="keep"``, ...

    Raises:
        NNodeError: invalid table, model or options; the message says what to do.
    """
    options = {"walls": None if walls is None else str(walls), **reading}
    if isinstance(data, Table):
        options["domain"] = domain
    given = sequences(data, **{key: value for key, value in options.items() if value is not None})
    calibrator = Calibrator(
        model, leader=leader, drivers=drivers, epochs=epochs, heldout=heldout, seed=seed
    )
    return calibrator.fit(given).result_
