"""Optimisers of the training loop, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from omegaconf import MISSING
from torch.optim import Optimizer

from nnode.calibrate.optimizers.adadelta import NoisyAdadelta
from nnode.calibrate.optimizers.gauss_newton import GaussNewton
from nnode.calibrate.parameters import ParameterVector
from nnode.errors import ConfigError, unknown_value
from nnode.model.system import System


@dataclass
class OptimizerOptions:
    """Options of all optimisers."""

    name: str = MISSING  # name of the optimiser


@dataclass
class AdadeltaOptions(OptimizerOptions):
    """The paper's optimiser: ADADELTA with decaying Gaussian noise."""

    name: str = "adadelta"
    lr: float = 1.0  # factor on the steps
    rho: float = 0.95  # memory of squared gradients and steps, below 1
    eps: float = 1e-6  # constant that is added to both averages
    eta1: float = 1.0  # variance of the noise: eta1 / (1 + k)^eta2
    eta2: float = 0.55  # exponent of the decay of the noise with the step k


@dataclass
class AdamOptions(OptimizerOptions):
    """Adam."""

    name: str = "adam"
    lr: float = 0.05  # step
    beta1: float = 0.9  # memory of gradients
    beta2: float = 0.999  # memory of squared gradients
    eps: float = 1e-8  # constant that is added to the root of the average square


@dataclass
class LbfgsOptions(OptimizerOptions):
    """L-BFGS with a strong Wolfe line search; requires all sequences in one mini-batch."""

    name: str = "lbfgs"
    lr: float = 1.0  # first step length of the line search
    max_iter: int = 20  # iterations per step, which is an epoch
    history: int = 20  # number of steps from which the curvature is estimated


@dataclass
class GaussNewtonOptions(OptimizerOptions):
    """Damped Gauss-Newton; formulas of lanes or people, solver=fused, all sequences at once."""

    name: str = "gauss_newton"
    damping: float = 1e-3  # damping of the first step, relative to each parameter's curvature
    tolerance: float = 1e-9  # relative decrease of the cost per step at which the calibration ends


def _trained(model: System) -> list[torch.nn.Parameter]:
    return list(ParameterVector(model).parameters.values())


def _lbfgs(model: System, o: dict[str, Any]) -> Optimizer:
    for name in ("max_iter", "history"):
        if o[name] < 1:
            raise ValueError(f"{name}={o[name]} must be at least 1")
    history = o.pop("history")
    line = {"history_size": history, "line_search_fn": "strong_wolfe"}
    return torch.optim.LBFGS(_trained(model), **o, **line)


#: Name to a function that builds the optimiser from a model, options and a seed.
OPTIMIZERS: dict[str, Callable[[System, dict[str, Any], int], Optimizer]] = {
    "adadelta": lambda model, o, seed: NoisyAdadelta(_trained(model), **o, seed=seed),
    "adam": lambda model, o, _: torch.optim.Adam(
        _trained(model), betas=(o.pop("beta1"), o.pop("beta2")), **o
    ),
    "lbfgs": lambda model, o, _: _lbfgs(model, o),
    "gauss_newton": lambda model, o, _: GaussNewton(model, **o),
}


def needs_full_batch(name: str) -> bool:
    """Whether the optimiser compares costs of different steps, which requires the same sequences
    in every step."""
    return name in ("lbfgs", "gauss_newton")


def build_optimizer(model: System, options: OptimizerOptions, seed: int = 0) -> Optimizer:
    """Build the optimiser that ``options`` describe. Random optimisers depend only on ``seed``.

    Raises:
        ConfigError: an unknown name, or a value outside its range.
    """
    values = asdict(options)
    name = values.pop("name")
    if name not in OPTIMIZERS:
        raise unknown_value("optimizer.name", name, OPTIMIZERS)
    try:
        return OPTIMIZERS[name](model, values, seed)
    except ValueError as error:
        raise ConfigError(f"optimizer {name}: {error}") from error
