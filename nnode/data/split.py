"""Which sequences are held out from training, so that no agent is on both sides.

Sequences of one recording that share an agent are connected. Where the connected components are
small, whole components are drawn at random. Where they are not - in a corridor everyone takes
part in several successive sequences, which chains a whole recording together - one contiguous
block of time is held out from each recording, and the sequences at its borders that share an
agent with it are dropped from training.

Without identifiers (ESIMAS), two sequences closer in time than ``gap`` count as sharing an agent.
The default of 5 s comes from those recordings: at the end of a sequence its last vehicle has
2 to 3 s (median) and mostly (82 to 95 %) at most 5 s to go until it leaves the camera's view, so
that later sequences rarely hold it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from collections.abc import Sequence as ListLike
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from nnode.data.options import SplitMode, SplitOptions
from nnode.data.store import Store
from nnode.errors import ConfigError, DataError

#: Relative error of the held-out share up to which whole components do, in mode ``auto``.
TOLERANCE = 0.25

Index = ListLike[Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Split:
    """Positions of sequences in their store, each in one of three ascending lists.

    Attributes:
        train: calibrated on.
        heldout: never seen in training.
        dropped: unused, because they share an agent with a held-out sequence.
        mode: ``none``, ``random`` (whole components) or ``block`` (of time).
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


def split(sequences: Store | Index, options: SplitOptions) -> Split:
    """Divide the sequences of a store; a pure function of its arguments.

    Args:
        sequences: a store, or what its ``index`` holds: per sequence ``name``, ``recording``,
            ``start``, ``end`` and ``agents``.
        options: ``heldout`` is the share of the sequences, ``gap`` in s.

    Raises:
        ConfigError: ``heldout`` outside [0, 1), or a negative ``gap``.
        DataError: nothing would be left to train on or to hold out.
    """
    index: Index = sequences.index if isinstance(sequences, Store) else sequences
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
    rng = np.random.default_rng(options.seed)
    if mode is SplitMode.block:
        return _by_block(index, share, gap, rng)
    result = _by_component(index, share, gap, rng)
    target = share * len(index)
    near = abs(len(result.heldout) - target) <= max(1.0, TOLERANCE * target)
    if mode is SplitMode.auto and not (near and result.heldout and result.train):
        return _by_block(index, share, gap, rng)
    return _checked(result, share, "data.split.mode=block holds out a block of time instead")


def _by_component(index: Index, share: float, gap: float, rng: np.random.Generator) -> Split:
    label = components(index, gap)
    size = np.bincount(label)
    target = share * len(index)
    held: list[int] = []
    got = 0
    for component in rng.permutation(len(size)):
        if abs(got + size[component] - target) < abs(got - target):
            held.append(int(component))
            got += int(size[component])
    out = np.isin(label, held)
    note = (
        f"{got} of {len(index)} sequences held out ({len(held)} of {len(size)} groups of "
        f"sequences that {_relation(index, gap)})"
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
    for members in _recordings(index).values():
        count = round(share * len(members))
        if not count:
            continue
        order = sorted(members, key=lambda i: (index[i]["start"], i))
        first = int(rng.integers(len(order) - count + 1))
        block = order[first : first + count]
        held += block
        rest = sorted(set(members) - set(block))
        dropped += _related(index, rest, block, gap)
    gone = {*held, *dropped}
    result = Split(
        train=[i for i in range(len(index)) if i not in gone],
        heldout=sorted(held),
        dropped=sorted(dropped),
        mode="block",
        note=f"{len(held)} of {len(index)} sequences held out, one block of time per recording; "
        f"{len(dropped)} at the borders, which {_relation(index, gap)} with it, are not used",
    )
    return _checked(
        result,
        share,
        "every other sequence shares an agent with the held-out block"
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


def components(index: Index, gap: float) -> np.ndarray:
    """``(S,)`` label of the connected component of each of S sequences, counted from 0.

    Args:
        index: see :func:`split`.
        gap: s; sequences of a recording without identifiers are connected where less time
            passes between them. 0 connects none.
    """
    edges: list[tuple[int, int]] = []
    for members in _recordings(index).values():
        if _identified(index, members):
            first: dict[str, int] = {}
            edges += [(first.setdefault(a, i), i) for i in members for a in index[i]["agents"]]
            continue
        order = sorted(members, key=lambda i: (index[i]["start"], i))
        end, last = index[order[0]]["end"], order[0]
        for i in order[1:]:
            if _apart(end, index[i]["start"]) < gap:
                edges.append((last, i))
            end, last = max(end, index[i]["end"]), i
    row, column = np.array(edges, dtype=int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(row)), (row, column)), shape=(len(index), len(index)))
    return np.asarray(connected_components(graph, directed=False)[1])


def _related(index: Index, rest: list[int], block: list[int], gap: float) -> list[int]:
    """Those of ``rest`` that may share an agent with ``block``; all of one recording."""
    if _identified(index, rest + block):
        agents = {a for i in block for a in index[i]["agents"]}
        return [i for i in rest if not agents.isdisjoint(index[i]["agents"])]
    spans = [(index[i]["start"], index[i]["end"]) for i in block]
    return [
        i
        for i in rest
        if any(
            max(_apart(end, index[i]["start"]), _apart(index[i]["end"], start)) < gap
            for start, end in spans
        )
    ]


def _apart(end: float, start: float) -> float:
    return max(0.0, start - end)


def _recordings(index: Index) -> dict[str, list[int]]:
    groups: dict[str, list[int]] = {}
    for i, entry in enumerate(index):
        groups.setdefault(entry["recording"], []).append(i)
    return groups


def _identified(index: Index, members: list[int]) -> bool:
    return all(index[i]["agents"] for i in members)


def _relation(index: Index, gap: float) -> str:
    known = [bool(entry["agents"]) for entry in index]
    if all(known):
        return "share an agent"
    near = f"are closer than {gap:g} s in time"
    return f"share an agent or {near}" if any(known) else near
