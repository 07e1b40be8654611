"""Parameters of each sequence's own: alone, or drawn towards those of all (the pool).

Parameters of a sequence cannot be judged on what they were calibrated on. Here they are calibrated
on first halves and judged on second halves; what both halves have in common (method of moments) is
what lasts of a driver, and the unit in which shrinkage counts deviations from the pool.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListLike
from dataclasses import dataclass
from typing import Any

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

#: Factors on the penalty by which sequences are drawn towards the pool.
STRENGTHS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
#: A parameter's spread between sequences is at least this share of the pooled value.
LEAST_SPREAD = 0.02
#: Starts of parameters with limits: a value times a factor that is drawn from here.
FACTORS = (0.5, 2.0)
#: Starts of each sequence's calibration, the pool's parameters first.
STARTS = 4
#: Folds of clusters, each of which takes its strength from the others; at most.
FOLDS = 5
#: Fewest samples of half a sequence.
LEAST = 5


def scattered(cost: ResidualProblem, rows: Iterable[np.ndarray], seed: int) -> np.ndarray:
    """``(R, P)`` starts: the first row, then rows times random factors where there are limits."""
    rng = np.random.default_rng(seed)
    limited = np.isfinite(cost.low) & np.isfinite(cost.high)
    found = []
    for i, row in enumerate(rows):
        if i:
            factor = np.exp(rng.uniform(math.log(FACTORS[0]), math.log(FACTORS[1]), len(row)))
            row = np.where(limited, row * factor, row)
        found.append(np.clip(row, cost.low, cost.high))
    return np.stack(found)


def best_alone(
    cost: ResidualProblem, starts: Iterable[np.ndarray], **options: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Every sequence by itself, the best of several starts.

    Args:
        options: of :func:`nnode.calibrate.problem.alone`.

    Returns:
        ``(B, P)`` parameters, ``(B,)`` costs with what a pool adds to them.
    """
    fits = [alone(cost, row, **options) for row in starts]
    costs = np.array([fit.cost for fit in fits])
    which = np.argmin(costs, axis=0)
    return np.stack([fits[k].row[b] for b, k in enumerate(which)]), costs.min(axis=0)


