"""The sequences that are used, and their division into an exploration and a confirmation set."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nnode.data.clusters import clusters, index_of, relation
from nnode.data.options import SplitOptions
from nnode.data.sequence import Sequence
from nnode.data.split import split
from nnode.diagnosis.options import DiscoverOptions
from nnode.errors import DataError
from nnode.population.followers import APART, without_errors

#: In a law of first order, the speed at the start is that of the law. Vehicles of a simulation
#: start with another one and need time to adapt, s; at most this share of a sequence. In a table of
#: SUMO, the first 0.8 s were named as a period of lower speeds. A period was still selected if 1 s
#: was left out, and none if 2 s were.
SETTLING, SETTLING_SHARE = 2.0, 0.1
SETTLED = (
    "Positions have no errors of measurement, as in simulations or after smoothing. The first "
    f"{SETTLING:g} s of each sequence (at most {SETTLING_SHARE:.0%} of it), in which a simulation "
    "adapts to its start, are left out."
)


@dataclass(frozen=True)
class Part:
    """Some of the sequences of a diagnosis.

    Attributes:
        places: their positions in the list of all sequences.
        sequences: as they are used.
        label: ``(S,)`` their clusters, numbered over all sequences.
    """

    places: list[int]
    sequences: list[Sequence]
    label: np.ndarray

    @property
    def clusters(self) -> int:
        """The number of clusters."""
        return len(np.unique(self.label))


@dataclass(frozen=True)
class Division:
    """Exploration and confirmation sequences.

    Attributes:
        exploration, confirmation: the parts. No cluster is in both, unless there is only one: then
            a block of time is held back, and ``note`` says so.
        why: the definition of a cluster, in words.
        note: a restriction of the confirmation set; empty: none.
    """

    exploration: Part
    confirmation: Part
    why: str
    note: str = ""


def divide(
    sequences: list[Sequence],
    options: DiscoverOptions,
    *,
    together: bool = False,
    skip_starts: bool = False,
) -> Division:
    """Hold back a share of the clusters, but at most half of the sequences.

    The exploration set is not divided further: decisions on it use leave-one-cluster-out
    calibrations.

    Args:
        together: simultaneous sequences form one cluster.
        skip_starts: leave out the time in which a simulation adapts to its start.

    Raises:
        DataError: fewer than three sequences, or none that could be held back.
    """
    if len(sequences) < 3:
        raise DataError(
            f"a diagnosis needs at least 3 sequences without a fault, there are {len(sequences)}; "
            "take more data, or cut them into shorter sequences"
        )
    index = index_of(sequences)
    label = clusters(index, options.gap, together=together)
    why = f"sequences of a site that {relation(index, options.gap)}"
    why += " or overlap in time" if together else ""
    wanted = max(round(options.confirmation * (int(label.max()) + 1)), 1)
    held_back = np.isin(label, _drawn(label, wanted, np.random.default_rng(options.seed)))
    places = [np.flatnonzero(~held_back).tolist(), np.flatnonzero(held_back).tolist()]
    note = ""
    if not held_back.any():
        parts = split(
            index, SplitOptions(heldout=options.confirmation, gap=options.gap, seed=options.seed)
        )
        places = [parts.train, parts.heldout]
        note = (
            "All sequences are connected. The confirmation sequences are a block of time and are "
            "not independent of the exploration sequences."
        )
    used = [_without_start(s) for s in sequences] if skip_starts else sequences
    exploration, confirmation = (Part(p, [used[i] for i in p], label[p]) for p in places)
    return Division(exploration, confirmation, why, note)


def _drawn(label: np.ndarray, wanted: int, rng: np.random.Generator) -> list[int]:
    """Random clusters, as long as at least half of the sequences remain."""
    size = np.bincount(label)
    chosen: list[int] = []
    for candidate in rng.permutation(len(size)):
        if len(chosen) < wanted and 2 * (size[chosen].sum() + size[candidate]) <= len(label):
            chosen.append(int(candidate))
    return chosen


def spacing(sequences: list[Sequence], options: DiscoverOptions) -> float:
    """The smallest time between positions that are used, s: positions that were smoothed have
    autocorrelated errors; see :data:`~nnode.population.followers.APART`."""
    return APART if options.smoothed and without_errors(sequences) else 0.0


def _without_start(sequence: Sequence) -> Sequence:
    """The sequence without the time in which a simulation adapts to its start."""
    share = min(SETTLING / max(np.ptp(sequence.time), sequence.dt), SETTLING_SHARE)
    return replace(sequence.part(share, 1.0), name=sequence.name)
