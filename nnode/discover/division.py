"""Which sequences a diagnosis looks at, and which clusters it keeps for the end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nnode.data.clusters import clusters, index_of, relation
from nnode.data.options import SplitOptions
from nnode.data.sequence import Sequence
from nnode.data.split import split
from nnode.discover.options import DiscoverOptions
from nnode.errors import DataError


@dataclass(frozen=True)
class Division:
    """Open and sealed sequences.

    Attributes:
        label: ``(S,)`` cluster of each sequence.
        open, sealed: positions of the sequences; no cluster is on both sides, unless there is one
            alone: then a block of time is sealed, and ``note`` says so.
        why: what makes sequences one cluster, in words.
        note: what must be known of the sealed ones; empty: nothing.
    """

    label: np.ndarray
    open: list[int]
    sealed: list[int]
    why: str
    note: str = ""

    def number(self, places: list[int]) -> int:
        """Of the clusters of some sequences."""
        return len(np.unique(self.label[places]))


def divide(
    sequences: list[Sequence], options: DiscoverOptions, *, together: bool = False
) -> Division:
    """Seal a share of the clusters, but no more than half of the sequences.

    The open ones are not divided further: every judgement on them is made on clusters that a
    calibration has left out in turn.

    Args:
        together: what is simultaneous is one cluster.

    Raises:
        DataError: fewer than three sequences, or none that could be sealed.
    """
    if len(sequences) < 3:
        raise DataError(
            f"a diagnosis needs at least 3 sequences without a fault, there are {len(sequences)}; "
            "take more data, or cut them into shorter sequences"
        )
    index = index_of(sequences)
    label = clusters(index, options.gap, together=together)
    why = f"sequences of a site that {relation(index, options.gap)}"
    why += " or are there at one time" if together else ""
    number = int(label.max()) + 1
    wanted = round(options.sealed * number)
    if number > 1:
        held = _drawn(label, max(wanted, 1), np.random.default_rng(options.seed))
        if held:
            out = np.isin(label, held)
            return Division(label, np.flatnonzero(~out).tolist(), np.flatnonzero(out).tolist(), why)
    parts = split(index, SplitOptions(heldout=options.sealed, gap=options.gap, seed=options.seed))
    note = (
        "The sealed sequences are a block of time: all sequences are connected, and those that are "
        "sealed are not independent of the others."
    )
    return Division(label, parts.train, parts.heldout, why, note)


def _drawn(label: np.ndarray, wanted: int, rng: np.random.Generator) -> list[int]:
    """Clusters at random, as long as at least half of the sequences are left."""
    size = np.bincount(label)
    held: list[int] = []
    for one in rng.permutation(len(size)):
        if len(held) < wanted and 2 * (size[held].sum() + size[one]) <= len(label):
            held.append(int(one))
    return held
