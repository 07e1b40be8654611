"""The configuration's schema: dataclasses, registered with Hydra.

Every group file in ``conf/`` starts from one of these, so that an unknown or wrong-typed option
is refused before any work starts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from nnode.calibrate.optimizers import (
    AdadeltaOptions,
    AdamOptions,
    GaussNewtonOptions,
    LbfgsOptions,
)
from nnode.calibrate.options import (
    Device,
    FusedOptions,
    TorchdiffeqOptions,
    TrainerOptions,
)
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.readers.highd import HighDOptions
from nnode.data.readers.juelich import JuelichOptions
from nnode.data.readers.jupedsim import WalkwayOptions
from nnode.data.readers.ngsim import NgsimOptions
from nnode.data.readers.openacc import OpenAccOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.readers.sumo import SumoOptions
from nnode.data.readers.table import TableOptions
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.discover.options import DiscoverOptions
from nnode.model.laws import LAW_MODELS
from nnode.model.options import (
    FormulaOptions,
    LawOptions,
    NetworkForceOptions,
    NetworkSpeedOptions,
    SocialForceOptions,
)
from nnode.program import configuration
from studies.options import (
    CrowdStudyOptions,
    FollowingStudyOptions,
    PredictionStudyOptions,
    TrafficStudyOptions,
    WalkingStudyOptions,
)


@dataclass
class TrainConfig:
    """``nnode train``: calibrate a model to data."""

    model: Any = MISSING
    data: Any = MISSING
    solver: Any = MISSING
    optimizer: Any = MISSING
    trainer: TrainerOptions = field(default_factory=TrainerOptions)
    seed: int = 0  # of start weights, order of mini-batches and noise
    resume: str | None = None  # a checkpoint to go on from


@dataclass
class PrepareConfig:
    """``nnode prepare_data``: raw recordings to sequences."""

    data: Any = MISSING


@dataclass
class CheckConfig:
    """``nnode check``: what a file holds and what is wrong with it."""

    file: str = MISSING  # CSV, text of numbers, Parquet, or any other file that docs/data.md lists
    domain: str | None = None  # traffic | crowd; null guesses
    frame_rate: float | None = None  # 1/s, that the file is said to have; null: as it tells


@dataclass
class EvaluateConfig:
    """``nnode evaluate``: errors of a checkpoint beside its baselines."""

    checkpoint: str = MISSING  # RUN/checkpoints/best.pt
    data: Any = MISSING
    solver: Any = MISSING
    device: Device = Device.auto
    part: str = "auto"  # heldout | train | unseen | all; auto: the first there is, not train
    replay: bool = True  # replay.html: measured and simulated agents side by side


@dataclass
class ExportConfig:
    """``nnode export``: a run's results in the formats of other programs."""

    run: str = MISSING  # folder of a training or a diagnosis
    to: Any = "auto"  # jupedsim | sumo | pedpy | fcd | parquet | csv, or a list; auto: all that fit
    trajectories: str = "both"  # measured | simulated | both
    part: str = "all"  # heldout | train | unseen | all | auto
    data: Any = MISSING
    solver: Any = MISSING
    device: Device = Device.auto


@dataclass
class DriveConfig:
    """``nnode drive``: a calibrated law drives vehicles in SUMO."""

    run: str = MISSING  # folder of a training or a diagnosis
    sumo: str = MISSING  # SUMO's configuration, *.sumocfg
    vehicles: Any = MISSING  # type of the vehicles to drive, or a list of types
    program: str = "libsumo"  # libsumo | traci
    steps: str = "match"  # match | run | scenario: whose steps SUMO makes
    end: float | None = None  # s of SUMO's clock; null: the scenario's, or when all have arrived
    far: float | None = None  # m at which a vehicle ahead counts as none; null: 5000
    lengths: bool | None = None  # gaps are bumper to bumper; null: as the run's data had lengths
    lane_changes: bool = False  # whether SUMO may change lanes of driven vehicles
    seed: int = 0  # of the numbers of drivers who differ


