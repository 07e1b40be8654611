"""Calibrations of one candidate on the pairs: cross-validated, by objective, and on test pairs."""

from __future__ import annotations

from typing import Any

import numpy as np

from nnode.calibrate.cost import Convention
from nnode.calibrate.intervals import at_bounds
from nnode.calibrate.pooling import best_alone
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.data.clusters import folds as by_cluster
from nnode.data.sequence import Batch
from nnode.simulation.fused import FusedSolver
from studies.following import data, printed
from studies.following.candidates import EVERY, Candidate, decay, published_law, starts

Result = dict[str, Any]

#: What is reported, whichever of them is minimised, with its unit.
OBJECTIVES = {
    "spacing": "gap, RMSE (m)",
    "gap": "gap, MSE (m²)",
    "relative_gap": "relative gap, MSE",
    "log_gap": "log of the gap, MSE",
    "speed": "speed, MSE (m²/s²)",
}
#: A calibration ends after so many steps, or when one lowers the cost by less than this share.
STEPS, TOLERANCE = 60, 1e-7


def costs_of(candidate: Candidate, batch: Batch, objective: str = "spacing") -> ResidualProblem:
    """A candidate's cost on pairs; the usual steps of its law."""
    return ResidualProblem(candidate.system(), batch, FusedSolver(), Convention(objective))


def calibrated(
    candidate: Candidate,
    cost: ResidualProblem,
    restarts: int,
    seed: int,
    weights: np.ndarray | None = None,
) -> np.ndarray:
    """``(P,)`` parameters of the best of several starts, penalty included."""
    fits = [
        pooled(cost, row, weights, penalty=decay(cost), steps=STEPS, tolerance=TOLERANCE)
        for row in starts(candidate, cost, restarts, seed)
    ]
    return min(fits, key=lambda fit: float(fit.cost)).row


def named(cost: ResidualProblem, row: np.ndarray) -> dict[str, float]:
    """Parameters by name; one that a term before has as well bears its own term's before it."""
    parameters: dict[str, float] = {}
    for address, value in zip(cost.names, row, strict=True):
        name = address.split(".", 1)[1]
        parameters[address if name in parameters else name] = float(value)
    return parameters


def at_limits(cost: ResidualProblem, row: np.ndarray) -> list[str]:
    """Names of the parameters that ended at a limit."""
    bounds = at_bounds(row, cost.low, cost.high)
    return [name for name, bound in zip(named(cost, row), bounds, strict=True) if bound]


def _costs_by_objective(name: str, folder: str) -> dict[str, ResidualProblem]:
    """The costs of a candidate on the training pairs, by objective."""
    batch = data.batch(folder)
    return {one: costs_of(EVERY[name], batch, one) for one in OBJECTIVES}


def cross_validate(folder: str, name: str, restarts: int, folds: int, seed: int) -> Result:
    """Calibrate on all training pairs, and, from half the starts, on those outside each fold.

    Returns:
        Costs of all training pairs, and costs by objective of those that were held out.
    """
    candidate, costs = EVERY[name], _costs_by_objective(name, folder)
    cost = costs["spacing"]
    label = data.labels(data.pairs(folder))
    fold = by_cluster(label, folds, seed)
    whole = calibrated(candidate, cost, restarts, seed)
    heldout = {one: np.zeros(len(label)) for one in OBJECTIVES}
    for k in range(folds):
        weights = (fold != k) / (fold != k).sum()
        row = calibrated(candidate, cost, max(1, restarts // 2), seed, weights)
        for one, values in heldout.items():
            values[fold == k] = costs[one].costs(row)[fold == k]
    return {
        "parameters": named(cost, whole),
        "row": whole,
        "limits": at_limits(cost, whole),
        "train": cost.costs(whole),
        "heldout": heldout,
        "clusters": label,
    }


def floor(folder: str, name: str, restarts: int, seed: int) -> Result:
    """Every training pair with parameters of its own."""
    candidate = EVERY[name]
    cost = costs_of(candidate, data.batch(folder))
    centre = calibrated(candidate, cost, 1, seed)
    rows, costs = best_alone(cost, (centre, *starts(candidate, cost, restarts, seed)))
    return {"costs": costs, "limits": [at_limits(cost, row) for row in rows]}


def objectives(folder: str, name: str, restarts: int, seed: int) -> Result:
    """All objectives on the training pairs, whichever is minimised."""
    costs = _costs_by_objective(name, folder)
    by_objective: Result = {}
    for one, cost in costs.items():
        row = calibrated(EVERY[name], cost, restarts, seed)
        by_objective[one] = {
            "reached": {other: costs[other].costs(row).mean() for other in OBJECTIVES},
            "parameters": named(cost, row),
            "limits": at_limits(cost, row),
        }
    return by_objective


def tested(folder: str, name: str, row: list[float]) -> Result:
    """Costs of the test pairs."""
    cost = costs_of(EVERY[name], data.batch(folder, test=True))
    return {"costs": cost.costs(np.array(row))}


def reproduced(folder: str) -> Result:
    """Costs of the test pairs, m, of the published parameters; the first sample counts as well."""
    batch = data.batch(folder, test=True)
    samples = batch.valid[:, :, 0].sum(0).numpy()
    first = np.sqrt((samples - 1) / samples)
    errors: Result = {}
    for law, parameters in printed.parameters.items():
        for k, objective in enumerate(printed.objectives):
            values = {name: each[k] for name, each in parameters.items()}
            cost = costs_of(Candidate(law, description=published_law(law, values)), batch)
            errors[f"{law} {objective}"] = cost.costs(cost.start) * first
    return errors
