"""Calibrations of one candidate on the pairs: cross-validated, by objective, and on test pairs."""

from __future__ import annotations

from typing import Any

import numpy as np

from nnode.calibrate.cost import Convention
from nnode.calibrate.intervals import at_bounds
from nnode.calibrate.least_squares import Minimum
from nnode.calibrate.pooling import best_alone
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.data.clusters import folds as by_cluster
from nnode.data.sequence import Batch
from nnode.simulation.fused import FusedSolver
from studies.following import data, printed
from studies.following.candidates import EVERY, Candidate, decay, published_law, starts

Result = dict[str, Any]

#: What is reported, whichever of them is minimised.
OBJECTIVES = ("spacing", "gap", "relative_gap", "log_gap", "speed")
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
) -> tuple[Minimum, list[float]]:
    """The best of several starts, and the costs of all, penalty included."""
    fits = [
        pooled(cost, row, weights, penalty=decay(cost), steps=STEPS, tolerance=TOLERANCE)
        for row in starts(candidate, cost, restarts, seed)
    ]
    all_costs = [float(fit.cost) for fit in fits]
    return fits[int(np.argmin(all_costs))], all_costs


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


def cross_validate(folder: str, name: str, restarts: int, folds: int, seed: int) -> Result:
    """Calibrate on all training pairs, and, from half the starts, on those outside each fold.

    Returns:
        Costs by objective of all training pairs, and of those that were held out.
    """
    candidate, batch = EVERY[name], data.batch(folder)
    label = data.labels(data.pairs(folder))
    fold = by_cluster(label, folds, seed)
    cost = costs_of(candidate, batch)
    others = {one: costs_of(candidate, batch, one) for one in OBJECTIVES}
    whole, start_costs = calibrated(candidate, cost, restarts, seed)
    held = {one: np.zeros(len(batch)) for one in OBJECTIVES}
    for k in range(folds):
        weights = (fold != k) / (fold != k).sum()
        row = calibrated(candidate, cost, max(1, restarts // 2), seed, weights)[0].row
        for one, values in held.items():
            values[fold == k] = others[one].costs(row)[fold == k]
    return {
        "parameters": named(cost, whole.row),
        "row": whole.row.tolist(),
        "limits": at_limits(cost, whole.row),
        "starts": start_costs,
        "train": {one: others[one].costs(whole.row).tolist() for one in OBJECTIVES},
        "heldout": {one: values.tolist() for one, values in held.items()},
        "clusters": label.tolist(),
    }


def floor(folder: str, name: str, restarts: int, seed: int) -> Result:
    """Every training pair with parameters of its own."""
    candidate, batch = EVERY[name], data.batch(folder)
    cost = costs_of(candidate, batch)
    centre = calibrated(candidate, cost, 1, seed)[0].row
    rows, costs = best_alone(cost, (centre, *starts(candidate, cost, restarts, seed)))
    return {
        "names": list(named(cost, centre)),
        "rows": rows.tolist(),
        "costs": costs.tolist(),
        "limits": [at_limits(cost, row) for row in rows],
    }


def objectives(folder: str, name: str, restarts: int, seed: int) -> Result:
    """All objectives on the training pairs, whichever is minimised."""
    candidate, batch = EVERY[name], data.batch(folder)
    costs = {one: costs_of(candidate, batch, one) for one in OBJECTIVES}
    by_objective: Result = {}
    for one, cost in costs.items():
        row = calibrated(candidate, cost, restarts, seed)[0].row
        by_objective[one] = {
            "reached": {other: float(costs[other].costs(row).mean()) for other in OBJECTIVES},
            "parameters": named(cost, row),
            "limits": at_limits(cost, row),
        }
    return by_objective


def tested(folder: str, name: str, row: list[float]) -> Result:
    """Costs of the test pairs."""
    batch = data.batch(folder, test=True)
    return {
        one: costs_of(EVERY[name], batch, one).costs(np.array(row)).tolist() for one in OBJECTIVES
    }


def reproduced(folder: str) -> Result:
    """Costs of the test pairs, m, of the published parameters; the first sample counts as well."""
    batch = data.batch(folder, test=True)
    seen = batch.valid[:, :, 0].sum(0).numpy()
    first = np.sqrt((seen - 1) / seen)
    errors: Result = {}
    for law, parameters in printed.parameters.items():
        for k, objective in enumerate(printed.objectives):
            values = {name: each[k] for name, each in parameters.items()}
            cost = costs_of(Candidate(law, given=published_law(law, values)), batch)
            errors[f"{law} {objective}"] = (cost.costs(cost.start) * first).tolist()
    return errors