@dataclass(frozen=True)
class Halves:
    """Calibrations on the first halves of B sequences.

    Attributes:
        centre: ``(P,)`` the pool.
        between: ``(P,)`` standard deviation of the sequences' own parameters.
        spread: ``(P,)`` that of what both halves have in common.
        scale: ``(P,)`` the unit of deviations from the pool: the spread, or a share of the centre.
        pooled, alone, shrunk: ``(B,)`` costs of second halves.
        strengths: of shrinkage, by fold: the best of the other folds' sequences.
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
    fold: np.ndarray,
    strengths: ListLike[float] = STRENGTHS,
) -> Halves:
    """Pooled, alone and in between: calibrated on first halves, judged on second ones.

    Args:
        row: ``(P,)`` start of the pool.
        others: further starts of the sequences' own parameters.
        fold: ``(B,)`` of every sequence.
        strengths: factors, in the unit of the cost, on squares of deviations from the pool; the
            first is 0.
    """
    centre = pooled(first, row).row
    begin = [centre, *others]
    own = [best_alone(cost, begin)[0] for cost in (first, second)]
    spread = np.sqrt(_lasting(*own))
    scale = np.maximum(spread, LEAST_SPREAD * np.where(centre == 0, 1.0, np.abs(centre)))
    tried = [
        alone(first, centre, penalty=(centre, s / scale**2)).row if s else own[0] for s in strengths
    ]
    costs = np.stack([second.costs(one) for one in tried])
    shrunk, chosen = np.zeros(len(fold)), []
    for k in range(int(fold.max()) + 1):
        i = int(np.argmin(costs[:, fold != k].mean(1)))
        shrunk[fold == k] = costs[i, fold == k]
        chosen.append(float(strengths[i]))
    return Halves(
        centre=centre,
        between=np.std(own[0], axis=0),
        spread=spread,
        scale=scale,
        pooled=second.costs(centre),
        alone=costs[0],
        shrunk=shrunk,
        strengths=chosen,
        by_strength=costs.mean(1),
    )


def _lasting(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """``(P,)`` variance of what both halves of a sequence have in common; at least 0.

    The middle 90 % of each half's numbers set the limits that others are moved to: a number that
    a half does not determine may lie anywhere.
    """
    found = []
    for one, other in zip(first.T, second.T, strict=True):
        tame = [np.clip(x, *np.quantile(x, [0.05, 0.95])) for x in (one, other)]
        found.append(max(float(np.cov(*tame)[0, 1]), 0.0))
    return np.array(found)


@dataclass(frozen=True)
class Own:
    """What each sequence's own parameters are, and whether they help.

    Attributes:
        table: a row per sequence: ``sequence``, ``cluster``, ``cost_pool``, ``cost``, its
            parameters, and ``at_bound``: those that ended at an end of what is admissible.
        facts: what ``result.json`` says of them.
    """

    table: pd.DataFrame
    facts: dict[str, Any]


def own_parameters(
    kind: Pooling,
    system: System,
    sequences: list[Sequence],
    cost: Callable[[System, Batch], ResidualProblem],
    seed: int,
) -> Own:
    """Parameters of every sequence's own, of a model with the pool's.

    Args:
        cost: what is minimised of some sequences.

    The strength of shrinkage is relative to the mean cost of the pool, and the one that predicts
    second halves best.

    Raises:
        ConfigError: sequences that are too short to be halved, or of one cluster.
    """
    label = clusters(index_of(sequences)).astype(int)
    number = int(label.max()) + 1
    short = min(sequences, key=lambda s: s.n_samples)
    if short.n_samples < 2 * LEAST or number < 2:
        raise ConfigError(
            f"trainer.pooling={kind.value} calibrates on first halves and judges on second ones, "
            f"of sequences of {2 * LEAST} samples or more in two clusters or more; found "
            f"{number} cluster(s), and {short.n_samples} samples in {short.name}: take longer "
            "sequences (data.window), more of them, or trainer.pooling=pooled"
        )
    parts = [[s.part(low, low + 0.5) for s in sequences] for low in (0.0, 0.5)]
    whole, first, second = (cost(system, collate(part)) for part in (sequences, *parts))
    row = whole.start
    starts = scattered(whole, [row] * STARTS, seed)
    at_pool = whole.costs(row)
    unit = float(at_pool.mean())
    fold = folds(label, min(FOLDS, number), seed)
    strengths = [unit * s for s in STRENGTHS] if kind is Pooling.shrunk else [0.0]
    found = halves(first, second, row, starts[1:], fold, strengths)
    strength = strengths[int(np.argmin(found.by_strength))]
    pool = (row, strength / found.scale**2) if strength else None
    rows, _ = best_alone(whole, starts if pool is None else starts[:1], penalty=pool)
    costs = whole.costs(rows)
    known = short_names(whole.names)
    names = [known[name] for name in whole.names]
    table = pd.DataFrame(
        {
            "sequence": [s.name for s in sequences],
            "cluster": label,
            "cost_pool": at_pool,
            "cost": costs,
            **dict(zip(names, rows.T, strict=True)),
            "at_bound": [
                " ".join(np.array(names)[low | high])
                for low, high in (at_bounds(whole, one) for one in rows)
            ],
        }
    )
    facts: dict[str, Any] = {
        "kind": kind.value,
        "cost_pool": unit,
        "cost": float(costs.mean()),
        "second_half": {
            name: float(getattr(found, name).mean())
            for name in ("pooled", "alone", "shrunk")
            if name != "shrunk" or kind is Pooling.shrunk
        },
        "spread": dict(zip(names, found.spread.tolist(), strict=True)),
        "heldout": "with the pool's parameters: those of a sequence say nothing of another",
    }
    if kind is Pooling.shrunk:
        facts["strength"] = strength
    return Own(table, facts)
