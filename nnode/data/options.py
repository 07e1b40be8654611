"""Options of every data source, as dataclasses that the configuration is checked against."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar

from omegaconf import MISSING

from nnode.errors import ConfigError


class Faults(str, Enum):
    """What becomes of sequences in which a fault of the measurement was found."""

    drop = "drop"
    keep = "keep"
    error = "error"


#: Whose name an identifier is, see :mod:`nnode.data.identity`: ``auto`` looks at what it names,
#: ``sequence`` takes it for another agent in every sequence, ``global`` for one agent throughout
#: its recording. Not written as a class: ``global`` is a word of Python's own.
Agents = Enum(
    "Agents",
    {"auto": "auto", "sequence": "sequence", "global": "global"},
    type=str,
    module=__name__,
)


class SplitMode(str, Enum):
    """How held-out sequences are chosen, see docs/data.md."""

    auto = "auto"
    random = "random"
    block = "block"
    published = "published"


class Gaps(str, Enum):
    """What becomes of a record whose equally spaced times have a gap."""

    cut = "cut"
    error = "error"


class Velocity(str, Enum):
    """Finite difference that velocities are computed with.

    ``forward`` looks only at the positions of the sequence itself; ``central`` and ``backward``
    use the neighbouring frames of the whole trajectory where there are such.
    """

    forward = "forward"
    central = "central"
    backward = "backward"


class Starts(str, Enum):
    """Speeds with which simulations start: the data's own, or those of :mod:`nnode.data.smooth`."""

    measured = "measured"
    smoothed = "smoothed"


@dataclass
class SplitOptions:
    """Which sequences are held out from training."""

    heldout: float = 0.2  # share of the sequences, 0 keeps all for training
    mode: SplitMode = SplitMode.auto
    seed: int = 0  # of a random split
    gap: float = 5.0  # s; without identifiers, sequences closer in time may share an agent


@dataclass
class LoaderOptions:
    """How prepared sequences are streamed as mini-batches."""

    batch_size: int = 32  # at most so many sequences per mini-batch; 0 takes all at once
    workers: int = 0  # processes that load; 0 loads in the training's own
    shuffle: bool = True  # a new order in every epoch


@dataclass
class DataOptions:
    """What all data sources share."""

    #: Whether the data are those of the paper, whose faults are judged as there.
    published: ClassVar[bool] = False

    name: str = MISSING  # label in results and plots
    domain: str = MISSING  # traffic (positions x) | crowd (x and y)
    # folder with the raw files, or a URL; NNODE_DATA in the environment sets that of public data;
    # null downloads those
    source: str | None = None
    download: str | None = None  # folder for downloaded files; null: raw/ in the run's folder
    prepared: str | None = None  # folder that prepare_data wrote; null prepares on the fly
    recording: Any = "all"  # "all", a name, or a list of names
    faults: Faults = Faults.drop
    # s; missing samples are interpolated where no more time than this is missing, longer holes cut
    # a record in two; 0: nothing is interpolated
    fill: float = 0.5
    # s, window of the local cubics that smooth positions and give speeds; null: as measured
    smooth: float | None = None
    # whether one identifier in two sequences of a recording is one agent
    agents: Agents = Agents.auto
    # speeds at the first sample, with which simulations start; smoothed: those of parabolas through
    # the first 2 s of positions
    start_speeds: Starts = Starts.measured
    split: SplitOptions = field(default_factory=SplitOptions)
    loader: LoaderOptions = field(default_factory=LoaderOptions)


@dataclass
class EsimasOptions(DataOptions):
    """The preprocessed ESIMAS sequences (.mat)."""

    published: ClassVar[bool] = True

    name: str = "esimas"
    domain: str = "traffic"
    fill: float = 0.0  # the published sequences as they are
    min_vehicles: int = 3  # 2 or 3: which of the two published families


@dataclass
class LaneOptions(DataOptions):
    """How vehicles' rows become platoons, whatever file they come from."""

    domain: str = "traffic"
    path: str = MISSING  # the file; relative to data.source where that is given
    kinds: Any = field(default_factory=dict)  # {class code: name}; codes may be numbers
    lane: Any = None  # a lane or a list of lanes; null takes every lane, each by itself
    dt: float = 0.2  # reference time grid, s
    min_vehicles: int = 3  # fewest vehicles of a platoon
    min_samples: int = 3  # fewest points of the time grid
    window: float | None = None  # s; null: maximal intervals with the same vehicles in view
    # whether every follower and its leader are a sequence of their own, min_vehicles aside
    pairs: bool = False


@dataclass
class NgsimOptions(LaneOptions):
    """NGSIM's public trajectories of freeways, in feet and ms, as they are published."""

    name: str = "ngsim"


