"""Calibration of the two crowd models: horizons that grow, so that no start is lost.

Over a second, forces of the paper's random starts throw people metres away, and the cost says
nothing about where to go. Over a few samples every start leads to the same valley. Each fit
therefore begins with the first samples of every sequence and follows the minimum as they grow.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares, minimize
from torch import Tensor

from nnode.calibrate.ensemble import EnsembleCost
from nnode.data.sequence import Batch
from nnode.errors import SimulationError
from nnode.models.build import build_model
from nnode.models.crowd import NetworkForce
from nnode.models.options import CrowdOptions, NetworkForceOptions, SocialForceOptions
from nnode.models.system import System
from nnode.plots.interaction import interaction
from nnode.solvers.fused.engine import FusedSolver
from nnode.study.crowd_data import cut

OPTIONS: dict[str, CrowdOptions] = {
    "sf": SocialForceOptions(name="sf", term="social_force"),
    "nn": NetworkForceOptions(name="nn", term="network_force"),
}
#: Parameters of the social force in the order of its rows.
NAMES = ("A", "k", "kappa")

#: Samples after which the horizon grows; the sequence's own length ends the list.
GROWTH = {"sf": (4, 8, 13, 26, 51), "nn": (6, 13)}

#: Pairs of steps and gradient changes that the networks' optimiser remembers.
MEMORY = 30

#: Residual (m s^1/2) of a simulation that blew up: far worse than any other.
BLOWN_UP = 1e3


@dataclass(frozen=True)
class Fit:
    """A calibrated model.

    Attributes:
        row: ``(K,)`` parameters.
        J: mean cost of a training sequence, m² s.
        evaluations: simulations of all training sequences, with a gradient or without.
    """

    row: np.ndarray
    J: float
    evaluations: int


def new_system(model: str, seed: int = 0, dtype: torch.dtype = torch.float64) -> System:
    """``sf`` or ``nn`` at its random start."""
    return build_model(asdict(OPTIONS[model]), seed, dtype)


def system_of(model: str, row: np.ndarray | list[float]) -> System:
    """``sf`` or ``nn`` with parameters ``row`` (K,)."""
    system = new_system(model)
    torch.nn.utils.vector_to_parameters(
        torch.as_tensor(np.array(row), dtype=torch.float64), system.parameters()
    )
    return system


def row_of(system: System) -> np.ndarray:
    """``(K,)`` the parameters of a system."""
    return torch.nn.utils.parameters_to_vector(system.parameters()).detach().double().numpy()


def _growing(model: str, samples: int) -> list[int]:
    return [*(n for n in GROWTH[model] if n < samples), samples]


def fit_social_force(
    batch: Batch, start: np.ndarray, *, grow: bool = True, weights: np.ndarray | None = None,
    evaluations: int = 40,
) -> Fit:  # fmt: skip
    """Levenberg and Marquardt's method within A, k, kappa >= 0.

    Args:
        batch: training sequences, float64.
        start: ``(3,)`` A, k, kappa.
        grow: begin with the first samples; False for starts next to the minimum.
        weights: ``(B,)`` weight of each sequence, of sum 1; None takes the mean.
        evaluations: accepted or refused steps per length.

    Source:
        Branch, Coleman & Li, SIAM J. Sci. Comput. 21 (1999), as in SciPy.
    """
    share = torch.full((len(batch),), 1 / len(batch)) if weights is None else torch.tensor(weights)
    row, number, solver = np.maximum(start, 1e-9), 0, FusedSolver()
    for samples in _growing("sf", batch.n_samples) if grow else [batch.n_samples]:
        part = cut(batch, samples)
        factor = (share.to(part.x) * part.dt)[None, :, None, None].sqrt()
        seen = part.valid[1:]

        def residuals(values: np.ndarray) -> np.ndarray:
            nonlocal number
            number += 1
            try:
                with torch.no_grad():
                    away = (solver(system_of("sf", values), part).x - part.x)[1:]  # noqa: B023
            except SimulationError:
                return np.full(2 * int(seen.sum()), BLOWN_UP)  # noqa: B023
            return (away * factor)[seen].flatten().numpy()  # noqa: B023

        # half the sum of squares is the cost
        found = least_squares(
            residuals, row, bounds=(0, np.inf), x_scale="jac", max_nfev=evaluations,
            ftol=1e-7, xtol=1e-7, gtol=1e-12,
        )  # fmt: skip
        row = np.maximum(found.x, 1e-9)
    return Fit(found.x, float(found.cost), number)


def fit_network(
    batch: Batch, start: np.ndarray, *, people: bool = True, grow: bool = True,
    iterations: tuple[int, int] = (40, 100),
) -> Fit:  # fmt: skip
    """L-BFGS in float32, with so long a memory that it is nearly BFGS.

    Args:
        batch: training sequences.
        start: ``(K,)`` weights of both networks.
        people: False keeps people from acting on each other: the output weights of their
            network are zero and stay so, the wall network alone is calibrated.
        grow: begin with the first samples.
        iterations: evaluations on shorter sequences, and on the whole ones.
    """
    system = system_of("nn", start)
    if not people:
        silence(system)
    number = 0
    system.to(torch.float32)
    for samples in _growing("nn", batch.n_samples) if grow else [batch.n_samples]:
        part = cut(batch, samples).to(dtype=torch.float32)
        cost = EnsembleCost(system, part, FusedSolver())
        limit = iterations[1] if samples == batch.n_samples else iterations[0]

        def value(row: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal number
            number += 1
            J, gradient = cost(torch.from_numpy(row)[None])  # noqa: B023
            if not bool(torch.isfinite(J).all() and torch.isfinite(gradient).all()):
                return BLOWN_UP**2, np.zeros_like(row)
            return float(J[0]), gradient[0].numpy()

        found = minimize(
            value, cost.row(system).numpy(), jac=True, method="L-BFGS-B",
            options={"maxiter": limit, "maxcor": MEMORY, "ftol": 1e-7, "gtol": 0.0},
        )  # fmt: skip
        cost.fill_(system, torch.from_numpy(found.x))
    return Fit(row_of(system), float(found.fun), number)


def silence(system: System) -> None:
    """Let people exert no force on each other, and keep it so in calibration."""
    force = interaction(system)
    assert isinstance(force, NetworkForce)
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
