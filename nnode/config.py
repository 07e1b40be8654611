"""The configuration's schema: dataclasses, registered with Hydra.

Every group file in ``conf/`` starts from one of these, so that an unknown or wrong-typed option
is refused before any work starts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from nnode.calibrate.optimizers import (
    AdadeltaOptions,
    AdamOptions,
    ConsensusOptions,
    LbfgsOptions,
)
from nnode.calibrate.options import (
    Device,
    FusedOptions,
    Precision,
    TorchdiffeqOptions,
    TrainerOptions,
)
from nnode.data.options import (
    EsimasOptions,
    HighDOptions,
    JuelichOptions,
    NgsimOptions,
    SumoOptions,
    TableOptions,
    VehicleTableOptions,
    WalkwayOptions,
)
from nnode.discover.options import DiscoverOptions
from nnode.models.options import (
    LawOptions,
    NetworkForceOptions,
    NetworkSpeedOptions,
    SocialForceOptions,
)
from nnode.study.options import CrowdStudyOptions, TrafficStudyOptions


@dataclass
class TrainConfig:
    """``scripts/train.py``: calibrate a model to data."""

    model: Any = MISSING
    data: Any = MISSING
    solver: Any = MISSING
    optimizer: Any = MISSING
    trainer: TrainerOptions = field(default_factory=TrainerOptions)
    seed: int = 0  # of start weights, order of mini-batches and noise
    resume: str | None = None  # a checkpoint to go on from


@dataclass
class PrepareConfig:
    """``scripts/prepare_data.py``: raw recordings to sequences."""

    data: Any = MISSING


@dataclass
class EvaluateConfig:
    """``scripts/evaluate.py``: errors of a checkpoint beside its baselines."""

    checkpoint: str = MISSING  # RUN/checkpoints/best.pt
    data: Any = MISSING
    solver: Any = MISSING
    device: Device = Device.auto
    part: str = "auto"  # heldout | train | unseen | all; auto: the first there is, not train


@dataclass
class ExportConfig:
    """``scripts/export.py``: a run's results in the formats of other programs."""

    run: str = MISSING  # folder of a training or a diagnosis
    to: Any = "auto"  # jupedsim | sumo | pedpy | parquet | csv, or a list; auto: all that fit
    trajectories: str = "both"  # measured | simulated | both
    part: str = "all"  # heldout | train | unseen | all | auto
    data: Any = MISSING
    solver: Any = MISSING
    device: Device = Device.auto


@dataclass
class PlotForcesConfig:
    """``scripts/plot_forces.py``: what calibrated models have learned."""

    checkpoint: Any = MISSING  # one path or a list of paths
    data: Any = MISSING
    extent: float | None = None  # m, of contours; null suits the model


@dataclass
class BenchmarkOptions:
    """What ``scripts/benchmark.py`` times, see :mod:`nnode.app.benchmark`."""

    # problems: paper | stress | steps | crowd | people | scale
    shapes: list[str] = field(
        default_factory=lambda: ["paper", "stress", "steps", "crowd", "people", "scale"]
    )
    engines: list[str] | None = None  # null times all that cover a problem
    repeats: int = 5  # timings of each, of which the median counts
    restarts: int = 16  # of the ensemble
    # of the timings; agreement is checked in float64
    dtype: Precision = Precision.float32
    redraw: str | None = None  # a benchmark.json to draw, and time nothing


@dataclass
class BenchmarkConfig:
    """``scripts/benchmark.py``: all engines on the same problems."""

    benchmark: BenchmarkOptions = field(default_factory=BenchmarkOptions)


