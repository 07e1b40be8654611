"""Options of every data source, as dataclasses that the configuration is checked against."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from omegaconf import MISSING


class Faults(str, Enum):
    """What becomes of sequences in which a fault of the measurement was found."""

    drop = "drop"
    keep = "keep"
    error = "error"


class SplitMode(str, Enum):
    """How held-out sequences are chosen: see :mod:`nnode.data.split`."""

    auto = "auto"
    random = "random"
    block = "block"


@dataclass
class SplitOptions:
    """Which sequences are held out from training."""

    heldout: float = 0.2  # share of the sequences, 0 keeps all for training
    mode: SplitMode = SplitMode.auto
    seed: int = 0


@dataclass
class LoaderOptions:
    """How prepared sequences are streamed as mini-batches."""

    batch_size: int = 32  # sequences per mini-batch; 0 takes all at once
    workers: int = 0
    shuffle: bool = True


@dataclass
class DataOptions:
    """What all data sources share."""

    name: str = MISSING
    domain: str = MISSING  # traffic | crowd
    source: str | None = None  # folder with the raw files, or a URL; null downloads
    prepared: str | None = None  # folder that prepare_data wrote; null prepares on the fly
    recording: Any = "all"  # "all", a name, or a list of names
    faults: Faults = Faults.drop
    split: SplitOptions = field(default_factory=SplitOptions)
    loader: LoaderOptions = field(default_factory=LoaderOptions)


@dataclass
class EsimasOptions(DataOptions):
    """The preprocessed ESIMAS sequences (.mat)."""

    name: str = "esimas"
    domain: str = "traffic"
    min_vehicles: int = 3  # 2 or 3: which of the two published families


@dataclass
class VehicleTableOptions(DataOptions):
    """A table with one row per vehicle and time (CSV or Parquet)."""

    name: str = "vehicles"
    domain: str = "traffic"
    path: str = MISSING
    columns: dict[str, str | None] = field(default_factory=dict)  # vehicle, time, lane, x, ...
    position_unit: str = "m"  # m | ft | cm | km
    time_unit: str = "s"  # s | ms | frame
    frame_rate: float | None = None  # 1/s, with time_unit=frame
    lane: Any = None  # a lane, a list of lanes; null where the table has no lane column
    direction: int = 1  # -1 where positions fall as vehicles drive on
    dt: float = 0.2  # reference time grid, s
    min_vehicles: int = 3
    min_samples: int = 3
    window: float | None = None  # s; null: maximal intervals with the same vehicles in view


@dataclass
class JuelichOptions(DataOptions):
    """Trajectory text files of the Jülich archive: id frame x y z."""

    name: str = "juelich"
    domain: str = "crowd"
    t_seq: float = 1.0  # s
    frame_rate: float | None = None  # 1/s; null reads it from the file's header
    unit: str = "cm"  # cm | m
    walking_axis: str = "x"  # x | y; walls run along it
    walls: dict[str, list[float]] = field(default_factory=dict)  # recording: [low, high], m
    view: list[float] | None = None  # [from, to] along the walking axis, m; null takes all
    min_agents: int = 1


@dataclass
class TableOptions(DataOptions):
    """A user's own tidy table: sequence, time, agent, x[, y][, ...], SI units."""

    name: str = "table"
    path: str = MISSING
    walls: str | None = None  # CSV with x1, y1, x2, y2 (m)
