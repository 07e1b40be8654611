"""Options of the studies, as dataclasses that the configuration is checked against."""

from __future__ import annotations

from dataclasses import dataclass, field

from omegaconf import MISSING


@dataclass
class StudyOptions:
    """What all studies share."""

    name: str = MISSING  # traffic | crowd | following
    source: str | None = None  # folder with the raw files; null downloads
    download: str | None = None  # folder for downloaded files; null: raw/ in the study's folder
    quick: bool = False  # few restarts, few resamples: shows that all works, no figures to cite
    workers: int | None = None  # processes; null: one per core
    # address of a Dask scheduler, such as tcp://host:8786, whose workers do the work instead
    cluster: str | None = None
    seed: int = 0  # of start parameters and of resampling


@dataclass
class TrafficStudyOptions(StudyOptions):
    """Five models on the ten ESIMAS recordings."""

    name: str = "traffic"
    restarts: int = 32  # starts of n4 on the largest recording; smaller ones get more
    iterations: int = 150  # evaluations of the first search
    dt: float = 0.002  # Euler step, s
    box: float = 1.0  # bound on the weights where its effect is studied
    bootstrap: int = 100  # resamples of the sequences
    folds: int = 5  # of cross-validation
    descent_steps: int = 1500  # updates of the paper's optimiser
    descent_dt: float = 0.01  # Euler step during its updates, s
    descent_lr: float = 1.0  # factor on them
    batch_size: int = 32  # sequences in its mini-batches
    particles: int = 40  # of consensus-based optimisation
    consensus_steps: int = 60  # of that


@dataclass
class CrowdStudyOptions(StudyOptions):
    """Social force and networks on two-way flows in a corridor."""

    name: str = "crowd"
    restarts: int = 8  # start parameters per model; the better half goes on to longer horizons
    horizons: list[float] = field(default_factory=lambda: [1.0, 2.0, 3.0, 5.0])  # s
    folds: int = 4  # blocks of time, each held out once
    steps: int = 4  # of the networks by Levenberg and Marquardt's method, at each length
    bootstrap: int = 100  # resamples of stretches of time
    cuts: int = 25  # first frames, within a second, from which open conventions cut sequences


@dataclass
class WalkingStudyOptions(StudyOptions):
    """Laws of people that the field uses, on two-way flows of other runs."""

    name: str = "walking"
    horizons: list[float] = field(default_factory=lambda: [1.0, 2.0, 3.0, 4.0, 5.0])  # s
    folds: int = 2  # groups of runs, each held out once


@dataclass
class FollowingStudyOptions(StudyOptions):
    """Laws of car following on pairs and platoons with published results."""

    name: str = "following"
    restarts: int = 4  # starts of every calibration; networks get as many
    folds: int = 5  # of cross-validation, by cluster


@dataclass
class PredictionStudyOptions(StudyOptions):
    """Laws beside published predictions of followers and of people in the open."""

    name: str = "prediction"
    restarts: int = 6  # starts of every law of car following beside its own
