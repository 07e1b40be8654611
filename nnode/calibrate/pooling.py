"""Separate parameters of each sequence, optionally shrunk towards pooled parameters.

Parameters of a sequence must be evaluated on other data than those of their calibration. They are
calibrated on first halves and evaluated on second halves. The covariance between both halves
(method of moments) estimates the variance of permanent differences between drivers. Its root is
the unit of deviations from the pooled parameters in the penalty.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListLike
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from nnode.calibrate.intervals import at_bounds
from nnode.calibrate.options import Pooling
from nnode.calibrate.problem import ResidualProblem, alone, pooled
from nnode.data.clusters import clusters, folds, index_of
from nnode.data.sequence import Batch, Sequence, collate
from nnode.errors import ConfigError
from nnode.model.system import System
from nnode.model.term import short_names

#: Factors on the penalty of deviations from the pooled parameters.
STRENGTHS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
#: A parameter's standard deviation between sequences is at least this share of the pooled value.
LEAST_SPREAD = 0.02
#: Range of the random factors on start values of bounded parameters.
FACTORS = (0.5, 2.0)
#: Number of starts of each sequence's calibration; the first is the pooled parameters.
STARTS = 4
#: Largest number of folds of clusters; the strength of a fold is the best of the other folds.
FOLDS = 5
#: Smallest number of samples of half a sequence.
LEAST = 5


def random_starts(cost: ResidualProblem, rows: Iterable[np.ndarray], seed: int) -> np.ndarray:
    """``(R, P)`` starts: the first row, then rows with random factors on bounded parameters."""
    rng, (shrink, stretch) = np.random.default_rng(seed), np.log(FACTORS)
    limited = np.isfinite(cost.low) & np.isfinite(cost.high)
    starts = []
    for i, row in enumerate(rows):
        if i:
            factor = np.exp(rng.uniform(shrink, stretch, len(row)))
            row = np.where(limited, row * factor, row)
        starts.append(np.clip(row, cost.low, cost.high))
    return np.stack(starts)


def best_alone(
    cost: ResidualProblem, starts: Iterable[np.ndarray], **options: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Calibrate every sequence separately, and take the best of several starts.

    Args:
        options: options of :func:`nnode.calibrate.problem.alone`.

    Returns:
        ``(B, P)`` parameters and ``(B,)`` costs with the penalty.
    """
    fits = [alone(cost, row, **options) for row in starts]
    costs, rows = np.array([fit.cost for fit in fits]), np.array([fit.row for fit in fits])
    return rows[costs.argmin(0), np.arange(costs.shape[1])], costs.min(0)


@dataclass(frozen=True)
class Halves:
    """Calibrations on the first halves of B sequences.

    Attributes:
        centre: ``(P,)`` pooled parameters.
        between: ``(P,)`` standard deviation of the sequences' separate parameters.
        spread: ``(P,)`` root of the covariance between both halves.
        scale: ``(P,)`` unit of deviations from the pooled parameters: the spread, or at least a
            share of the centre.
        pooled, alone, shrunk: ``(B,)`` costs of second halves.
        strengths: strength of shrinkage of every fold, the best for the other folds' sequences.
        by_strength: mean cost of second halves by strength.
    """

    centre: np.ndarray
    between: np.ndarray
    spread: np.ndarray
    scale: np.ndarray
    pooled: np.ndarray
    alone: np.ndarray
    shrunk: np.ndarray
    strengths: list[float]
    by_strength: np.ndarray


def halves(
    first: ResidualProblem,
    second: ResidualProblem,
    row: np.ndarray,
    others: Iterable[np.ndarray],
    sequence_fold: np.ndarray,
    strengths: ListLike[float] = STRENGTHS,
) -> Halves:
    """Pooled, separate and shrunk calibrations of first halves, evaluated on second halves.

    Args:
        row: ``(P,)`` start of the pooled calibration.
        others: further starts of the separate calibrations.
        sequence_fold: ``(B,)`` fold of every sequence.
        strengths: factors, in the unit of the cost, on squared deviations from the pooled
            parameters; the first is 0.
    """
    centre = pooled(first, row).row
    begin = [centre, *others]
    separate = [best_alone(cost, begin)[0] for cost in (first, second)]
    spread = _shared_deviation(separate)
    scale = np.maximum(spread, LEAST_SPREAD * np.where(centre == 0, 1.0, np.abs(centre)))
    candidates = [
        alone(first, centre, penalty=(centre, s / scale**2)).row if s else separate[0]
        for s in strengths
    ]
    costs = np.stack([second.costs(candidate) for candidate in candidates])
    shrunk, chosen = np.zeros(len(sequence_fold)), []
    for k in range(int(sequence_fold.max()) + 1):
        i = int(np.argmin(costs[:, sequence_fold != k].mean(1)))
        shrunk[sequence_fold == k] = costs[i, sequence_fold == k]
        chosen.append(float(strengths[i]))
    return Halves(
        centre=centre,
        between=np.std(separate[0], axis=0),
        spread=spread,
        scale=scale,
        pooled=second.costs(centre),
        alone=costs[0],
        shrunk=shrunk,
        strengths=chosen,
        by_strength=costs.mean(1),
    )


