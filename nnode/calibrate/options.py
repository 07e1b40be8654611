"""Options of solvers and training, as dataclasses that validate the configuration."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

from omegaconf import MISSING

from nnode.calibrate.cost import Convention


class Gradient(str, Enum):
    """The gradient that the solver computes."""

    adjoint = "adjoint"
    discrete = "discrete"


class Precision(str, Enum):
    """Floating-point type of the calculation."""

    float32 = "float32"
    float64 = "float64"


class Device(str, Enum):
    """The device of the calculation; auto is a CUDA device if torch finds one."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Monitor(str, Enum):
    """The sequences whose cost selects the best checkpoint and stops training early."""

    train = "train"
    heldout = "heldout"


class StartSpeeds(str, Enum):
    """First speeds of training sequences: from the data, or fitted with the parameters.

    ``auto``: if noise makes the data's speeds wrong by more than
    :data:`nnode.data.smooth.BEARABLE`, vehicles' speeds are those of smoothed paths, and
    gauss_newton fits the first speeds for laws of second order. Otherwise they are given.
    """

    auto = "auto"
    given = "given"
    fitted = "fitted"


@dataclass
class SolverOptions:
    """Options of all solvers."""

    name: str = MISSING  # name of the solver
    # step, s; null: 0.002 for speeds and 0.1 for accelerations of vehicles, 0.0625 in crowds
    dt: float | None = None
    # euler, ballistic, semi_implicit, rk4, or others of torchdiffeq; null: the law's method, rk4
    # for smooth laws, ballistic for other accelerations of vehicles, otherwise euler
    method: str | None = None


@dataclass
class TorchdiffeqOptions(SolverOptions):
    """See :class:`nnode.simulation.TorchdiffeqSolver`."""

    name: str = "torchdiffeq"
    gradient: Gradient = Gradient.adjoint
    rtol: float = 1e-6  # relative tolerance of methods that choose their steps
    atol: float = 1e-8  # absolute tolerance of methods that choose their steps, m


@dataclass
class FusedOptions(SolverOptions):
    """See :class:`nnode.simulation.FusedSolver`."""

    name: str = "fused"
    threads: int = 1  # number of threads of the compiled kernels
    # crowds: largest distance of interactions, m; null: by cutoff_error
    cutoff: float | None = None
    cutoff_error: float = 1e-10  # without cutoff: largest omitted social force, in units of A


@dataclass
class TrainerOptions:
    """Options of the training loop."""

    max_epochs: int = 200  # visits to all training sequences
    evaluate_every: int = 1  # epochs between costs, checkpoints and points of the curves
    # sequences whose cost selects the best checkpoint; heldout makes them part of the training
    monitor: Monitor = Monitor.train
    # evaluations without progress before the training stops; null: no limit
    patience: int | None = None
    min_delta: float = 0.0  # smallest decrease of the cost that counts as progress
    cost: Convention = Convention.integral
    # none | auto | [T, v0] | alone: parameters that differ between drivers, see nnode.population;
    # auto: those whose variance the data determine; alone: a separate calibration of each sequence;
    # null: auto for laws of second order with optimizer=gauss_newton unless positions were smoothed
    # or have large errors, otherwise none
    drivers: Any = None
    # first speeds of training sequences: given by the data, or fitted; auto: depending on the noise
    # of the measurement
    start_speeds: StartSpeeds = StartSpeeds.auto
    dtype: Precision = Precision.float64
    device: Device = Device.auto
    # number of torch's threads; null: one for traffic, one per core for crowds
    threads: int | None = None
    save_every: float = 30.0  # time between checkpoints within an epoch, s
    figure_every: int = 50  # epochs between force curves in TensorBoard; 0: no curves
