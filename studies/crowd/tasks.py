"""The calculations of the crowd study.

Over a second, forces of the paper's random starts throw people metres away, and the cost says
nothing about where to go. Over a few samples every start leads to the same valley. Each fit
therefore begins with the first samples of every sequence and follows the minimum as they grow.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from nnode.calibrate.cost import sequence_costs
from nnode.calibrate.evaluate import Simulate, constant_velocity, no_interaction
from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.calibrate.resampling import group_weights
from nnode.data.sequence import Batch, collate
from nnode.model.build import build_model
from nnode.model.network import FeedForward
from nnode.model.options import CrowdOptions, NetworkForceOptions, SocialForceOptions
from nnode.model.system import System
from nnode.plots.interaction import interaction
from nnode.simulation.base import Trajectory
from nnode.simulation.fused import FusedSolver
from studies.crowd import printed
from studies.crowd.data import chosen, parts, time_groups, turned
from studies.stores import sequences

#: Social force and networks.
OPTIONS: dict[str, CrowdOptions] = {
    "sf": SocialForceOptions(name="sf", term="social_force"),
    "nn": NetworkForceOptions(name="nn", term="network_force"),
}
#: Parameters of the social force in the order of its rows.
NAMES = ("A", "k", "kappa")

#: Samples after which the horizon grows; the sequence's own length ends the list.
GROWTH = {"sf": (4, 8, 13, 26, 51), "nn": (6, 13)}
#: Steps at most each time before the horizon grows.
SHORT_STEPS = {"sf": 8, "nn": 3}
#: Networks bear rounding to single precision and are twice as fast in it; A is too small for it.
DTYPE = {"sf": torch.float64, "nn": torch.float32}


def new_system(model: str, seed: int = 0, dtype: torch.dtype = torch.float64) -> System:
    """A model of OPTIONS at its random start."""
    return build_model(asdict(OPTIONS[model]), seed, dtype)


def system_of(model: str, row: np.ndarray | list[float]) -> System:
    """A model of OPTIONS with parameters ``row`` (K,)."""
    return ParameterVector(new_system(model)).fill_(np.array(row))


def row_of(system: System) -> np.ndarray:
    """``(K,)`` the parameters of a system."""
    return ParameterVector(system).row.numpy()


def calibrate(
    model: str,
    batch: Batch,
    start: np.ndarray,
    *,
    people: bool = True,
    grow: bool = True,
    weights: np.ndarray | None = None,
    steps: int = 30,
) -> tuple[np.ndarray, int]:
    """Damped least squares within the model's bounds.

    Args:
        model: of OPTIONS.
        batch: training sequences.
        start: ``(K,)`` parameters.
        people: False keeps people of ``nn`` from acting on each other: the output weights of
            their network are zero and stay so, the network of the walls alone is calibrated.
        grow: begin with the first samples of every sequence.
        weights: ``(B,)`` weight of each sequence, of sum 1; None takes the mean.
        steps: on whole sequences, at most.

    Returns:
        ``(K,)`` all parameters of the model, and the number of simulations.
    """
    system = system_of(model, start)
    if not people:
        silence(system)
    system.to(DTYPE[model])
    problem = ResidualProblem(system, batch.to(dtype=DTYPE[model]), FusedSolver())
    options: dict[str, Any] = {"weights": weights, "tolerance": 1e-6}
    begin = problem.start
    if grow:
        begin = problem.initial_fit(
            begin, GROWTH[model], steps=min(steps, SHORT_STEPS[model]), **options
        )
    best = pooled(problem, begin, steps=steps, **options).row
    row = row_of(problem.vector.fill_(best).requires_grad_())  # those that were held, too
    return row, problem.simulations


def silence(system: System) -> None:
    """Let people exert no force on each other, and keep it so in calibration."""
    force = interaction(system)
    assert isinstance(force.pair, FeedForward)
    force.pair.requires_grad_(False)
    with torch.no_grad():
        for weight in force.pair.layers[-1].parameters():
            weight.zero_()


def costs(model: str, row: np.ndarray | list[float], batch: Batch) -> np.ndarray:
    """``(B,)`` cost of every sequence, m² s, in float64."""
    problem = ResidualProblem(system_of(model, row), batch, FusedSolver())
    return problem.costs(problem.vector.row.numpy())


def named(model: str, row: np.ndarray | list[float]) -> dict[str, Any]:
    """Parameters by name, as plain lists and numbers."""
    system = system_of(model, row)
    return {
        name.removeprefix("terms.1."): value.detach().tolist()
        for name, value in system.named_parameters()
    }


Result = dict[str, Any]

#: What is calibrated, and the model it is: the social force, both networks, or the network of
#: the walls alone.
KINDS = {"sf": "sf", "nn": "nn", "wall": "nn"}

#: Steps at most of the social force, which mostly needs fewer, and of a refit that starts at the
#: minimum of the sequences before resampling.
SF_STEPS, REFIT = 30, 4


def fit(
    kind: str,
    folder: str,
    scope: str,
    folds: int,
    span: list[float],
    seed: int,
    start: list[float] | None,
    steps: int,
) -> Result:
    """Calibrate one model from one start, and evaluate it on what was held out.

    Args:
        kind: of KINDS.
        folder, scope, folds, span: see :func:`studies.crowd.data.parts`.
        seed: of the random start, as the paper draws it.
        start: parameters found at a shorter horizon, to go on from; None starts afresh.
        steps: of the networks, see :func:`calibrate`.
    """
    train, held = parts(folder, scope, folds, (span[0], span[1]))
    batch, model = chosen(folder, train), KINDS[kind]
    begin = row_of(new_system(model, seed)) if start is None else np.array(start)
    row, evaluations = calibrate(
        model,
        batch,
        begin,
        people=kind != "wall",
        grow=start is None,
        steps=SF_STEPS if kind == "sf" else steps,
    )
    each = costs(model, row, batch)
    return {
        "row": row,
        "J": each.mean(),
        "evaluations": evaluations,
        "train": _by_name(batch, each),
        "heldout": _of(model, row, chosen(folder, held)) if held else {},
    }


def resample(folder: str, row: list[float], draws: int, first: int, last: int, seed: int) -> Result:
    """Local refits of the social force to resampled stretches of time, all sequences.

    Args:
        row: A, k, kappa calibrated to all sequences.
        draws: resamples in all; those from ``first`` to before ``last`` are computed here.
    """
    every = sequences(folder)
    rng = np.random.default_rng(seed)
    rows = []
    for weights in group_weights(time_groups(every), draws, rng)[first:last]:
        drawn = np.flatnonzero(weights)
        batch = collate(every[i] for i in drawn)
        refit, _ = calibrate(
            "sf", batch, np.array(row), grow=False, weights=weights[drawn], steps=REFIT
        )
        rows.append(refit)
    return {"rows": rows}


def baselines(folder: str) -> Result:
    """Costs by sequence of simulations that calibrate nothing, and of the printed parameters."""
    return {"costs": _simple(collate(sequences(folder)))}


def transfer(folder: str, rows: dict[str, list[float]]) -> Result:
    """Costs by recording and sequence of calibrated models on other runs, and of the baselines.

    Args:
        rows: parameters by kind.
    """
    every = [turned(s) for s in sequences(folder)]
    by_recording: Result = {}
    for recording in dict.fromkeys(s.recording for s in every):
        batch = collate(s for s in every if s.recording == recording)
        costs_by_kind = {kind: _of(KINDS[kind], row, batch) for kind, row in rows.items()}
        by_recording[recording] = {**costs_by_kind, **_simple(batch)}
    return {"runs": by_recording}


def even_pace(batch: Batch) -> Trajectory:
    """Everyone walks straight to his destination, at the pace that takes him there in time.

    It knows as much of the end as the models do, and when it is reached.
    """
    last = (batch.valid.sum(0) - 1).clamp(min=1)
    number = torch.arange(batch.n_samples, dtype=batch.x.dtype)
    share = (number[:, None, None] / last).clamp(max=1.0)[..., None]
    return Trajectory(torch.lerp(batch.x[:1], batch.destination[None], share), None)


def _simple(batch: Batch) -> dict[str, dict[str, float]]:
    system = new_system("sf")
    simple: dict[str, Simulate] = {
        "relaxation": no_interaction(system, FusedSolver(), None),
        "constant_velocity": constant_velocity(system),
        "even_pace": even_pace,
    }
    with torch.no_grad():
        costs_by_name = {
            name: _by_name(batch, sequence_costs(s(batch), batch)) for name, s in simple.items()
        }
    return {**costs_by_name, "printed": _of("sf", list(printed.parameters.values()), batch)}


def _of(model: str, row: Any, batch: Batch) -> dict[str, float]:
    return _by_name(batch, costs(model, row, batch))


def _by_name(batch: Batch, each: np.ndarray | torch.Tensor) -> dict[str, float]:
    return dict(zip(batch.names, each.tolist(), strict=True))