@dataclass
class DiscoveryBenchmarkOptions:
    """Which truths ``scripts/benchmark_discovery.py`` hides, how strongly, in how much data."""

    domains: list[str] = field(default_factory=lambda: ["traffic", "crowd"])  # or one of them
    # what is hidden: single | pair | nothing | outside | near_miss | no_excitation | fault;
    # null: all
    arms: list[str] | None = None
    effects: list[str] | None = None  # null: all; else only cases that hide one of these
    # null: all; of nothing: white | autocorrelated | windows | heterogeneous | recording
    variants: list[str] | None = None
    seeds: int = 10  # per effect, pair or fault
    nothing_seeds: int = 400  # per variant of nothing
    first_seed: int = 0  # of the cases, while rules may still change
    # full hash of the commit that froze the rules; seeds follow from it
    seeds_of: str | None = None
    strengths: list[str] = field(default_factory=lambda: ["medium"])  # weak medium strong full
    noises: list[float] | None = None  # m; null: 0.05 in traffic, 0.01 in crowds
    sizes: list[int] = field(default_factory=lambda: [20])  # numbers of platoons or crowds
    structure: bool = True  # look for what has no name too; without, nothing is unknown
    peer_seeds: int = 3  # per effect, pair, ...: regressions on the diagnosis's library beside it
    workers: int | None = None  # processes; null: one per core


@dataclass
class DiscoveryBenchmarkConfig:
    """``scripts/benchmark_discovery.py``: the diagnosis against hidden truths."""

    benchmark_discovery: DiscoveryBenchmarkOptions = field(
        default_factory=DiscoveryBenchmarkOptions
    )


@dataclass
class StudyConfig:
    """``scripts/study.py``: the paper's studies on the real recordings."""

    study: Any = MISSING


@dataclass
class DiscoverConfig:
    """``scripts/discover.py``: what a model lacks."""

    model: Any = MISSING
    data: Any = MISSING
    discover: DiscoverOptions = field(default_factory=DiscoverOptions)


@dataclass
class TortureConfig:
    """``scripts/torture.py``: misuse on purpose."""

    # what is tried: kills | disk | folder | fuzz
    campaigns: list[str] = field(default_factory=lambda: ["kills", "disk", "folder", "fuzz"])
    kills: int = 200  # over all jobs
    jobs: list[str] | None = None  # scripts that are tortured; null: all that keep results
    repeats: int = 4  # second runs in a folder, per job
    inputs: int = 104000  # malformed files over all targets
    targets: list[str] | None = None  # what is given them; null: every reader and loader
    seed: int = 0  # of moments of kills and of malformed files


SCHEMAS: dict[tuple[str | None, str], Any] = {
    (None, "train_schema"): TrainConfig,
    (None, "prepare_data_schema"): PrepareConfig,
    (None, "evaluate_schema"): EvaluateConfig,
    (None, "export_schema"): ExportConfig,
    (None, "plot_forces_schema"): PlotForcesConfig,
    (None, "benchmark_schema"): BenchmarkConfig,
    (None, "study_schema"): StudyConfig,
    (None, "benchmark_discovery_schema"): DiscoveryBenchmarkConfig,
    (None, "discover_schema"): DiscoverConfig,
    (None, "torture_schema"): TortureConfig,
    ("model", "lin_schema"): LawOptions(term="lin"),
    ("model", "log_schema"): LawOptions(term="log"),
    ("model", "network_speed_schema"): NetworkSpeedOptions(term="network_speed"),
    ("model", "social_force_schema"): SocialForceOptions(term="social_force"),
    ("model", "network_force_schema"): NetworkForceOptions(term="network_force"),
    ("data", "esimas_schema"): EsimasOptions,
    ("data", "vehicles_schema"): VehicleTableOptions,
    ("data", "ngsim_schema"): NgsimOptions,
    ("data", "juelich_schema"): JuelichOptions,
    ("data", "table_schema"): TableOptions,
    ("data", "walkway_schema"): WalkwayOptions,
    ("data", "sumo_schema"): SumoOptions,
    ("data", "highd_schema"): HighDOptions,
    ("solver", "torchdiffeq_schema"): TorchdiffeqOptions,
    ("solver", "fused_schema"): FusedOptions,
    ("optimizer", "adadelta_schema"): AdadeltaOptions,
    ("optimizer", "adam_schema"): AdamOptions,
    ("optimizer", "lbfgs_schema"): LbfgsOptions,
    ("optimizer", "cbo_schema"): ConsensusOptions,
    ("study", "traffic_study_schema"): TrafficStudyOptions,
    ("study", "crowd_study_schema"): CrowdStudyOptions,
}


def register() -> None:
    """Make all schemas known to Hydra; harmless when repeated."""
    store = ConfigStore.instance()
    for (group, name), node in SCHEMAS.items():
        store.store(group=group, name=name, node=node)
