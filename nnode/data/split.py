"""Which sequences are held out from training, so that no agent is on both sides.

Where clusters (:mod:`nnode.data.clusters`) are small, whole clusters are drawn at random. Where
they are not - in a corridor everyone takes part in several successive sequences, which chains a
whole recording together - one contiguous block of time is held out from each recording, and the
sequences at its borders that share an agent with it are dropped from training. Where more would be
dropped than trained on, as in runs in which everybody is there throughout, whole clusters are held
out all the same.

Where the source publishes which sequences it trains on and which it tests on, that is taken, so
that errors can be compared with those that others print.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nnode.data.clusters import Index, by_recording, clusters, identified, relation
from nnode.data.options import SplitMode, SplitOptions
from nnode.data.sequences import Sequences
from nnode.data.store import Store
from nnode.errors import ConfigError, DataError

#: Sides of a published division.
TRAIN, TEST = "train", "test"

#: Relative error of the held-out share up to which whole components do, in mode ``auto``.
TOLERANCE = 0.25


@dataclass(frozen=True, kw_only=True)
class Split:
    """Positions of sequences in their store, each in one of three ascending lists.

    Attributes:
        train: calibrated on.
        heldout: never seen in training.
        dropped: unused, because they share an agent with a held-out sequence, or are on neither
            side of a published division.
        mode: ``none``, ``random`` (whole components), ``block`` (of time) or ``published``.
        note: one sentence for the log and the report.
    """

    train: list[int]
    heldout: list[int]
    dropped: list[int]
    mode: str
    note: str

    def to_dict(self) -> dict[str, Any]:
        """The split as plain lists and strings for a manifest; ``Split(**d)`` undoes it."""
        return asdict(self)


def split(sequences: Store | Sequences | Index, options: SplitOptions) -> Split:
    """Divide the sequences of a store; a pure function of its arguments.

    Args:
        sequences: a store, or what its ``index`` holds: per sequence ``name``, ``recording``,
            ``start``, ``end`` and ``agents``.
        options: ``heldout`` is the share of the sequences, ``gap`` in s.

    Raises:
        ConfigError: ``heldout`` outside [0, 1), or a negative ``gap``.
        DataError: nothing would be left to train on or to hold out, or the source publishes no
            division where one is asked for.
    """
    index: Index = sequences.index if isinstance(sequences, Store | Sequences) else sequences
    share, gap, mode = options.heldout, options.gap, SplitMode(options.mode)
    if not 0 <= share < 1:
        raise ConfigError(f"data.split.heldout={share}: expected a share from 0 to below 1")
    if not (gap >= 0 and math.isfinite(gap)):
        raise ConfigError(f"data.split.gap={gap}: expected a time of at least 0 s")
    if not index:
        raise DataError("there is no sequence to train on: the data set is empty")
    if share == 0:
        everything = list(range(len(index)))
        note = f"all {len(index)} sequences train"
        return Split(train=everything, heldout=[], dropped=[], mode="none", note=note)
    sides = {entry.get("split", "") for entry in index}
    if mode is SplitMode.published or (mode is SplitMode.auto and {TRAIN, TEST} <= sides):
        return _published(index, gap)
    rng = np.random.default_rng(options.seed)
    if mode is SplitMode.block:
        return _by_block(index, share, gap, rng)
    result = _by_component(index, share, gap, rng)
    if mode is SplitMode.auto:
        result = _or_block(result, index, share, gap, rng)
    return _checked(result, share, "data.split.mode=block holds out a block of time instead")


def _or_block(
    result: Split, index: Index, share: float, gap: float, rng: np.random.Generator
) -> Split:
    """A block of time in place of components that miss the share that is to be held out."""
    target = share * len(index)
    near = abs(len(result.heldout) - target) <= max(1.0, TOLERANCE * target)
    sound = bool(result.heldout and result.train)
    if near and sound:
        return result
    try:
        block = _by_block(index, share, gap, rng)
    except DataError:
        if not sound:
            raise
        return result
    # A block of a recording in which every agent is present throughout drops all other sequences.
    return block if not sound or len(block.dropped) <= len(block.train) else result


def _published(index: Index, gap: float) -> Split:
    """The source's own division, agents on both sides included: they are told."""
    train, held = (
        [i for i, entry in enumerate(index) if entry.get("split", "") == side]
        for side in (TRAIN, TEST)
    )
    if not train or not held:
        raise DataError(
            f"data.split.mode=published: {len(train)} sequences are marked {TRAIN!r} and "
            f"{len(held)} {TEST!r} by the source, expected some of both; set "
            "data.split.mode=auto, or give the data a column split"
        )
    label = clusters(index, gap)
    on_both_sides = [i for i in train if label[i] in set(label[held])]
    unused = sorted(set(range(len(index))) - {*train, *held})
    note = f"{len(held)} of {len(index)} sequences held out, as the source publishes it"
    if on_both_sides:
        note += f"; {len(on_both_sides)} that train {relation(index, gap)} with a held-out one"
    if unused:
        note += f"; {len(unused)} are on neither side and not used"
    return Split(train=train, heldout=held, dropped=unused, mode="published", note=note)


