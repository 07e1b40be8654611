"""Options of the studies, as dataclasses that the configuration is checked against."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, fields, replace
from typing import Any

from omegaconf import MISSING

from nnode.errors import ConfigError


def option(default: Any, *, quick: Any = None, minimum: float | None = None) -> Any:
    """A field with its value in a quick study and its limit.

    Args:
        quick: None keeps the value.
        minimum: of the value, or of every value of a list; None: they must be positive.
    """
    metadata = {"quick": quick, "minimum": minimum}
    return field(default_factory=lambda: copy.copy(default), metadata=metadata)


@dataclass
class StudyOptions:
    """What all studies share."""

    name: str = MISSING  # traffic | crowd | following | walking | prediction
    source: str | None = None  # folder with the raw files; null downloads
    download: str | None = None  # folder for downloaded files; null: raw/ in the study's folder
    quick: bool = False  # few restarts, few resamples: shows that all works, no figures to cite
    workers: int | None = option(None, minimum=1)  # processes; null: one per core
    # address of a Dask scheduler, such as tcp://host:8786, whose workers do the work instead
    cluster: str | None = None
    seed: int = 0  # of start parameters and of resampling


@dataclass
class TrafficStudyOptions(StudyOptions):
    """Five models on the ten ESIMAS recordings."""

    name: str = "traffic"
    # starts of n4 on the largest recording; smaller ones get more
    restarts: int = option(32, quick=4, minimum=1)
    iterations: int = option(150, quick=30, minimum=3)  # evaluations of the first search
    dt: float = option(0.002)  # Euler step, s
    box: float = option(1.0)  # bound on the weights where its effect is studied
    bootstrap: int = option(100, quick=10, minimum=2)  # resamples of the sequences
    folds: int = option(5, quick=2, minimum=2)  # of cross-validation
    descent_steps: int = option(1500, quick=30, minimum=1)  # updates of the paper's optimiser
    descent_dt: float = option(0.01)  # Euler step during its updates, s
    descent_lr: float = option(1.0)  # factor on them
    batch_size: int = option(32, minimum=0)  # sequences in its mini-batches; 0: all


@dataclass
class CrowdStudyOptions(StudyOptions):
    """Social force and networks on two-way flows in a corridor."""

    name: str = "crowd"
    # start parameters per model; the better half goes on to longer horizons
    restarts: int = option(8, quick=1, minimum=1)
    horizons: list[float] = option([1.0, 2.0, 3.0, 5.0], quick=slice(0, 3, 2))  # s
    folds: int = option(4, quick=2, minimum=2)  # blocks of time, each held out once
    # of the networks by Levenberg and Marquardt's method, at each length
    steps: int = option(4, quick=1, minimum=1)
    bootstrap: int = option(100, quick=4, minimum=2)  # resamples of stretches of time


@dataclass
class WalkingStudyOptions(StudyOptions):
    """Laws of people that the field uses, on two-way flows of other runs."""

    name: str = "walking"
    horizons: list[float] = option([1.0, 2.0, 3.0, 4.0, 5.0], quick=slice(1))  # s
    folds: int = option(2, quick=2, minimum=2)  # groups of runs, each held out once


@dataclass
class FollowingStudyOptions(StudyOptions):
    """Laws of car following on pairs and platoons with published results."""

    name: str = "following"
    # starts of every calibration; networks get as many
    restarts: int = option(4, quick=1, minimum=1)
    folds: int = option(5, quick=2, minimum=2)  # of cross-validation, by cluster


@dataclass
class PredictionStudyOptions(StudyOptions):
    """Laws beside published predictions of followers and of people in the open."""

    name: str = "prediction"
    restarts: int = 6  # starts of every law of car following beside its own


def checked(options: StudyOptions) -> StudyOptions:
    """Options within their limits, those of a quick study where it is one; lists ascend.

    Raises:
        ConfigError: an option out of its range.
    """
    changed: dict[str, Any] = {}
    for item in fields(options):
        value, limit = getattr(options, item.name), item.metadata
        if not limit or value is None:
            continue
        values = sorted(set(value)) if isinstance(value, list) else [value]
        minimum = limit["minimum"]
        if not values or (values[0] <= 0 if minimum is None else values[0] < minimum):
            what = "positive" if minimum is None else f"at least {minimum:g}"
            raise ConfigError(f"study.{item.name}={value} must be {what}")
        quick = limit["quick"] if options.quick else None
        if isinstance(value, list):
            changed[item.name] = values if quick is None else values[quick]
        elif quick is not None:
            changed[item.name] = quick
    return replace(options, **changed)