@dataclass
class VehicleTableOptions(LaneOptions):
    """A table with one row per vehicle and time (CSV or Parquet).

    ``columns`` names the table's columns by what they mean: ``vehicle``, ``time``, ``x``, and
    where they exist ``lane``, ``speed``, ``length``, ``kind``, ``recording``, ``sequence``.
    Vehicles of two recordings or sequences never meet. A column that bears the name of its meaning
    need not be listed; null leaves an optional one out.
    """

    name: str = "vehicles"
    # {vehicle: its column, time: ..., x: ...} and lane, speed, length, kind, recording, sequence
    # where they exist
    columns: dict[str, str | None] = field(default_factory=dict)
    position_unit: str = "m"  # m | ft | cm | km
    length_unit: str | None = None  # null: the unit of the positions
    speed_unit: str = "m/s"  # m/s | km/h | ft/s | mph
    time_unit: str = "s"  # s | ms | us | ns | frame; dates and durations need none
    frame_rate: float | None = None  # 1/s, with time_unit=frame
    direction: int = 1  # -1 where positions fall as vehicles drive on


@dataclass
class PairOptions(DataOptions):
    """Pairs of a follower and its leader: one row per pair and time, in one file or many.

    ``columns`` names the tables' columns by what they mean: ``time``, ``x_follower``,
    ``x_leader`` (or, in their place, ``spacing`` and both speeds), and where they exist ``pair``,
    ``v_follower``, ``v_leader``, ``leader_length``,
    ``follower_length``, ``spacing`` (bumper to bumper), ``follower``, ``leader`` (identifiers),
    ``run``, ``lane``, ``split`` (train, test), ``leader_kind``, ``follower_kind``. A column that
    bears the name of its meaning need not be listed; null leaves an optional one out.
    """

    name: str = "pairs"
    domain: str = "traffic"
    path: str = MISSING  # a file, or a folder of files; relative to data.source where that is given
    # patterns of the files of a folder, of which the first that fits any is taken
    files: list[str] = field(default_factory=lambda: ["**/*.csv", "**/*.parquet"])
    columns: dict[str, str | None] = field(default_factory=dict)  # {meaning: column}
    # a table in that folder with a row per file: path, and meanings that the files have no columns
    # of; where it is there, no other file is read
    index: str | None = None
    # a regular expression, searched for in a file's path below the folder: its named groups are
    # meanings that the file has no column of
    pattern: str | None = None
    constant: dict[str, str] = field(default_factory=dict)  # {meaning: its value in every row}
    position_unit: Any = "m"  # m | ft | cm | km, or by pattern of the file's name {"*.csv": ft}
    speed_unit: Any = "m/s"  # m/s | km/h | ft/s | mph, or by pattern of the file's name
    time_unit: str = "s"  # s | ms | us | ns | frame; dates and durations need none
    frame_rate: float | None = None  # 1/s, with time_unit=frame
    # m, of leaders where the table has neither positions nor lengths; the gap does not depend on it
    length: float | None = 5.0
    kinds: Any = field(default_factory=dict)  # {class code: name}
    lane: Any = None  # a lane or a list of lanes; null takes every lane
    dt: float | None = None  # s, grid to interpolate to; null: the times as they are
    gaps: Gaps = Gaps.cut  # what becomes of a gap in the times of a pair
    window: float | None = None  # s, length of a sequence; null: a pair is as long as it is
    min_samples: int = 3  # fewest times of a sequence


@dataclass
class OpenAccOptions(DataOptions):
    """Platoons on test tracks of OpenACC: speeds, and gaps from bumper to bumper.

    Of each vehicle is known: ``make``, ``setting`` (the distance setting of the adaptive cruise
    control, ``none`` for people), ``acc`` (``ACC`` or ``people``), ``order`` (1 leads).
    """

    name: str = "openacc"
    domain: str = "traffic"
    # a file, or a folder of files, relative to data.source where that is given; null: the published
    path: str | None = None
    # patterns of the files of a folder, of which the first that fits any is taken
    files: list[str] = field(default_factory=lambda: ["**/*.csv", "**/*.parquet"])
    kind: str | None = "make"  # make | setting | acc | order; null: it is not told
    group: str | None = "setting"  # make | setting | acc | order; null: it is not told
    # m, that every vehicle is taken to have, as it is not published: positions are gaps and
    # lengths; null: positions are gaps alone
    length: float | None = 5.0
    dt: float | None = None  # s, a multiple of the files' step; null: that
    # m by which a gap may change between two samples otherwise than the speeds tell, without being
    # taken for unknown: the error that one position may have; null: whatever
    max_error: float | None = 0.5
    fill: float = 0.9  # s that may be missing of a vehicle; a longer hole is not interpolated
    window: float | None = None  # s; null: maximal intervals with the same vehicles in view
    min_vehicles: int = 2  # fewest vehicles of a platoon
    min_duration: float = 5.0  # s, shortest sequence where window is null


@dataclass
class SumoOptions(LaneOptions):
    """SUMO's floating car data (fcd-output, XML, also gzipped)."""

    name: str = "sumo"


@dataclass
class HighDOptions(LaneOptions):
    """highD's tracks, with the tables ``tracksMeta`` and ``recordingMeta`` beside them."""

    name: str = "highd"


