"""Options of solving and training, as dataclasses that the configuration is checked against."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

from omegaconf import MISSING

from nnode.calibrate.cost import Convention


class Gradient(str, Enum):
    """Which gradient the solver gives."""

    adjoint = "adjoint"
    discrete = "discrete"


class Precision(str, Enum):
    """Floating-point type of the calculation."""

    float32 = "float32"
    float64 = "float64"


class Device(str, Enum):
    """Where the calculation runs; auto is a CUDA device if torch finds one."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Monitor(str, Enum):
    """Whose cost decides which checkpoint is best and when to stop early."""

    train = "train"
    heldout = "heldout"


class Pooling(str, Enum):
    """Whether all sequences share their parameters.

    See :mod:`nnode.calibrate.pooling`.

    ``pooled``: they do. ``alone``: each has its own. ``shrunk``: each has its own, drawn towards
    those of all as far as this predicts better.
    """

    pooled = "pooled"
    alone = "alone"
    shrunk = "shrunk"


class StartSpeeds(str, Enum):
    """First speeds of training sequences: the data's, or fitted beside the parameters.

    ``auto``: where noise makes the data's wrong by more than :data:`nnode.data.smooth.BEARABLE`,
    vehicles' speeds are those of smoothed paths, and gauss_newton fits the first ones of laws of
    second order; otherwise they are given.
    """

    auto = "auto"
    given = "given"
    fitted = "fitted"


@dataclass
class SolverOptions:
    """What all solvers share."""

    name: str = MISSING  # of the solver
    # s, step; null: 0.002 for speeds and 0.1 for accelerations of vehicles, 0.0625 in crowds
    dt: float | None = None
    # euler, ballistic, semi_implicit, rk4, or others of torchdiffeq; null: the law's own, rk4 for
    # smooth laws of the field, ballistic for other accelerations of vehicles, otherwise euler
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
    cutoff: float | None = None  # m, crowds: who is farther away is not felt; null: by cutoff_error
    cutoff_error: float = 1e-10  # without cutoff: largest social force left out, in units of A


@dataclass
class TrainerOptions:
    """How long to train, what to watch, what to keep."""

    max_epochs: int = 200  # visits to all training sequences
    evaluate_every: int = 1  # epochs between costs, checkpoints and points of the curves
    # whose cost chooses the best checkpoint; heldout makes it a training quantity
    monitor: Monitor = Monitor.train
    patience: int | None = None  # evaluations without progress before stopping; null never
    min_delta: float = 0.0  # the least improvement that counts as progress
    cost: Convention = Convention.integral
    pooling: Pooling = Pooling.pooled  # parameters of all sequences, or of each
    # none | auto | [T, v0]: parameters that differ between drivers, see nnode.population; auto:
    # those of which the data tell how they differ; null: auto for laws of second order with
    # optimizer=gauss_newton where errors of positions are 0.015 to 0.45 m, otherwise none
    drivers: Any = None
    # first speeds of training sequences, those of the data, or the best; auto: as the noise of the
    # measurement asks for
    start_speeds: StartSpeeds = StartSpeeds.auto
    dtype: Precision = Precision.float64
    device: Device = Device.auto
    threads: int | None = None  # of torch; null: one for traffic, all cores for crowds
    save_every: float = 30.0  # s between checkpoints within an epoch
    figure_every: int = 50  # epochs between force curves in TensorBoard; 0 draws none
