"""Calibration to drivers who differ: where it has a place, and what it found, as tables."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from collections.abc import Sequence as ListLike
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nnode.calibrate.options import Pooling, TrainerOptions
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.model import System
from nnode.model.term import Term, short_names
from nnode.plots.traffic import driver_figure

if TYPE_CHECKING:
    from nnode.population.drivers import Population

log = logging.getLogger(__name__)

AUTO, NONE = "auto", "none"
#: m, root mean square error of pooled parameters below which paths are explained exactly, as those
#: of a model's own simulation are.
EXACT = 0.01
#: m, errors of measurement of positions that were smoothed before. Smoothing leaves errors that
#: last over samples, and models take them for pushes if errors are assumed to be small.
SMOOTHED = 0.1
#: Share of the admissible interval that searches start away from its ends.
INSIDE = 0.01


def planned(
    options: TrainerOptions, model: System, sequences: Callable[[], list[Sequence]], exact: bool
) -> str | list[str] | None:
    """What is done about drivers who differ: ``auto``, ``none``, or names of parameters; None: as
    ``auto``, but all share their parameters if that cannot be estimated.

    Args:
        options: of the trainer, as they were given.
        sequences: reads those of the training.
        exact: whether the optimizer takes exact derivatives.

    Raises:
        ConfigError: a value that is none of these, an unknown parameter, or drivers who differ
            where they have no place.
    """
    given = options.drivers
    if given == NONE:
        return NONE
    from nnode.population.drivers import full_names, obstacle  # compiled code takes a second
    from nnode.population.followers import drivers_differ

    if given is None:
        if not exact or model.order == 1 or options.pooling is not Pooling.pooled:
            return NONE
        training = sequences()
        able = obstacle(model, training) is None and drivers_differ(model, training)
        return None if able else NONE
    if given != AUTO and not _names(given):
        raise ConfigError(
            f"trainer.drivers={given} is unknown, expected auto, none, or a list of parameters of "
            "the law such as [T, v0]"
        )
    asked = f"trainer.drivers={_words(given)}"
    if options.pooling is not Pooling.pooled:
        raise ConfigError(
            f"{asked} and trainer.pooling={options.pooling.value} both give drivers parameters of "
            "their own; choose one of them"
        )
    reason = obstacle(model, sequences())
    if reason is not None:
        raise ConfigError(f"{asked} has no place here: {reason}; take trainer.drivers=none")
    if given == AUTO:
        return AUTO
    law = cast(Term, model.terms[0])
    full_names(given, [name for name in model.physical() if name.startswith(f"{law.name}.")])
    return list(given)


def _names(given: Any) -> bool:
    """Whether an option is a list of words."""
    listed = isinstance(given, ListLike) and not isinstance(given, str)
    return bool(listed and len(given) and all(isinstance(name, str) for name in given))


def _words(given: Any) -> str:
    return f"[{', '.join(given)}]" if _names(given) else str(given)


@dataclass(frozen=True, kw_only=True)
class Drivers:
    """A law calibrated to drivers who differ.

    Attributes:
        model: the law with the parameters of the typical driver, the medians.
        parameters: address to ``low``, ``high``, ``at_bound``, ``identified``, ``std_error``,
            ``df`` and ``scale``; see :func:`nnode.calibrate.intervals.intervals`.
        correlation: of the estimates, by address, of logarithms where parameters are positive.
        clusters: their number.
        differ: short names of the parameters that differ between drivers.
        variability: see :class:`nnode.app.calibration.Calibration`.
        table: the same.
        converged: whether the estimation did.
        bias: of the parameters by short name, by how much they were corrected, as a share where
            they are positive.
        observations: number of measured positions of followers.
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
    variances: int
    log_likelihood: float

    def plot(self) -> Figure:
        """The drivers in the order of each parameter that differs, with their standard errors."""
        if not self.differ:
            raise ConfigError("no parameter differs between the drivers, so there is no plot")
        return driver_figure(self.table, self.differ, self.variability, self.units)

    @property
    def units(self) -> dict[str, str]:
        """Of the parameters, by short name."""
        units = {name: unit for name, (_, unit) in self.model.physical().items()}
        return {short: units[name] for name, short in short_names(units).items()}

    def summary(self) -> list[str]:
        """What differs between drivers, and what disturbs them."""
        rows = self.variability.iterrows()
        found = {str(name): row for name, row in rows}
        said = {name: _estimate(row) for name, row in found.items()}
        differ = [f"{name} by {said[name]}" for name in self.differ]
        every = ", ".join(differ) if differ else "none that the data tell"
        return [
            f"{len(self.table)} drivers; parameters that differ between them (standard deviation): "
            f"{every}; the parameters of the table are the medians",
            f"pushes of {said['push']} that last {said['push_time']}; errors of measurement of "
            f"{said['measurement']}",
        ]

    def plain(self) -> dict[str, Any]:
        """For ``result.json``."""
        rows = self.variability.replace({np.nan: None}).to_dict("index")
        return {
            "differ": self.differ,
            "variability": {str(name): row for name, row in rows.items()},
            "bias": self.bias,
            "converged": self.converged,
            "table": self.table.to_dict("records"),
        }


def _estimate(row: pd.Series) -> str:
    ends = f" [{row['lower']:.3g}, {row['upper']:.3g}]" if np.isfinite(row["lower"]) else ""
    return f"{row['estimate']:.3g} {row['unit']}{ends}"


