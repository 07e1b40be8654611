"""Options that all data sources share, as dataclasses that the configuration is checked against.

The options of one format stand beside its reader.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar

from omegaconf import MISSING

from nnode.errors import ConfigError


class Faults(str, Enum):
    """Treatment of sequences with faults of the measurement."""

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


class Starts(str, Enum):
    """Speeds with which simulations start: the data's own, or those of :mod:`nnode.data.smooth`."""

    measured = "measured"
    smoothed = "smoothed"


@dataclass
class SplitOptions:
    """Which sequences are held out from training."""

    heldout: float = 0.2  # share of the sequences; 0: all are used for training
    mode: SplitMode = SplitMode.auto
    seed: int = 0  # seed of a random split
    gap: float = 5.0  # s; without identifiers, sequences closer in time may share an agent


@dataclass
class LoaderOptions:
    """How prepared sequences are streamed as mini-batches."""

    batch_size: int = 32  # largest number of sequences per mini-batch; 0: all sequences
    workers: int = 0  # number of processes that load sequences; 0: the process of the training
    shuffle: bool = True  # whether every epoch has a new order


@dataclass
class DataOptions:
    """What all data sources share."""

    #: Whether the data are those of the paper, whose faults are judged as there.
    published: ClassVar[bool] = False

    name: str = MISSING  # label in results and plots
    domain: str = MISSING  # traffic (positions x) | crowd (x and y)
    # folder with the raw files, or a URL; null: the folder in the environment variable NNODE_DATA,
    # or else public data are downloaded
    source: str | None = None
    download: str | None = None  # folder for downloaded files; null: raw/ in the run's folder
    prepared: str | None = None  # folder that prepare_data wrote; null prepares on the fly
    recording: Any = "all"  # "all", a name, or a list of names
    faults: Faults = Faults.drop
    # longest time without samples that is interpolated, s; longer gaps cut a record in two; 0: no
    # interpolation
    fill: float = 0.5
    # window of the local cubic polynomials that smooth positions and give speeds, s; null: no
    # smoothing
    smooth: float | None = None
    # whether an identifier is one agent within a sequence only, or within the whole recording
    agents: Agents = Agents.auto
    # speeds at the first sample, with which simulations start; smoothed: those of parabolas that
    # are fitted to the first 2 s of positions
    start_speeds: Starts = Starts.measured
    split: SplitOptions = field(default_factory=SplitOptions)
    loader: LoaderOptions = field(default_factory=LoaderOptions)


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


def chosen(
    option: object, available: Iterable[str], default: Iterable[str] | None = None
) -> list[str]:
    """Names that ``data.recording`` asks for.

    Args:
        available: names that it may ask for.
        default: names where it asks for all; None: those that are available.

    Raises:
        ConfigError: neither a name nor a list of names, an empty list, or an unknown recording;
            names the nearest first.
    """
    valid = list(dict.fromkeys(available))
    if option is None or option == "all":
        return valid if default is None else list(default)
    items = [option] if isinstance(option, str | int) else option
    if not isinstance(items, Iterable) or isinstance(items, Mapping):
        raise ConfigError(f"data.recording={option}: expected 'all', a name or a list of names")
    names = list(dict.fromkeys(str(item) for item in items))
    if not names:
        raise ConfigError("data.recording=[]: expected 'all', a name or a list of names")
    for name in names:
        if name not in valid:
            near = difflib.get_close_matches(name, valid, n=len(valid) or 1, cutoff=0.0)
            raise ConfigError(
                f"data.recording={name}: unknown recording; nearest first, the valid ones are: "
                f"{', '.join(near) or 'none'}"
            )
    return names


#: Options by their names in prepared folders and checkpoints of earlier versions.
_BEFORE = {"max_hole": "fill"}


def with_present_names(told: Mapping[str, Any]) -> dict[str, Any]:
    """Options of data as an earlier version wrote them, under the names that they have now."""
    return {_BEFORE.get(key, key): value for key, value in told.items()}
