"""Calibration with differences between drivers: when it applies, and its results as tables."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from collections.abc import Sequence as ListLike
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from nnode.calibrate.options import TrainerOptions
from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import clusters, index_of
from nnode.data.sequence import Sequence, evenly
from nnode.errors import CheckpointError, ConfigError, unknown_value
from nnode.model import System
from nnode.model.term import short_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nnode.calibrate.problem import ResidualProblem
    from nnode.population.drivers import Population

log = logging.getLogger(__name__)

ALONE, AUTO, NONE = "alone", "auto", "none"
#: Root mean square error (m) of pooled parameters below which paths are explained exactly, as by a
#: model's own simulation.
EXACT = 0.01
#: Number of starts of each sequence's separate calibration; the first is the pooled parameters.
STARTS = 4
#: Distance of start values from the bounds, as a share of the admissible interval.
INSIDE = 0.01


def planned(
    options: TrainerOptions, model: System, sequences: Callable[[], list[Sequence]], exact: bool
) -> str | list[str] | None:
    """The treatment of differences between drivers: ``auto``, ``none``, ``alone``, or names of
    parameters.

    None is ``auto`` with a fallback: all drivers share their parameters if the estimation fails.

    Args:
        options: the given options of the trainer.
        sequences: function that reads the training sequences.
        exact: whether the optimizer uses exact derivatives.

    Raises:
        ConfigError: another value, an unknown parameter, or a model or data that do not allow
            differences between drivers.
    """
    given = options.drivers
    if given == NONE:
        return NONE
    # compiled code takes a second
    from nnode.population.drivers import full_names, no_drivers, obstacle
    from nnode.population.followers import drivers_differ

    if given is None:
        if not exact or model.order == 1:
            return NONE
        training = sequences()
        possible = obstacle(model, training) is None and drivers_differ(model, training)
        return None if possible else NONE
    asked = f"trainer.drivers={given if isinstance(given, str) else '[' + ', '.join(given) + ']'}"
    reason = no_drivers(model) if given == ALONE else obstacle(model, sequences())
    if reason is not None:
        raise ConfigError(f"{asked} has no place here: {reason}; take trainer.drivers=none")
    if given == ALONE and not exact:
        raise ConfigError(f"{asked} needs optimizer=gauss_newton")
    if given in (ALONE, AUTO):
        return str(given)
    full_names(given, law_parameters(model))
    return list(given)


def law_parameters(model: System) -> list[str]:
    """Names of the law's parameters, such as ``idm.T``."""
    prefix = f"{model.term_list[0].name}."
    return [name for name in model.physical() if name.startswith(prefix)]


def check_drivers(given: Any) -> None:
    """Refuse a value of ``trainer.drivers`` that is neither a choice nor a list of names.

    Raises:
        ConfigError: another value.
    """
    listed = isinstance(given, ListLike) and not isinstance(given, str) and len(given) > 0
    if given not in (None, ALONE, AUTO, NONE) and not (
        listed and all(isinstance(name, str) for name in given)
    ):
        hint = ", or a list of parameters of the law such as [T, v0]"
        raise unknown_value("trainer.drivers", given, (AUTO, NONE, ALONE), hint)


def separate_parameters(
    problem: ResidualProblem, sequences: list[Sequence], seed: int
) -> pd.DataFrame:
    """The parameters of every sequence, calibrated separately.

    Args:
        problem: of all sequences, which starts at the pooled parameters.
        seed: of further starts.

    Returns:
        See :attr:`nnode.app.calibration.Calibration.separate`.
    """
    from nnode.calibrate.intervals import at_bounds  # compiled code takes a second
    from nnode.calibrate.problem import random_starts, separate

    rows, costs = separate(problem, random_starts(problem, [problem.start] * STARTS, seed))
    names = list(short_names(problem.names).values())
    bounds = [at_bounds(row, problem.low, problem.high) != "" for row in rows]
    return pd.DataFrame(
        {
            "sequence": [s.name for s in sequences],
            "cluster": clusters(index_of(sequences)).astype(int),
            "cost_pooled": problem.costs(problem.start),
            "cost": costs,
            **dict(zip(names, rows.T, strict=True)),
            "at_bound": [" ".join(np.array(names)[bound]) for bound in bounds],
        }
    )


