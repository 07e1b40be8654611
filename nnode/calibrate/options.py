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


class Pooling(str, Enum):
    """Whether all sequences share their parameters, see :mod:`nnode.calibrate.pooling`.

    ``pooled``: all sequences share them. ``alone``: each sequence has separate parameters.
    ``shrunk``: each sequence has separate parameters, which are shrunk towards the pooled ones
    with the strength that predicts best.
    """

    pooled = "pooled"
    alone = "alone"
    shrunk = "shrunk"


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

    name: str = MISSING  # of the solver
    # s, step; null: 0.002 for speeds and 0.1 for accelerations of vehicles, 0.0625 in crowds
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
    atol: float = 1e-8  # absolute tolerance of those, m


@dataclass
class FusedOptions(SolverOptions):
    """See :class:`nnode.simulation.FusedSolver`."""

    name: str = "fused"
    threads: int = 1  # of the compiled kernels
    cutoff: float | None = None  # m, crowds: largest distance of interactions; null: cutoff_error
    cutoff_error: float = 1e-10  # without cutoff: largest omitted social force, in units of A


@dataclass
class TrainerOptions:
    """Options of the training loop."""

    max_epochs: int = 200  # visits to all training sequences
    evaluate_every: int = 1  # epochs between costs, checkpoints and points of the curves
    # sequences whose cost selects the best checkpoint; heldout makes them part of the training
    monitor: Monitor = Monitor.train
    patience: int | None = None  # evaluations without progress before stopping; null never
    min_delta: float = 0.0  # the smallest improvement that counts as progress
    cost: Convention = Convention.integral
    pooling: Pooling = Pooling.pooled  # parameters of all sequences, or of each
    # none | auto | [T, v0]: parameters that differ between drivers, see nnode.population; auto:
    # those whose variance the data determine; null: auto for laws of second order with
    # optimizer=gauss_newton if position errors are at most 0.45 m and not smoothed, otherwise none
    drivers: Any = None
    # first speeds of training sequences: given by the data, or fitted; auto: by the noise of the
    # measurement
    start_speeds: StartSpeeds = StartSpeeds.auto
    dtype: Precision = Precision.float64
    device: Device = Device.auto
    threads: int | None = None  # of torch; null: one for traffic, all cores for crowds
    save_every: float = 30.0  # s between checkpoints within an epoch
    figure_every: int = 50  # epochs between force curves in TensorBoard; 0 draws none
