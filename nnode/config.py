"""The configuration's schemas: dataclasses that are registered with Hydra.

Every group file in ``conf/`` starts from one of them, so an unknown option or a value of the wrong
type is refused before any work starts. The comments are the texts of ``--help``.
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
from nnode.diagnosis.options import DiscoverOptions
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
    seed: int = 0  # seed of start weights, of the order of mini-batches and of noise
    resume: str | None = None  # checkpoint of a stopped run, which is continued


@dataclass
class PrepareConfig:
    """``nnode prepare_data``: conversion of raw recordings to sequences."""

    data: Any = MISSING


@dataclass
class CheckConfig:
    """``nnode check``: content and problems of a file."""

    file: str = MISSING  # CSV, text of numbers, Parquet, or another format in docs/data.md
    domain: str | None = None  # traffic | crowd; null recognises the domain
    frame_rate: float | None = None  # frames per second, 1/s; null reads the rate from the file


@dataclass
class EvaluateConfig:
    """``nnode evaluate``: errors of a checkpoint and of baselines."""

    checkpoint: str = MISSING  # folder of a run, or a checkpoint such as RUN/checkpoints/best.pt
    data: Any = MISSING
    solver: Any = MISSING
    device: Device = Device.auto
    part: str = "auto"  # heldout | train | unseen | all; auto: the first that exists, except train
    # whether replay.html is written, an animation of measured and simulated agents
    replay: bool = True


@dataclass
class ExportConfig:
    """``nnode export``: a run's results in the formats of other programs."""

    run: str = MISSING  # folder of a training or a diagnosis
    # jupedsim | sumo | pedpy | fcd | parquet | csv, or a list; auto: all formats that fit the model
    to: Any = "auto"
    trajectories: str = "both"  # measured | simulated | both
    part: str = "all"  # heldout | train | unseen | all | auto
    data: Any = MISSING
    solver: Any = MISSING
    device: Device = Device.auto


@dataclass
class DriveConfig:
    """``nnode drive``: control of vehicles in SUMO by a calibrated law."""

    run: str = MISSING  # folder of a training or a diagnosis
    sumo: str = MISSING  # SUMO's configuration, *.sumocfg
    vehicles: Any = MISSING  # type of the controlled vehicles, or a list of types
    program: str = "libsumo"  # libsumo (in this process) | traci (in another process)
    # match: the scenario must have the run's steps | run: SUMO uses the run's steps |
    # scenario: SUMO uses the scenario's steps
    steps: str = "match"
    # end on SUMO's clock, s; null: the scenario's end, or the arrival of all vehicles
    end: float | None = None
    far: float | None = None  # distance beyond which a vehicle ahead is ignored, m; null: 5000
    # whether gaps are bumper to bumper; null: if the run's data had lengths of vehicles
    lengths: bool | None = None
    lane_changes: bool = False  # whether SUMO may change the lanes of controlled vehicles
    seed: int = 0  # seed of random drivers


@dataclass
class SimulateConfig:
    """``nnode simulate``: sampled motion of a calibrated model, with scores."""

    run: str = MISSING  # folder of a training or a diagnosis
    samples: int = 99  # number of samples of every sequence, at least 39
    part: str = "auto"  # heldout | train | unseen | all; auto: the first that exists, except train
    # format of the samples: parquet | csv (both are read by data=table) | pedpy (people) | fcd
    # (vehicles, SUMO's floating car data); null writes no samples
    format: str | None = "parquet"
    seed: int = 0  # seed of all random numbers
    data: Any = MISSING
    solver: Any = MISSING


@dataclass
class PredictConfig:
    """``nnode predict``: prediction of followers from the first seconds of their paths."""

    run: str = MISSING  # folder of a training with drivers who differ
    seconds: float = 3.0  # length of the known beginning, at least 2
    part: str = "auto"  # heldout | train | unseen | all; auto: the first that exists, except train
    data: Any = MISSING


@dataclass
class PlotForcesConfig:
    """``nnode plot_forces``: forces and speed curves of calibrated models."""

    checkpoint: Any = MISSING  # folder of a run or a checkpoint, or a list of these
    data: Any = MISSING
    # half width of the contour plots, m; null: a width that suits the model
    extent: float | None = None


@dataclass
class StudyConfig:
    """``nnode study``: the paper's studies on the real recordings."""

    study: Any = MISSING


@dataclass
class DiscoverConfig:
    """``nnode discover``: diagnosis of a model."""

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
    # laws of the package need no file in conf/model
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
    """The names in a group of the configuration: those of the files ``conf/GROUP/NAME.yaml``, and
    those of the laws."""
    files = {path.stem for path in (configuration() / group).glob("*.yaml")}
    return sorted(
        files | {n for section, n in SCHEMAS if section == group and not n.endswith("_schema")}
    )


@cache
def register() -> None:
    """Register all schemas with Hydra, once in a process."""
    store = ConfigStore.instance()
    for (group, name), schema in SCHEMAS.items():
        node = OmegaConf.structured(schema)
        for key in node:
            if OmegaConf.get_type(node, key) is dict:
                # allows data.columns.time=t without the plus sign that Hydra would require
                OmegaConf.set_struct(node[key], False)
        store.store(group=group, name=name, node=node)