@dataclass(frozen=True, kw_only=True)
class Drivers:
    """A law calibrated to drivers who differ.

    Attributes:
        model: the law with the medians of the drivers' parameters.
        parameters: address to ``low``, ``high``, ``at_bound``, ``identified``, ``std_error``,
            ``df`` and ``scale``; see :func:`nnode.calibrate.intervals.intervals`.
        correlation: correlation of the estimates by address, for logarithms of positive
            parameters.
        clusters: number of clusters.
        differ: short names of the parameters that differ between drivers.
        variability, table: see :class:`nnode.app.calibration.Calibration`.
        converged: whether the estimation converged.
        bias: short name of a parameter to the bias correction, relative for positive parameters.
        observations: number of measured positions of followers that are used.
        apart: smallest time between them, s; 0: all are used.
        variances: number of estimated standard deviations and times.
        log_likelihood: logarithm of the marginal likelihood of the positions (m).
    """

    model: System
    parameters: dict[str, Any]
    correlation: dict[str, dict[str, float]]
    clusters: int
    differ: list[str]
    variability: pd.DataFrame
    table: pd.DataFrame
    converged: bool
    bias: dict[str, float]
    observations: int
    apart: float
    variances: int
    log_likelihood: float

    def plot(self) -> Figure:
        """The drivers in the order of each parameter that differs, with their standard errors."""
        if not self.differ:
            raise ConfigError("no parameter differs between the drivers, so there is no plot")
        from nnode.plots.traffic import driver_figure  # loads Matplotlib, which takes a second

        return driver_figure(self.table, self.differ, self.variability, self.units)

    @property
    def units(self) -> dict[str, str]:
        """Short name of a parameter to its unit."""
        units = {name: unit for name, (_, unit) in self.model.physical().items()}
        return {short: units[name] for name, short in short_names(units).items()}

    def summary(self) -> list[str]:
        """Lines on differences between drivers and on disturbances."""
        texts = {}
        for name, row in self.variability.iterrows():
            texts[name] = f"{row['estimate']:.3g} {row['unit']}"
            if np.isfinite(row["lower"]):
                texts[name] += f" [{row['lower']:.3g}, {row['upper']:.3g}]"
        differ = ", ".join(f"{name} by {texts[name]}" for name in self.differ)
        lines = [
            f"{len(self.table)} drivers; parameters that differ between them (standard deviation): "
            f"{differ or 'none'}; the parameters of the table are the medians",
            f"pushes of {texts['push']} that last {texts['push_time']}; errors of measurement of "
            f"{texts['measurement']}",
        ]
        if "lasting_error" in texts:
            lines.append(
                f"further errors of {texts['lasting_error']} that last "
                f"{texts['lasting_error_time']}"
            )
        for name, bound in self.variability["at_bound"].items():
            if bound:
                size = "smallest" if bound == "low" else "largest"
                lines.append(
                    f"the variation of {name} is estimated at its {size} allowed value: these data "
                    "do not determine it"
                )
        return lines

    def plain(self) -> dict[str, Any]:
        """The content of ``result.json`` on drivers."""
        rows = self.variability.replace({np.nan: None}).to_dict("index")
        return {
            "differ": self.differ,
            "variability": {str(name): row for name, row in rows.items()},
            "bias": self.bias,
            "converged": self.converged,
            "apart": self.apart,
            "table": self.table.to_dict("records"),
        }


def variances_of(drivers: Any) -> tuple[dict[str, float], float] | None:
    """Standard deviations and times by name, as :func:`nnode.population.prediction.predict` takes
    them, and the smallest time between positions that are used, s. None: drivers do not differ.

    Args:
        drivers: what :meth:`Drivers.plain` gives, or None.

    Raises:
        CheckpointError: values are missing or have no meaning.
    """
    if drivers is None:
        return None
    from nnode.population.likelihood import NOISE  # compiled code takes a second

    try:
        rows = drivers["variability"]
        lasting = [name for name in NOISE[3:] if name in rows]
        names = [*NOISE[:3], *lasting, *drivers["differ"]]
        values = {name: float(rows[name]["estimate"]) for name in names}
        apart = float(drivers.get("apart", 0.0))
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            "the differences between drivers in result.json are damaged: expected an estimate of "
            "push, push_time, measurement and of each parameter that differs; train again"
        ) from error
    if not 0 <= apart < np.inf:
        raise CheckpointError(f"result.json: apart is {apart:g}, expected a number of seconds")
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise CheckpointError(f"result.json: {name} is {value:g}, expected a positive number")
    return values | {name: values[name] / 100 for name in drivers["differ"]}, apart


