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
class Division:
    """Exploration and confirmation sequences.

    Attributes:
        label: ``(S,)`` cluster of each sequence.
        exploration, confirmation: positions of the sequences. No cluster is on both sides, unless
            there is only one: then a block of time is held back, and ``note`` says so.
        why: the definition of a cluster, in words.
        note: a restriction of the confirmation set; empty: none.
    """

    label: np.ndarray
    exploration: list[int]
    confirmation: list[int]
    why: str
    note: str = ""

    def number(self, places: list[int]) -> int:
        """The number of clusters of some sequences."""
        return len(np.unique(self.label[places]))


def divide(
    sequences: list[Sequence], options: DiscoverOptions, *, together: bool = False
) -> Division:
    """Hold back a share of the clusters, but at most half of the sequences.

    The exploration set is not divided further: decisions on it use leave-one-cluster-out
    calibrations.

    Args:
        together: simultaneous sequences form one cluster.

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
    number = int(label.max()) + 1
    wanted = round(options.confirmation * number)
    if number > 1:
        held = _drawn(label, max(wanted, 1), np.random.default_rng(options.seed))
        if held:
            out = np.isin(label, held)
            return Division(label, np.flatnonzero(~out).tolist(), np.flatnonzero(out).tolist(), why)
    parts = split(
        index, SplitOptions(heldout=options.confirmation, gap=options.gap, seed=options.seed)
    )
    note = (
        "All sequences are connected. The confirmation sequences are a block of time and are not "
        "independent of the exploration sequences."
    )
    return Division(label, parts.train, parts.heldout, why, note)


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


def without_starts(sequences: list[Sequence]) -> list[Sequence]:
    """The sequences without the time in which a simulation adapts to its start."""
    shares = [min(SETTLING / max(np.ptp(s.time), s.dt), SETTLING_SHARE) for s in sequences]
    return [
        replace(s.part(share, 1.0), name=s.name) for s, share in zip(sequences, shares, strict=True)
    ]