def _shared_deviation(separate: ListLike[np.ndarray]) -> np.ndarray:
    """``(P,)`` root of the covariance between both halves of the sequences; at least 0.

    Values are clipped to the middle 90 % of each half, because a parameter that a half does not
    determine may have any value.
    """
    clipped = [np.clip(rows, *np.quantile(rows, [0.05, 0.95], axis=0)).T for rows in separate]
    shared = [np.cov(*halves)[0, 1] for halves in zip(*clipped, strict=True)]
    return np.sqrt(np.maximum(shared, 0.0))


class SequenceParameters(NamedTuple):
    """Separate parameters of each sequence, and their evaluation.

    Attributes:
        table: a row per sequence: ``sequence``, ``cluster``, ``cost_pool``, ``cost``, its
            parameters, and ``at_bound``, the names of parameters at a bound.
        facts: entries of ``result.json``.
    """

    table: pd.DataFrame
    facts: dict[str, Any]


def sequence_parameters(
    kind: Pooling,
    system: System,
    sequences: list[Sequence],
    cost: Callable[[System, Batch], ResidualProblem],
    seed: int,
) -> SequenceParameters:
    """Separate parameters of every sequence.

    The strength of shrinkage is relative to the mean pooled cost. It is the one that predicts
    second halves best.

    Args:
        system: the model with the pooled parameters.
        cost: function from the model and sequences to the problem.

    Raises:
        ConfigError: sequences are too short to be halved, or belong to one cluster.
    """
    label = clusters(index_of(sequences)).astype(int)
    number = int(label.max()) + 1
    shortest = min(sequences, key=lambda s: s.n_samples)
    if shortest.n_samples < 2 * LEAST or number < 2:
        raise ConfigError(
            f"trainer.pooling={kind.value} calibrates on first halves and judges on second ones, "
            f"of sequences of {2 * LEAST} samples or more in two clusters or more; found "
            f"{number} cluster(s), and {shortest.n_samples} samples in {shortest.name}: take "
            "longer sequences (data.window), more of them, or trainer.pooling=pooled"
        )
    parts = [[s.part(low, low + 0.5) for s in sequences] for low in (0.0, 0.5)]
    whole, first, second = (cost(system, collate(part)) for part in (sequences, *parts))
    row = whole.start
    starts = random_starts(whole, [row] * STARTS, seed)
    at_pool = whole.costs(row)
    unit = float(at_pool.mean())
    sequence_fold = folds(label, min(FOLDS, number), seed)
    strengths = [unit * s for s in STRENGTHS] if kind is Pooling.shrunk else [0.0]
    judged = halves(first, second, row, starts[1:], sequence_fold, strengths)
    strength = strengths[int(np.argmin(judged.by_strength))]
    pool = (row, strength / judged.scale**2) if strength else None
    rows, _ = best_alone(whole, starts if pool is None else starts[:1], penalty=pool)
    costs = whole.costs(rows)
    names = list(short_names(whole.names).values())
    table = pd.DataFrame(
        {
            "sequence": [s.name for s in sequences],
            "cluster": label,
            "cost_pool": at_pool,
            "cost": costs,
            **dict(zip(names, rows.T, strict=True)),
            "at_bound": [
                " ".join(np.array(names)[at_bounds(values, whole.low, whole.high) != ""])
                for values in rows
            ],
        }
    )
    facts: dict[str, Any] = {
        "kind": kind.value,
        "cost_pool": unit,
        "cost": float(costs.mean()),
        "second_half": {
            name: float(getattr(judged, name).mean())
            for name in dict.fromkeys(("pooled", "alone", kind.value))
        },
        "spread": dict(zip(names, judged.spread.tolist(), strict=True)),
        "heldout": "with the pool's parameters: those of a sequence say nothing of another",
    }
    if kind is Pooling.shrunk:
        facts["strength"] = strength
    return SequenceParameters(table, facts)