def calibrated_drivers(
    model: System,
    first: dict[str, float],
    sequences: list[Sequence],
    drivers: str | list[str] | None,
    cluster: np.ndarray,
    seed: int,
) -> Drivers | None:
    """Calibrate to drivers who differ; None if this is the default (``drivers`` is None) and
    positions were smoothed before.

    Args:
        model: start of one search.
        first: address to parameter, start of another search.
        drivers: see :func:`planned`.
        cluster: ``(S,)`` cluster of each sequence, see :func:`nnode.data.clusters.clusters`.
        seed: seed of the simulations for the bias correction.

    Raises:
        ConfigError: see :func:`nnode.population.drivers.fit_drivers`.
    """
    from nnode.population.drivers import CHECKED, STEP, at_steps, fit_drivers  # takes a second
    from nnode.population.followers import APART, longest_step, paths_of, without_errors
    from nnode.population.intervals import variations

    double = copy.deepcopy(model).double()
    vector = ParameterVector(double)
    low, high = vector.bounds
    inside = np.where(np.isfinite(high - low), INSIDE * (high - low), 0.0)
    vector.fill_(np.clip(vector.row.numpy(), low + inside, high - inside))
    step = longest_step(double, vector.row[None], STEP)
    used, apart = sequences, 0.0
    if without_errors(sequences):
        # a law explains positions of a simulation, and not those that were smoothed
        thinned = at_steps(sequences)
        part = paths_of(evenly(thinned, CHECKED), step)
        if not fit_drivers(double, part, first=first, pairs=0).explains_rates:
            if drivers is None:
                return None
            log.info(
                "positions show no errors that are new at every sample, so that they were "
                "smoothed: positions that are %g s apart are used",
                APART,
            )
            used, apart = thinned, APART
    paths = paths_of(used, step).apart(apart)
    population = fit_drivers(double, paths, drivers or AUTO, first, seed=seed)
    if not population.estimate.converged:
        log.warning(
            "the estimation of drivers who differ did not converge: take another law, fewer "
            "parameters that differ (trainer.drivers=[T]), or trainer.drivers=none"
        )
    followers, theta = population.model, population.estimate.theta
    row = followers.natural(theta)
    vector.fill_(row)
    calibrated = copy.deepcopy(model)
    calibrated.load_state_dict(
        {k: v.to(calibrated.state_dict()[k]) for k, v in double.state_dict().items()}
    )
    parameters, correlation, number = _intervals(population, cluster)
    short, variances = short_names(followers.names), population.estimate.variances
    return Drivers(
        model=calibrated,
        parameters=parameters,
        correlation=correlation,
        clusters=number,
        differ=[short[name] for name in population.random],
        variability=pd.DataFrame.from_dict(variations(population), orient="index"),
        table=_table(population, sequences),
        converged=population.estimate.converged,
        bias={
            short[name]: float(
                np.expm1(population.bias[i]) if followers.logs[i] else population.bias[i]
            )
            for i, name in enumerate(followers.names)
        },
        apart=apart,
        observations=int(population.estimate.data.observed.sum()),
        variances=int((variances.low < variances.high).sum()),
        # the restricted likelihood is not comparable between laws with different parameters
        log_likelihood=float(population.marginal.each.sum()),
    )


def _intervals(
    population: Population, cluster: np.ndarray
) -> tuple[dict[str, Any], dict[str, dict[str, float]], int]:
    """Intervals, correlations and the number of clusters, in the form of
    :func:`nnode.calibrate.intervals.intervals`."""
    from nnode.calibrate.intervals import VAGUE
    from nnode.population.intervals import influence

    model, theta, paths = population.model, population.estimate.theta, population.model.paths
    agent_cluster = np.zeros(len(paths.names), dtype=int)
    agent_cluster[paths.agent] = cluster[paths.sequence]
    number = len(np.unique(agent_cluster))
    cluster_influence, free = influence(population, agent_cluster)
    bound = population.model.bounds_reached(population.estimate.theta)
    half = np.full(len(theta), np.inf)
    error, degrees = half.copy(), half.copy()
    half[free], error[free] = cluster_influence.half_widths(), cluster_influence.standard_errors()
    degrees[free] = cluster_influence.degrees()
    if number < 2:
        half[:] = np.inf
    ends = [model.natural(np.clip(theta + s * half, model.low, model.high)) for s in (-1.0, 1.0)]
    widest = model.natural(model.high) - model.natural(model.low)
    value = np.abs(model.natural(theta))
    scale = np.where(np.isfinite(widest), VAGUE * widest, value)
    parameters: dict[str, Any] = {}
    for i, name in enumerate(model.names):
        has_interval = bool(np.isfinite(half[i]))
        interval = {
            "low": float(ends[0][i]),
            "high": float(ends[1][i]),
            "std_error": float(error[i] * (value[i] if model.logs[i] else 1.0)),
            "df": float(degrees[i]),
        }
        identified = has_interval and bool(ends[1][i] - ends[0][i] < scale[i])
        parameters[name] = {
            **(interval if has_interval else dict.fromkeys(interval)),
            "scale": "log" if model.logs[i] else "linear",
            "at_bound": str(bound[i]) or None,
            "identified": identified if number > 1 else None,
        }
    table = np.full((len(theta), len(theta)), np.nan)
    if number > 1:
        table[np.ix_(free, free)] = cluster_influence.correlation()
    correlation = pd.DataFrame(table, model.names, model.names).to_dict("index")
    return parameters, cast(dict[str, dict[str, float]], correlation), number


def _table(population: Population, sequences: list[Sequence]) -> pd.DataFrame:
    """A row per driver: the driver's parameters, their standard errors and shrinkage."""
    model, paths, estimate = population.model, population.model.paths, population.estimate
    first = np.unique(paths.agent, return_index=True)[1]
    short = short_names(model.names)
    table: dict[str, Any] = {
        "driver": list(paths.names),
        "sequence": [sequences[b].name for b in paths.sequence[first]],
    }
    errors = np.sqrt(population.marginal.variances)
    for k, q in enumerate(model.random):
        name, value = short[model.names[q]], np.exp(estimate.theta[q] + estimate.agents[:, k])
        table[name] = value
        table[f"{name}_error"] = value * errors[:, k]
        table[f"{name}_shrinkage"] = population.marginal.shrinkage[:, k]
    return pd.DataFrame(table)