def calibrated_drivers(
    model: System,
    first: dict[str, float],
    sequences: list[Sequence],
    drivers: str | list[str],
    cluster: np.ndarray,
    seed: int,
) -> Drivers:
    """Calibrate to drivers who differ.

    Args:
        model: where one search starts.
        first: parameters by address, where another search starts.
        drivers: see :func:`planned`.
        cluster: ``(S,)`` of each sequence, see :func:`nnode.data.clusters.clusters`.
        seed: of the simulations that tell the bias.

    Raises:
        ConfigError: see :func:`nnode.population.drivers.fit_drivers`.
    """
    from nnode.population.drivers import STEP, fit_drivers  # compiled code takes a second
    from nnode.population.followers import FLOOR, paths_of
    from nnode.population.intervals import variations

    double = copy.deepcopy(model).double()
    vector = ParameterVector(double)
    low, high = vector.bounds
    inside = np.where(np.isfinite(high - low), INSIDE * (high - low), 0.0)
    vector.fill_(np.clip(vector.row.numpy(), low + inside, high - inside))
    paths = paths_of(sequences, STEP)
    if paths.error <= FLOOR:
        log.info(
            "positions show no errors that are new at every sample, so that they were smoothed: "
            "errors of %g m are assumed",
            SMOOTHED,
        )
        paths = replace(paths, error=SMOOTHED)
    found = fit_drivers(double, paths, drivers, first, seed=seed)
    if not found.estimate.converged:
        log.warning(
            "the estimation of drivers who differ did not converge: take another law, fewer "
            "parameters that differ (trainer.drivers=[T]), or trainer.drivers=none"
        )
    followers, theta = found.model, found.estimate.theta
    row = followers.natural(theta)
    vector.fill_(row)
    whole = copy.deepcopy(model)
    whole.load_state_dict({k: v.to(whole.state_dict()[k]) for k, v in double.state_dict().items()})
    parameters, correlation, number = _intervals(found, cluster)
    short, variances = short_names(followers.names), found.estimate.variances
    return Drivers(
        model=whole,
        parameters=parameters,
        correlation=correlation,
        clusters=number,
        differ=[short[name] for name in found.random],
        variability=pd.DataFrame.from_dict(variations(found), orient="index"),
        table=_table(found, sequences),
        converged=found.estimate.converged,
        bias={
            short[name]: float(np.expm1(bias) if in_logs else bias)
            for name, bias, in_logs in zip(followers.names, found.bias, followers.logs, strict=True)
        },
        observations=int(found.estimate.data.observed.sum()),
        variances=int((variances.low < variances.high).sum()),
        # that of the restricted likelihood would not compare laws with other parameters
        log_likelihood=float(found.marginal.each.sum()),
    )


def _intervals(
    found: Population, cluster: np.ndarray
) -> tuple[dict[str, Any], dict[str, dict[str, float]], int]:
    """Intervals, correlations and the number of clusters, as
    :func:`nnode.calibrate.intervals.intervals` gives them."""
    from nnode.calibrate.intervals import VAGUE
    from nnode.population.intervals import at_bounds, influence

    model, theta, paths = found.model, found.estimate.theta, found.model.paths
    own = np.zeros(len(paths.names), dtype=int)
    own[paths.agent] = cluster[paths.sequence]
    number = len(np.unique(own))
    known, free = influence(found, own)
    low, high = at_bounds(found)
    half = np.full(len(theta), np.inf)
    error, degrees = half.copy(), half.copy()
    half[free], error[free] = known.half_widths(), known.standard_errors()
    degrees[free] = known.degrees()
    if number < 2:
        half[:] = np.inf
    ends = [model.natural(np.clip(theta + s * half, model.low, model.high)) for s in (-1.0, 1.0)]
    widest = model.natural(model.high) - model.natural(model.low)
    value = np.abs(model.natural(theta))
    scale = np.where(np.isfinite(widest), VAGUE * widest, value)
    parameters: dict[str, Any] = {}
    for i, name in enumerate(model.names):
        sure = bool(np.isfinite(half[i]))
        parameters[name] = {
            "low": float(ends[0][i]) if sure else None,
            "high": float(ends[1][i]) if sure else None,
            "std_error": float(error[i] * (value[i] if model.logs[i] else 1.0)) if sure else None,
            "df": float(degrees[i]) if sure else None,
            "scale": "log" if model.logs[i] else "linear",
            "at_bound": "low" if low[i] else "high" if high[i] else None,
            "identified": sure and bool(ends[1][i] - ends[0][i] < scale[i]) if number > 1 else None,
        }
    table = np.full((len(theta), len(theta)), np.nan)
    if number > 1:
        table[np.ix_(free, free)] = known.correlation()
    correlation = {
        name: dict(zip(model.names, map(float, line), strict=True))
        for name, line in zip(model.names, table, strict=True)
    }
    return parameters, correlation, number


def _table(found: Population, sequences: list[Sequence]) -> pd.DataFrame:
    """A row per driver: the own parameters, their standard errors and shrinkage."""
    model, paths, known = found.model, found.model.paths, found.estimate
    first = np.unique(paths.agent, return_index=True)[1]
    short = short_names(model.names)
    table: dict[str, Any] = {
        "driver": list(paths.names),
        "sequence": [sequences[b].name for b in paths.sequence[first]],
    }
    errors = np.sqrt(found.marginal.variances)
    for k, q in enumerate(model.random):
        name, value = short[model.names[q]], np.exp(known.theta[q] + known.agents[:, k])
        table[name] = value
        table[f"{name}_error"] = value * errors[:, k]
        table[f"{name}_shrinkage"] = found.marginal.shrinkage[:, k]
    return pd.DataFrame(table)
