"""Options of the models, as dataclasses that validate the configuration."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from omegaconf import MISSING


class Leader(str, Enum):
    """How the first vehicle of a platoon moves."""

    constant = "constant"
    measured = "measured"


class Desired(str, Enum):
    """Where people want to go, and how fast.

    ``last``, the paper's choice: to the last measured position, at the present speed. This gives
    the model the end of the predicted path. ``exit``: to the destinations in the data.
    ``direction``: along their stream. The last two use the preferred speed, which is measured in
    the seconds before the sequence (``data.history``), or else at its first sample.
    """

    last = "last"
    exit = "exit"
    direction = "direction"


@dataclass
class ModelOptions:
    """Options of all models."""

    name: str = MISSING  # label in results and plots: lin, n4, sf, ...
    term: str = MISSING  # the law, network or force that is calibrated
    # named effects in addition: [{name: relative_speed, kappa: 0.3}, ...]
    effects: list[Any] = field(default_factory=list)


@dataclass
class LawOptions(ModelOptions):
    """Lin and Log: a law of the gap with physical parameters."""

    leader: Leader = Leader.constant
    v0: float = 30.0  # m/s, speed on an empty road; where the search starts
    L: float = 5.0  # m, gap at which all stop; where the search starts
    L_min: float = 2.0  # m, lower bound of L


@dataclass
class FormulaOptions(ModelOptions):
    """IDM and others, and user-defined laws: a formula with its parameters and units."""

    leader: Leader = Leader.measured
    # {parameters: {v0: 30 m/s, ...}, where: {...}, rate: {v: "..."}, source: ...}
    law: Any = MISSING
    # neurons of a network NN that the law's rate calls, or that is added to it; null: none
    network: int | None = None
    box: float | None = None  # its weights stay in [-box, box]; null leaves them free
    # pedestrians: last (gives them the end of the predicted path) | exit | direction
    desired: Desired = Desired.last
    wall_spacing: float = 0.25  # m between the points that represent a wall, pedestrians


@dataclass
class NetworkSpeedOptions(ModelOptions):
    """N2, N4, N10: speed as a network of the gap."""

    leader: Leader = Leader.constant
    v0: float = 30.0  # m/s, speed of the first vehicle; where the search starts
    hidden: int = 4  # neurons in the hidden layer
    box: float | None = None  # weights stay in [-box, box]; null leaves them free


@dataclass
class CrowdOptions(ModelOptions):
    """Options of all crowd models."""

    tau: float = 0.5  # s, relaxation towards the desired velocity
    mass: float = 1.0  # kg, of a person
    walls: bool = True  # whether walls repel, if the data have some
    wall_spacing: float = 0.25  # m between the points that represent a wall
    # last (the paper's: gives people the end of the predicted path) | exit | direction
    desired: Desired = Desired.last


@dataclass
class SocialForceOptions(CrowdOptions):
    """SF, the social force model."""

    A: float | None = None  # N, repulsion at touch; null starts uniform on [0, 50]
    k: float | None = None  # kg/s², body force of overlap; null starts uniform on [0, 50]
    kappa: float | None = None  # kg/(m s), sliding friction; null starts uniform on [0, 50]
    r: float = 0.25  # m, radius of a person
    B: float = 0.05  # m, range of the repulsion
    # walls decelerate people who slide along them (Helbing et al., 2000); false: the paper's sign
    opposing_wall_friction: bool = False


@dataclass
class NetworkForceOptions(CrowdOptions):
    """NN: pair and wall force as networks."""

    hidden: int = 4  # neurons in the hidden layer of each force
    box: float | None = None  # weights stay in [-box, box]; null leaves them free
    # the mean over people contains j = i, a force NN(0, 0), as in the paper's formula
    self_interaction: bool = False
