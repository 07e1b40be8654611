"""The calculations of the traffic study: one model on one recording each."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.bfgs import Minima, minimise, optimality_residual
from nnode.calibrate.cost import sequence_costs
from nnode.calibrate.ensemble import EnsembleCost
from nnode.calibrate.evaluate import baselines, best_common_speed
from nnode.calibrate.optimizers.adadelta import NoisyAdadelta
from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.resampling import group_weights
from nnode.data.clusters import GAP, clusters
from nnode.data.sequence import Sequence, collate
from nnode.data.store import Store
from nnode.model.build import build_model
from nnode.model.system import System
from nnode.plots.traffic import follow_law
from nnode.simulation.fused import FusedSolver
from studies.stores import sequences

#: Step of the first search, s; the best of its finds are then followed at the study's own step.
COARSE = 0.02
#: Gaps (m) at which laws are compared, as in the paper's figure.
GAPS = tuple(float(gap) for gap in range(2, 51))
#: Finds of the first search that are followed further in float32; the best one then in float64.
FOLLOWED = 4
#: Starts are drawn within: v0 (m/s) and L (m) of the laws; factor on the weights of networks.
SPEEDS, LENGTHS, WIDEN = (15.0, 35.0), (2.0, 10.0), 5.0


def model_options(model: str, box: float | None = None) -> dict[str, Any]:
    """Options of lin, log, n2, n4 or n10 as the paper starts them."""
    common = {"name": model, "leader": "constant", "v0": 30.0}
    if model in ("lin", "log"):
        return {**common, "term": model, "L": 5.0, "L_min": 2.0}
    return {**common, "term": "network_speed", "hidden": int(model[1:]), "box": box}


def system_of(model: str, parameters: dict[str, Any]) -> System:
    """A model with parameters as :func:`named` tells them."""
    system = build_model(model_options(model), dtype=torch.float64)
    with torch.no_grad():
        for name, value in system.named_parameters():
            value.copy_(torch.tensor(parameters[name.removeprefix("terms.0.")]))
    return system


def recording(folder: str, name: str) -> list[Sequence]:
    """The sequences of one recording in a prepared folder, in the order of the store."""
    return [sequence for sequence in sequences(folder) if sequence.recording == name]


def groups(folder: str, name: str) -> np.ndarray:
    """``(B,)`` group of each sequence of a recording: those that may share vehicles."""
    index = [entry for entry in Store(folder).index if entry["recording"] == name]
    return clusters(index, GAP)


class Problem:
    """One model on some sequences, at any step and precision."""

    def __init__(self, items: list[Sequence], model: str, box: float | None = None) -> None:
        self.options = model_options(model, box)
        self.batch = collate(items)

    def cost(self, dt: float, dtype: torch.dtype) -> EnsembleCost:
        """The cost with steps of ``dt`` (s)."""
        return EnsembleCost(self.system(dtype=dtype), self.batch.to(dtype=dtype), FusedSolver(dt))

    def system(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> System:
        """The model at its random start."""
        return build_model(self.options, seed, dtype)

    def starts(self, number: int, seed: int, wide: bool = True) -> Tensor:
        """``(R, K)`` starts: the first as the paper's, then more widely spread ones.

        Networks start uniform on [-1, 1] in one half of the runs, on up to five times that in
        the other; laws anywhere in a plausible range.
        """
        vectors = [ParameterVector(self.system(1000 * seed + r)) for r in range(number)]
        rows = torch.stack([vector.row for vector in vectors])
        draw = torch.Generator().manual_seed(seed)
        share = torch.rand(number, 2, generator=draw, dtype=torch.float64)
        names = [name.removeprefix("terms.0.") for name in vectors[0].names]
        if wide and "L" in names:
            for i, (name, (low, high)) in enumerate((("v0", SPEEDS), ("L", LENGTHS))):
                rows[1:, names.index(name)] = low + (high - low) * share[1:, i]
        elif wide and self.options["box"] is None:
            inner = torch.tensor([name != "v0" for name in names])
            factor = torch.where(torch.arange(number) < number // 2, 1.0, WIDEN ** share[:, 0])
            rows[:, inner] *= factor[:, None]
        return rows

    def search(self, starts: Tensor, dt: float, iterations: int) -> tuple[Minima, Tensor]:
        """Minimise from all starts; also the ``(R,)`` costs at ``dt`` after the first search.

        Steep laws make Euler's method unstable at coarse steps, so that a find of the first
        search is judged at ``dt`` alone.
        """
        fine = self.cost(dt, torch.float32)
        coarse_minima = minimised(self.cost(COARSE, torch.float32), starts, iterations)
        judged = fine.costs(coarse_minima.rows).mean(1)
        best = judged.argsort()[:FOLLOWED]
        near = minimised(fine, coarse_minima.rows[best], iterations // 2)
        exact = self.cost(dt, torch.float64)
        return minimised(exact, near.rows[[near.best]], iterations // 2), judged

    def search_folds(self, fold: np.ndarray, starts: Tensor, dt: float, iterations: int) -> Tensor:
        """``(F, K)`` best finds without the sequences of each fold, all folds side by side.

        Args:
            fold: ``(B,)`` fold of each sequence, counted from 0.
            starts: ``(R, K)``, the same for every fold.
        """
        number = int(fold.max()) + 1
        kept = torch.from_numpy(np.arange(number)[:, None] != fold).double()
        weights = (kept / kept.sum(1, keepdim=True)).repeat_interleave(len(starts), 0)
        coarse, fine = self.cost(COARSE, torch.float32), self.cost(dt, torch.float32)
        coarse_minima = minimised(coarse, starts.repeat(number, 1), iterations, weights)
        each = fine.costs(coarse_minima.rows)
        judged = torch.where(weights > 0, each * weights, 0.0).sum(1).reshape(number, -1)
        few = min(FOLLOWED // 2, len(starts))
        best = judged.argsort(1)[:, :few] + len(starts) * torch.arange(number)[:, None]
        chosen = best.flatten()
        near = minimised(fine, coarse_minima.rows[chosen], iterations // 2, weights[chosen])
        last = near.costs.reshape(number, few).argmin(1) + few * torch.arange(number)
        return near.rows[last]


def minimised(
    cost: EnsembleCost,
    starts: Tensor,
    iterations: int,
    weights: Tensor | None = None,
    inverse: Tensor | None = None,
) -> Minima:
    """The minima of a cost within its bounds, see :func:`nnode.calibrate.bfgs.minimise`.

    Args:
        weights: of the sequences; None takes the mean.
    """
    evaluate = partial(cost, weights=weights)
    return minimise(evaluate, starts, cost.low, cost.high, iterations=iterations, inverse=inverse)


def speeds(system: System) -> list[float]:
    """Speed (m/s) at :data:`GAPS`."""
    law = follow_law(system)
    with torch.no_grad():
        return law.speed(torch.tensor(GAPS, dtype=next(law.parameters()).dtype)).tolist()


def named(cost: EnsembleCost, row: Tensor) -> dict[str, Any]:
    """A row ``(1, K)`` as nested lists by parameter; names without the term they belong to."""
    return {
        name.removeprefix("terms.0."): value[0].double().tolist()
        for name, value in cost.vector.runs(row).items()
    }


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
        "costs": cost.costs(best)[0].numpy(),
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
    curves = [speeds(vector.fill_(row)) for row in rows]
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
    each = problem.cost(dt, torch.float64).costs(rows).numpy()
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
    by_length = costs.reshape(points, points).amin(names.index("v0")).numpy()
    return {"cost": costs.min(), "lengths": axes["L"].numpy(), "by_length": by_length}