@dataclass
class JuelichOptions(DataOptions):
    """Trajectory text files of the Jülich archive: id frame x y z."""

    name: str = "juelich"
    domain: str = "crowd"
    fill: float = 0.0  # the published recordings as they are
    t_seq: float = 1.0  # s, length of a sequence
    frame_rate: float | None = None  # 1/s; null reads it from the file's header
    unit: str | None = None  # cm | m; null reads it from the file's header
    walking_axis: str = "x"  # x | y; walls run along it
    walls: dict[str, list[float]] = field(default_factory=dict)  # recording: [low, high], m
    view: list[float] | None = None  # [from, to] along the walking axis, m; null takes all
    velocity: Velocity = Velocity.forward
    min_agents: int = 1  # fewest people in a sequence
    # {name: {line: [x1, y1, x2, y2], direction: +x}}, m: destinations on exit lines, by where
    # people walk (+x | -x | +y | -y | [x, y]); null: their last position in the sequence
    exits: Any = None
    # s before a sequence in which preferred velocities are measured, for model.desired=direction;
    # 0 measures none. Who is not tracked so long before has the velocity of his first sample
    history: float = 1.0


@dataclass
class WalkwayOptions(JuelichOptions):
    """One file of walking people: PedPy's text, JuPedSim's SQLite database, or a table."""

    name: str = "pedpy"
    fill: float = 0.5  # s of missing frames of a person that are interpolated; 0: none
    path: str = MISSING  # the file; relative to data.source where that is given
    # of a table: {agent: its column, time: ..., x: ..., y: ...} and recording, sequence where they
    # exist; a column that bears the name of its meaning need not be listed
    columns: dict[str, str | None] = field(default_factory=dict)
    position_unit: str = "m"  # of a table: m | ft | cm | km
    time_unit: str = "s"  # of a table: s | ms | us | ns | frame; dates and durations need none
    geometry: str | None = None  # text file with the walkable area as WKT, m


@dataclass
class TableOptions(DataOptions):
    """A user's own tidy table (CSV or Parquet), one row per sequence, time and agent.

    ``columns`` names the table's columns by what they mean: ``sequence``, ``time``, ``agent``,
    ``x``, and where they exist ``y``, ``length``, ``kind``, ``group``, ``dest_x``, ``dest_y``,
    ``recording``. A column that bears the name of its meaning need not be listed; null leaves an
    optional one out.
    """

    name: str = "table"
    path: str = MISSING  # the table; relative to data.source where that is given
    walls: str | None = None  # CSV with x1, y1, x2, y2 (m), the walkable side on the left
    # {name: {line: [x1, y1, x2, y2], direction: +x, group: NAME}}, m: destinations on exit lines,
    # in place of the columns dest_x, dest_y
    exits: Any = None
    columns: dict[str, str | None] = field(default_factory=dict)  # {meaning: column}
    position_unit: str = "m"  # m | ft | cm | km, of positions, lengths and destinations
    time_unit: str = "s"  # s | ms | us | ns | frame; dates and durations need none
    frame_rate: float | None = None  # 1/s, with time_unit=frame


def positive(option: str, value: float | None) -> float:
    """``value``, if it is a positive finite number.

    Raises:
        ConfigError: it is not; names the option.
    """
    if value is None or not 0 < value < float("inf"):
        raise ConfigError(f"data.{option}={value}: expected a positive number")
    return float(value)


def one_of(option: str, value: str | None, valid: Mapping[str, float]) -> float:
    """What ``valid`` holds for the configured word.

    Raises:
        ConfigError: the word is not among the valid ones; lists them.
    """
    if value is None or value not in valid:
        raise ConfigError(f"data.{option}={value}: expected one of {', '.join(valid)}")
    return valid[value]


def wanted(option: object) -> list[str] | None:
    """Names that ``data.recording`` asks for; None for all.

    Raises:
        ConfigError: neither a name nor a list of names, or an empty list.
    """
    if option is None or option == "all":
        return None
    items = [option] if isinstance(option, str | int) else option
    if not isinstance(items, Iterable) or isinstance(items, Mapping):
        raise ConfigError(f"data.recording={option}: expected 'all', a name or a list of names")
    names = list(dict.fromkeys(str(item) for item in items))
    if not names:
        raise ConfigError("data.recording=[]: expected 'all', a name or a list of names")
    return names


def check_known(asked: Iterable[str], known: Iterable[str]) -> None:
    """Refuse names that are not known, naming the nearest first.

    Raises:
        ConfigError: an unknown recording.
    """
    valid = list(dict.fromkeys(known))
    for name in asked:
        if name not in valid:
            near = difflib.get_close_matches(name, valid, n=len(valid) or 1, cutoff=0.0)
            raise ConfigError(
                f"data.recording={name}: unknown recording; nearest first, the valid ones are: "
                f"{', '.join(near) or 'none'}"
            )


#: Options by their names in prepared folders and checkpoints of earlier versions.
_BEFORE = {"max_hole": "fill"}


def with_present_names(told: Mapping[str, Any]) -> dict[str, Any]:
    """Options of data as an earlier version wrote them, under the names that they have now."""
    return {_BEFORE.get(key, key): value for key, value in told.items()}
