"""Optimisers by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from omegaconf import MISSING
from torch.optim import Optimizer

from nnode.calibrate.optimizers.adadelta import NoisyAdadelta
from nnode.calibrate.optimizers.consensus import ConsensusBased
from nnode.calibrate.optimizers.gauss_newton import GaussNewton
from nnode.errors import ConfigError
from nnode.model.system import System


@dataclass
class OptimizerOptions:
    """What all optimisers share."""

    name: str = MISSING  # of the optimiser


@dataclass
class AdadeltaOptions(OptimizerOptions):
    """The paper's: ADADELTA with decaying Gaussian noise."""

    name: str = "adadelta"
    lr: float = 1.0  # factor on the steps
    rho: float = 0.95  # memory of squared gradients and steps, below 1
    eps: float = 1e-6  # added to both under the root
    eta1: float = 1.0  # variance of the noise: eta1 / (1 + k)^eta2
    eta2: float = 0.55  # how fast the noise decays with the step k


@dataclass
class AdamOptions(OptimizerOptions):
    """Adam."""

    name: str = "adam"
    lr: float = 0.05  # step
    beta1: float = 0.9  # memory of gradients
    beta2: float = 0.999  # memory of squared gradients
    eps: float = 1e-8  # added to their root


@dataclass
class LbfgsOptions(OptimizerOptions):
    """L-BFGS with a strong Wolfe line search; wants all sequences in one mini-batch."""

    name: str = "lbfgs"
    lr: float = 1.0  # first length tried by the line search
    max_iter: int = 20  # iterations per step, which is an epoch
    history: int = 20  # steps that the curvature is taken from


@dataclass
class ConsensusOptions(OptimizerOptions):
    """Consensus-based optimisation; wants all sequences in one mini-batch."""

    name: str = "cbo"
    particles: int = 30  # parameter sets at a time
    spread: float = 0.5  # standard deviation of their start
    alpha: float = 30.0  # weight of good ones in the consensus
    drift: float = 1.0  # towards the consensus, per unit of time
    sigma: float = 2.0  # noise, by the distance from the consensus
    dt: float = 0.1  # of a step, no unit


@dataclass
class GaussNewtonOptions(OptimizerOptions):
    """Damped Gauss-Newton; formulas of lanes or people, solver=fused, all sequences at once."""

    name: str = "gauss_newton"
    damping: float = 1e-3  # of the first step, relative to each parameter's curvature
    tolerance: float = 1e-9  # ends when a step lowers the cost by less than this share


def _trained(model: System) -> list[torch.nn.Parameter]:
    return [parameter for parameter in model.parameters() if parameter.requires_grad]


def _adadelta(model: System, o: dict[str, Any], seed: int) -> Optimizer:
    return NoisyAdadelta(_trained(model), **o, seed=seed)


def _adam(model: System, o: dict[str, Any], seed: int) -> Optimizer:
    betas = (o["beta1"], o["beta2"])
    return torch.optim.Adam(_trained(model), lr=o["lr"], betas=betas, eps=o["eps"])


def _lbfgs(model: System, o: dict[str, Any], seed: int) -> Optimizer:
    for name in ("max_iter", "history"):
        if o[name] < 1:
            raise ValueError(f"{name}={o[name]} must be at least 1")
    return torch.optim.LBFGS(
        _trained(model),
        lr=o["lr"],
        max_iter=o["max_iter"],
        history_size=o["history"],
        line_search_fn="strong_wolfe",
    )


def _cbo(model: System, o: dict[str, Any], seed: int) -> Optimizer:
    return ConsensusBased(_trained(model), **o, project=model.project_, seed=seed)


def _gauss_newton(model: System, o: dict[str, Any], seed: int) -> Optimizer:
    return GaussNewton(model, **o)


#: name: how to build it, and whether it compares costs of different steps
OPTIMIZERS: dict[str, tuple[Callable[[System, dict[str, Any], int], Optimizer], bool]] = {
    "adadelta": (_adadelta, False),
    "adam": (_adam, False),
    "lbfgs": (_lbfgs, True),
    "cbo": (_cbo, True),
    "gauss_newton": (_gauss_newton, True),
}


def needs_full_batch(name: str) -> bool:
    """Whether the optimiser compares costs of different steps, so that they must be of the
    same sequences."""
    return OPTIMIZERS[name][1]


def build_optimizer(model: System, options: OptimizerOptions, seed: int = 0) -> Optimizer:
    """The optimiser that ``options`` describe; random ones depend on ``seed`` alone.

    Raises:
        ConfigError: unknown name, or a value outside its range.
    """
    values = asdict(options)
    name = values.pop("name")
    if name not in OPTIMIZERS:
        raise ConfigError(
            f"optimizer.name={name} is unknown, expected one of {', '.join(OPTIMIZERS)}"
        )
    try:
        return OPTIMIZERS[name][0](model, values, seed)
    except ValueError as error:
        raise ConfigError(f"optimizer {name}: {error}") from error