def _by_component(index: Index, share: float, gap: float, rng: np.random.Generator) -> Split:
    label = clusters(index, gap)
    size = np.bincount(label)
    target = share * len(index)
    held: list[int] = []
    got = 0
    for component in rng.permutation(len(size)).tolist():
        if abs(got + size[component] - target) < abs(got - target):
            held.append(component)
            got += size[component]
    out = np.isin(label, held)
    note = (
        f"{got} of {len(index)} sequences held out ({len(held)} of {len(size)} groups of "
        f"sequences that {relation(index, gap)})"
    )
    return Split(
        train=np.flatnonzero(~out).tolist(),
        heldout=np.flatnonzero(out).tolist(),
        dropped=[],
        mode="random",
        note=note,
    )


def _by_block(index: Index, share: float, gap: float, rng: np.random.Generator) -> Split:
    held: list[int] = []
    dropped: list[int] = []
    for members in by_recording(index).values():
        count = round(share * len(members))
        if not count:
            continue
        order = sorted(members, key=lambda i: (index[i]["start"], i))
        first = int(rng.integers(len(order) - count + 1))
        block = order[first : first + count]
        held += block
        others = sorted(set(members) - set(block))
        dropped += _related(index, others, block, gap)
    gone = {*held, *dropped}
    result = Split(
        train=[i for i in range(len(index)) if i not in gone],
        heldout=sorted(held),
        dropped=sorted(dropped),
        mode="block",
        note=f"{len(held)} of {len(index)} sequences held out, one block of time per recording; "
        f"{len(dropped)} at the borders, which {relation(index, gap)} with it, are not used",
    )
    return _checked(
        result,
        share,
        "every other sequence shares an agent with the held-out block (data.agents=sequence says "
        "that identifiers mean something within their sequence alone)"
        if held
        else "the recordings hold too few sequences for a block of that share",
    )


def _checked(result: Split, share: float, hint: str) -> Split:
    if result.train and result.heldout:
        return result
    side = "training" if result.heldout else "the held-out part"
    raise DataError(
        f"data.split.heldout={share:g} in mode {result.mode} leaves no sequence for {side} "
        f"({result.note}); {hint}; take more data, shorter sequences, another share, or "
        "data.split.heldout=0 to train on everything"
    )


def _related(index: Index, others: list[int], block: list[int], gap: float) -> list[int]:
    """Those of ``rest`` that may share an agent with ``block``; all of one recording."""
    if identified(index, others + block):
        agents = {a for i in block for a in index[i]["agents"]}
        return [i for i in others if not agents.isdisjoint(index[i]["agents"])]

    def between(i: int, j: int) -> float:
        """Seconds from the end of the earlier one to the start of the later one."""
        a, b = index[i], index[j]
        return max(0.0, b["start"] - a["end"], a["start"] - b["end"])

    return [i for i in others if any(between(i, j) < gap for j in block)]
