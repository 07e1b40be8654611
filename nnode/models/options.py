"""Options of every model, as dataclasses that the configuration is checked against."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from omegaconf import MISSING


class Leader(str, Enum):
    """What the first vehicle of a platoon does."""

    constant = "constant"
    measured = "measured"


@dataclass
class ModelOptions:
    """What all models share."""

    name: str = MISSING  # a label: lin, n4, sf, ...
    term: str = MISSING  # the term that is calibrated
    # named effects beside it: [{name: relative_speed, kappa: 0.3}, ...]
    effects: list[Any] = field(default_factory=list)


@dataclass
class LawOptions(ModelOptions):
    """Lin and Log: a law of the gap with physical parameters."""

    leader: Leader = Leader.constant
    v0: float = 30.0  # m/s, start
    L: float = 5.0  # m, start
    L_min: float = 2.0  # m


@dataclass
class NetworkSpeedOptions(ModelOptions):
    """N2, N4, N10: speed as a network of the gap."""

    leader: Leader = Leader.constant
    v0: float = 30.0  # m/s, start
    hidden: int = 4
    box: float | None = None  # weights stay in [-box, box]; null leaves them free


@dataclass
class CrowdOptions(ModelOptions):
    """What crowd models share."""

    tau: float = 0.5  # s
    mass: float = 1.0  # kg
    walls: bool = True
    wall_spacing: float = 0.25  # m between wall points


@dataclass
class SocialForceOptions(CrowdOptions):
    """SF. A, k, kappa start uniform on [0, 50] where null."""

    A: float | None = None  # N
    k: float | None = None  # kg/s²
    kappa: float | None = None  # kg/(m s)
    r: float = 0.25  # m
    B: float = 0.05  # m
    opposing_wall_friction: bool = False


@dataclass
class NetworkForceOptions(CrowdOptions):
    """NN: pair and wall force as networks."""

    hidden: int = 4
    box: float | None = None  # weights stay in [-box, box]; null leaves them free
