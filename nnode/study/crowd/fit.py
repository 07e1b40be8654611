"""Calibration of the two crowd models: horizons that grow, so that no start is lost.

Over a second, forces of the paper's random starts throw people metres away, and the cost says
nothing about where to go. Over a few samples every start leads to the same valley. Each fit
therefore begins with the first samples of every sequence and follows the minimum as they grow.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.calibrate.ensemble import EnsembleCost
from nnode.calibrate.least_squares import Minimum, least_squares, trajectory_residuals
from nnode.data.sequence import Batch
from nnode.model.build import build_model
from nnode.model.network import FeedForward
from nnode.model.options import CrowdOptions, NetworkForceOptions, SocialForceOptions
from nnode.model.system import System
from nnode.plots.interaction import interaction
from nnode.simulate.fused import FusedSolver
from nnode.study.crowd.data import cut

#: Social force and networks; those with the person himself in the sum, j = i, as printed.
OPTIONS: dict[str, CrowdOptions] = {
    "sf": SocialForceOptions(name="sf", term="social_force"),
    "nn": NetworkForceOptions(name="nn", term="network_force"),
    "nn_self": NetworkForceOptions(name="nn_self", term="network_force", self_interaction=True),
}
#: Parameters of the social force in the order of its rows.
NAMES = ("A", "k", "kappa")

#: Samples after which the horizon grows; the sequence's own length ends the list.
GROWTH = {"sf": (4, 8, 13, 26, 51), "nn": (6, 13), "nn_self": (6, 13)}
#: Steps at most each time before the horizon grows.
SHORT_STEPS = {"sf": 8, "nn": 3, "nn_self": 3}
#: Networks bear rounding to single precision and are twice as fast in it; A is too small for it.
DTYPE = {"sf": torch.float64, "nn": torch.float32, "nn_self": torch.float32}
#: Parameters below this size are varied as if they had it.
LEAST = {"sf": 1e-3, "nn": 0.1, "nn_self": 0.1}


def new_system(model: str, seed: int = 0, dtype: torch.dtype = torch.float64) -> System:
    """A model of OPTIONS at its random start."""
    return build_model(asdict(OPTIONS[model]), seed, dtype)


def system_of(model: str, row: np.ndarray | list[float]) -> System:
    """A model of OPTIONS with parameters ``row`` (K,)."""
    system = new_system(model)
    torch.nn.utils.vector_to_parameters(
        torch.as_tensor(np.array(row), dtype=torch.float64), system.parameters()
    )
    return system


def row_of(system: System) -> np.ndarray:
    """``(K,)`` the parameters of a system."""
    return torch.nn.utils.parameters_to_vector(system.parameters()).detach().double().numpy()


def calibrate(
    model: str, batch: Batch, start: np.ndarray, *, people: bool = True, grow: bool = True,
    weights: np.ndarray | None = None, steps: int = 30,
) -> Minimum:  # fmt: skip
    """Levenberg and Marquardt's method within the model's bounds.

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
        All parameters of the model and its training cost, m² s.
    """
    system = system_of(model, start)
    if not people:
        silence(system)
    dtype = DTYPE[model]
    system.to(dtype)
    number = 0
    lengths = [n for n in GROWTH[model] if n < batch.n_samples] if grow else []
    for samples in (*lengths, batch.n_samples):
        limit = steps if samples == batch.n_samples else min(steps, SHORT_STEPS[model])
        cost = EnsembleCost(system, cut(batch, samples).to(dtype=dtype), FusedSolver())
        found = least_squares(
            trajectory_residuals(cost, weights), cost.row(system).numpy(), cost.low.numpy(),
            cost.high.numpy(), steps=limit, least=LEAST[model],
        )  # fmt: skip
        cost.fill_(system, torch.from_numpy(found.row))
        number += found.evaluations
    return replace(found, row=row_of(system), evaluations=number)


def silence(system: System) -> None:
    """Let people exert no force on each other, and keep it so in calibration."""
    force = interaction(system)
    assert isinstance(force.pair, FeedForward)
    force.pair.requires_grad_(False)
    with torch.no_grad():
        for weight in force.pair.layers[-1].parameters():
            weight.zero_()


def costs(model: str, row: np.ndarray | list[float], batch: Batch) -> Tensor:
    """``(B,)`` cost of every sequence, m² s, in float64."""
    system = system_of(model, row)
    cost = EnsembleCost(system, batch, FusedSolver())
    return cost.costs(cost.row(system)[None])[0]


def named(model: str, row: np.ndarray | list[float]) -> dict[str, Any]:
    """Parameters by name, as plain lists and numbers."""
    system = system_of(model, row)
    return {
        name.removeprefix("terms.1."): value.detach().tolist()
        for name, value in system.named_parameters()
    }
