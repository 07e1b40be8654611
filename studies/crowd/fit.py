"""Calibration of the two crowd models: horizons that grow, so that no start is lost.

Over a second, forces of the paper's random starts throw people metres away, and the cost says
nothing about where to go. Over a few samples every start leads to the same valley. Each fit
therefore begins with the first samples of every sequence and follows the minimum as they grow.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.data.sequence import Batch
from nnode.model.build import build_model
from nnode.model.network import FeedForward
from nnode.model.options import CrowdOptions, NetworkForceOptions, SocialForceOptions
from nnode.model.system import System
from nnode.plots.interaction import interaction
from nnode.simulation.fused import FusedSolver

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
