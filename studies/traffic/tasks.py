"""The calculations of the traffic study: one model on one recording each."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.bfgs import optimality_residual
from nnode.calibrate.cost import sequence_costs
from nnode.calibrate.evaluate import baselines, best_common_speed
from nnode.calibrate.optimizers.adadelta import NoisyAdadelta
from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.resampling import group_weights
from nnode.simulation.fused import FusedSolver
from studies.traffic.problem import COARSE, Problem, groups, minimised, named, recording, speeds

Result = dict[str, Any]

#: Predictions that need no calibration but a common speed.
BASELINES = ("no_interaction", "constant_velocity")


def fit(
    folder: str,
    recording_name: str,
    model: str,
    box: float | None,
    restarts: int,
    dt: float,
    iterations: int,
    bootstrap: int,
    steps: list[float],
    seed: int,
) -> Result:
    """Calibrate from many starts; costs by sequence, intervals, sensitivity to the step.

    Args:
        box: bound on the weights, or None.
        restarts: number of starts.
        dt: step, s.
        bootstrap: resamples of groups of sequences.
        steps: other steps (s) at which the solution is evaluated.
    """
    problem = Problem(recording(folder, recording_name), model, box)
    group = groups(folder, recording_name)
    minima, judged = problem.search(problem.starts(restarts, seed), dt, iterations)
    cost = problem.cost(dt, torch.float64)
    best = minima.rows[[minima.best]]
    residual = optimality_residual(minima.rows, minima.costs, minima.gradients, cost.low, cost.high)
    result: Result = {
        "cost": minima.costs[minima.best],
        "costs": cost.costs(best)[0],
        "groups": group,
        "parameters": named(cost, best),
        "residual": residual[minima.best],
        "speeds": speeds(ParameterVector(problem.system()).fill_(best[0])),
        "steps_costs": {
            f"{step:g}": problem.cost(step, torch.float64).costs(best).mean() for step in steps
        },
        "best_tenth": np.quantile(judged, 0.1),
    }
    if bootstrap:
        weights = group_weights(group, bootstrap, np.random.default_rng(seed))
        result["bootstrap"] = _bootstrap(
            problem,
            best,
            minima.inverses[minima.best],
            torch.from_numpy(weights),
            dt,
            iterations // 3,
        )
    return result


def _bootstrap(
    problem: Problem, row: Tensor, inverse: Tensor, weights: Tensor, dt: float, iterations: int
) -> Result:
    """Local refits to resampled sequences: what their spread says about the parameters."""
    # the coarse step is ten times cheaper, and does where it hardly changes the solution's cost
    coarse, fine = (problem.cost(step, torch.float32) for step in (COARSE, dt))
    ratio = coarse.costs(row).mean() / fine.costs(row).mean()
    cost = coarse if abs(ratio - 1) < 0.02 else fine
    refits = minimised(cost, row.expand(len(weights), -1), iterations, weights, inverse)
    rows = refits.rows[torch.isfinite(refits.costs)]
    vector = ParameterVector(problem.system())
    curves = [speeds(vector.fill_(one)) for one in rows]
    values = {
        name.removeprefix("terms.0."): value.double()
        for name, value in cost.vector.runs(rows).items()
        if value.ndim == 1
    }
    return {"values": values, "speeds": np.quantile(curves, [0.025, 0.975], axis=0)}


def cross_validate(
    folder: str,
    recording_name: str,
    model: str,
    box: float | None,
    folds: int,
    restarts: int,
    dt: float,
    iterations: int,
    seed: int,
) -> Result:
    """Cost of every sequence under a model that was calibrated without its group.

    Fewer groups than ``folds`` make as many folds as groups; a single group has none.
    """
    group = groups(folder, recording_name)
    number = int(group.max()) + 1
    if number < 2:
        return {"costs": None}
    fold = (np.random.default_rng(seed).permutation(number) % min(folds, number))[group]
    problem = Problem(recording(folder, recording_name), model, box)
    rows = problem.search_folds(fold, problem.starts(restarts, seed + 1), dt, iterations)
    each = problem.cost(dt, torch.float64).costs(rows)
    simple = {name: np.empty(len(fold)) for name in BASELINES}
    for k in range(len(rows)):
        train, test = (
            problem.batch.select(np.flatnonzero(part).tolist()) for part in (fold != k, fold == k)
        )
        speed = best_common_speed([train])
        with torch.no_grad():
            for name, simulate in baselines(problem.system(), FusedSolver(dt), speed).items():
                simple[name][fold == k] = sequence_costs(simulate(test), test)
    return {"costs": each[fold, np.arange(len(fold))], "groups": group, **simple}


def descend(
    folder: str,
    recording_name: str,
    model: str,
    restarts: int,
    steps: int,
    dt: float,
    updates_dt: float,
    lr: float,
    batch_size: int,
    seed: int,
) -> Result:
    """The paper's optimiser, noisy ADADELTA with projection, several runs side by side.

    Args:
        steps: updates.
        dt, updates_dt: Euler steps (s) of the final evaluation, and of updates and history.
        lr: factor on the update, 1 in the paper.
        batch_size: sequences in a mini-batch, the same for all runs; 0 takes all.
    """
    problem = Problem(recording(folder, recording_name), model)
    cost = problem.cost(updates_dt, torch.float32)
    rows = problem.starts(restarts, seed, wide=False).requires_grad_()
    optimizer = NoisyAdadelta([rows], lr=lr, seed=seed)
    rng = np.random.default_rng(seed)
    number = len(problem.batch)
    size = min(batch_size or number, number)
    order: list[int] = []
    history = []
    best, best_rows = torch.full((restarts,), np.inf, dtype=torch.float64), rows.detach().clone()
    every = max(1, steps // 40)
    for step in range(steps + 1):
        if step % every == 0 or step == steps:
            now = cost.costs(rows.detach()).mean(1)
            better = now < best
            best = torch.where(better, now, best)
            best_rows = torch.where(better[:, None], rows.detach(), best_rows)
            history.append([step, best.min(), best.median()])
        if step == steps:
            break
        if len(order) < size:
            order = rng.permutation(number).tolist()
        chosen, order = order[:size], order[size:]
        weights = torch.zeros(number, dtype=torch.float64)
        weights[chosen] = 1 / size
        rows.grad = torch.nan_to_num(cost(rows.detach(), weights)[1])
        optimizer.step()
        with torch.no_grad():
            rows.clamp_(cost.low, cost.high)
    end = best_rows[[int(best.argmin())]]
    cost = problem.cost(dt, torch.float64)
    value, gradient = cost(end)
    return {
        "cost": value[0],
        "parameters": named(cost, end),
        "residual": optimality_residual(end, value, gradient, cost.low, cost.high)[0],
        "history": history,
    }


def scan(folder: str, recording_name: str, model: str, points: int, dt: float) -> Result:
    """A law's cost on a grid over v0 (10 to 40 m/s) and L (2 to 12 m): no minimum escapes it
    by more than its spacing."""
    problem = Problem(recording(folder, recording_name), model)
    cost = problem.cost(dt, torch.float32)
    names = [name.rsplit(".")[-1] for name in cost.vector.names]
    axes = {
        "v0": torch.linspace(10, 40, points, dtype=torch.float64),
        "L": torch.linspace(2, 12, points, dtype=torch.float64),
    }
    grid = torch.cartesian_prod(*(axes[name] for name in names))
    costs = torch.cat([cost.costs(part).mean(1) for part in grid.split(256)])
    by_length = costs.reshape(points, points).amin(names.index("v0"))
    return {"cost": costs.min(), "lengths": axes["L"], "by_length": by_length}