@dataclass
class SimulateConfig:
    """``nnode simulate``: sampled motion of a calibrated model, with its scores."""

    run: str = MISSING  # folder of a training or a diagnosis
    samples: int = 99  # of every sequence, at least 39
    part: str = "auto"  # heldout | train | unseen | all; auto: the first there is, not train
    # of the samples: parquet | csv (data=table reads both) | pedpy (people) | fcd (vehicles, as
    # SUMO writes them); null: no samples
    format: str | None = "parquet"
    seed: int = 0  # of all that is drawn
    data: Any = MISSING
    solver: Any = MISSING


@dataclass
class PredictConfig:
    """``nnode predict``: followers predicted from the first seconds of their paths."""

    run: str = MISSING  # folder of a training with drivers who differ
    seconds: float = 3.0  # length of the known beginning, at least 2
    part: str = "auto"  # heldout | train | unseen | all; auto: the first there is, not train
    data: Any = MISSING


@dataclass
class PlotForcesConfig:
    """``nnode plot_forces``: what calibrated models have learned."""

    checkpoint: Any = MISSING  # one path or a list of paths
    data: Any = MISSING
    extent: float | None = None  # m, of contours; null suits the model


@dataclass
class StudyConfig:
    """``nnode study``: the paper's studies on the real recordings."""

    study: Any = MISSING


@dataclass
class DiscoverConfig:
    """``nnode discover``: what a model lacks."""

    model: Any = MISSING
    data: Any = MISSING
    discover: DiscoverOptions = field(default_factory=DiscoverOptions)


SCHEMAS: dict[tuple[str | None, str], Any] = {
    (None, "train_schema"): TrainConfig,
    (None, "prepare_data_schema"): PrepareConfig,
    (None, "check_schema"): CheckConfig,
    (None, "evaluate_schema"): EvaluateConfig,
    (None, "export_schema"): ExportConfig,
    (None, "drive_schema"): DriveConfig,
    (None, "simulate_schema"): SimulateConfig,
    (None, "predict_schema"): PredictConfig,
    (None, "plot_forces_schema"): PlotForcesConfig,
    (None, "study_schema"): StudyConfig,
    (None, "discover_schema"): DiscoverConfig,
    ("model", "lin_schema"): LawOptions(term="lin"),
    ("model", "log_schema"): LawOptions(term="log"),
    ("model", "formula_schema"): FormulaOptions(term="formula"),
    # a law is chosen by its name; its file among the laws is all that it needs
    **{
        ("model", name): FormulaOptions(name=name, **options)
        for name, options in LAW_MODELS.items()
    },
    ("model", "network_speed_schema"): NetworkSpeedOptions(term="network_speed"),
    ("model", "social_force_schema"): SocialForceOptions(term="social_force"),
    ("model", "network_force_schema"): NetworkForceOptions(term="network_force"),
    ("data", "esimas_schema"): EsimasOptions,
    ("data", "vehicles_schema"): VehicleTableOptions,
    ("data", "ngsim_schema"): NgsimOptions,
    ("data", "pairs_schema"): PairOptions,
    ("data", "openacc_schema"): OpenAccOptions,
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
    ("optimizer", "gauss_newton_schema"): GaussNewtonOptions,
    ("study", "traffic_study_schema"): TrafficStudyOptions,
    ("study", "crowd_study_schema"): CrowdStudyOptions,
    ("study", "walking_study_schema"): WalkingStudyOptions,
    ("study", "prediction_study_schema"): PredictionStudyOptions,
    ("study", "following_study_schema"): FollowingStudyOptions,
}


def choices(group: str) -> list[str]:
    """Names that a group of the configuration has: those of the files ``conf/GROUP/NAME.yaml``, and
    of the laws."""
    files = {path.stem for path in (configuration() / group).glob("*.yaml")}
    return sorted(files | {n for own, n in SCHEMAS if own == group and not n.endswith("_schema")})


@cache
def register() -> None:
    """Make all schemas known to Hydra, once in a process."""
    store = ConfigStore.instance()
    for (group, name), schema in SCHEMAS.items():
        node = OmegaConf.structured(schema)
        for key in node:
            if OmegaConf.get_type(node, key) is dict:
                # so that data.columns.time=t can be typed without the plus that Hydra asks for
                OmegaConf.set_struct(node[key], False)
        store.store(group=group, name=name, node=node)
