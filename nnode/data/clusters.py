"""Clusters: the sequences that are taken as independent of each other, and no finer ones.

Folds, sign flips, jackknife, paired tests and confirmation sets all go by cluster.

- Sequences of a recording, or of recordings of one site (lanes of a road), that share an agent are
  one cluster.
- Without identifiers (ESIMAS), two sequences closer in time than ``gap`` count as sharing one. The
  default of 5 s comes from those recordings: at the end of a sequence its last vehicle has 2 to 3 s
  (median) and mostly (82 to 95 %) at most 5 s to go until it leaves the camera's view, so that
  later sequences rarely hold it.
- Where agents who are there at one time but share nobody behave alike, time is shared too: that is
  found out from residuals (:mod:`nnode.diagnosis.statistics.simultaneous`) and asked for by
  ``together``.

Of G clusters, sign flips have 2^G outcomes: no one-sided p-value is below 2^-G, no two-sided one
below 2^(1 - G).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from collections.abc import Sequence as ListLike
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from nnode.data.sequence import Sequence

#: Per sequence ``name``, ``recording``, ``site``, ``start``, ``end`` and ``agents``.
Index = ListLike[Mapping[str, Any]]

#: s; sequences without identifiers that are closer in time may share an agent.
GAP = 5.0
#: Sign flips that :func:`better` compares.
FLIPS = 2**14


def index_of(sequences: Iterable[Sequence]) -> list[dict[str, Any]]:
    """What clusters and splits need to know of sequences."""
    return [
        {
            "name": s.name,
            "recording": s.recording,
            "site": s.site,
            "split": s.split,
            "start": float(s.time[0]),
            "end": float(s.time[-1]),
            "agents": list(s.agents),
        }
        for s in sequences
    ]


def clusters(index: Index, gap: float = GAP, *, together: bool = False) -> np.ndarray:
    """``(S,)`` label of the cluster of each of S sequences, counted from 0.

    Args:
        index: see :func:`index_of`.
        gap: s, see above; 0 connects no sequences without identifiers.
        together: sequences of a site that overlap in time are one, whoever is in them.
    """
    edges: list[tuple[int, int]] = []
    for members in _groups(index, "site").values():
        named = identified(index, members)
        if named:
            first: dict[str, int] = {}
            edges += [(first.setdefault(a, i), i) for i in members for a in index[i]["agents"]]
        if together or not named:
            edges += _near(index, members, 0.0 if named else gap, together)
    return components(len(index), edges)


def components(number: int, pairs: Any) -> np.ndarray:
    """``(number,)`` label of the connected component of each item, counted from 0.

    Args:
        pairs: ``(M, 2)`` numbers of items that are joined.
    """
    row, column = np.array(pairs, dtype=int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(row)), (row, column)), shape=(number, number))
    return np.asarray(connected_components(graph, directed=False)[1])


def folds(label: np.ndarray, number: int, seed: int) -> np.ndarray:
    """``(S,)`` the fold in which each sequence is held out; a cluster is in one fold.

    Args:
        label: ``(S,)`` clusters, counted from 0.
    """
    count = int(label.max()) + 1
    order = np.random.default_rng(seed).permutation(count)
    fold = np.empty(count, dtype=int)
    fold[order] = np.arange(count) % number
    return fold[label]


def _near(
    index: Index, members: list[int], gap: float, touching: bool
) -> Iterable[tuple[int, int]]:
    """Pairs of sequences with less than ``gap`` s between them, or at one time."""
    order = sorted(members, key=lambda i: (index[i]["start"], i))
    end, last = index[order[0]]["end"], order[0]
    for i in order[1:]:
        between = max(0.0, index[i]["start"] - end)
        if between < gap or (touching and index[i]["start"] < end):
            yield last, i
        end, last = max(end, index[i]["end"]), i


def by_recording(index: Index) -> dict[str, list[int]]:
    """Positions of the sequences of each recording."""
    return _groups(index, "recording")


def _groups(index: Index, what: str) -> dict[str, list[int]]:
    groups: dict[str, list[int]] = {}
    for i, entry in enumerate(index):
        groups.setdefault(entry.get(what) or entry["recording"], []).append(i)
    return groups


def identified(index: Index, members: Iterable[int]) -> bool:
    """Whether all agents of some sequences have identifiers."""
    return all(index[i]["agents"] for i in members)


def relation(index: Index, gap: float = GAP) -> str:
    """What makes sequences one cluster, in words: "sequences that ..."."""
    named = [bool(entry["agents"]) for entry in index]
    if all(named):
        return "share an agent"
    near = f"are closer than {gap:g} s in time"
    return f"share an agent or {near}" if any(named) else near


def level(sequences: ListLike[Sequence], label: np.ndarray, covariate: str | None) -> np.ndarray:
    """``(S,)`` labels that are no finer than the level at which a covariate varies.

    What is fixed within every recording is told by recordings: their sequences are one.

    Args:
        label: ``(S,)`` clusters.
        covariate: ``kind``, ``group`` or ``length``, per agent; None: nothing is asked.
    """
    if covariate is None or _varies(sequences, covariate):
        return label
    names = [s.recording for s in sequences]
    recordings: np.ndarray = np.unique(names, return_inverse=True)[1]
    return recordings


def _varies(sequences: ListLike[Sequence], covariate: str) -> bool:
    """Whether a covariate takes several values within any recording."""
    by_recording_values: dict[str, set[Any]] = {}
    for s in sequences:
        values = getattr(s, covariate)
        if values is not None and len(values):
            finite = (v for v in np.asarray(values).tolist() if v != "" and v == v)  # not NaN
            by_recording_values.setdefault(s.recording, set()).update(finite)
    return any(len(values) > 1 for values in by_recording_values.values())


def signs(number: int, flips: int, rng: np.random.Generator) -> np.ndarray:
    """``(F, G)`` signs of G clusters, the data as they are first.

    All that differ by more than the sign of everything where these are at most ``flips + 1``,
    otherwise so many drawn ones: for statistics that do not mind the sign of everything.
    """
    if 2 ** (number - 1) <= flips + 1:
        return every_sign(number)[::2]
    drawn = rng.choice([-1.0, 1.0], (flips, number))
    return np.concatenate([np.ones((1, number)), drawn])


def every_sign(number: int) -> np.ndarray:
    """``(2^G, G)`` all signs of G clusters, only positive ones first."""
    bits = np.arange(2**number)[:, None] >> np.arange(number)[None]
    return 1.0 - 2.0 * (bits & 1)


def better(gains: np.ndarray) -> float:
    """One-sided p-value by sign flips that gains ``(G,)`` of G clusters are positive in the mean;
    all signs where there are at most :data:`FLIPS`, else so many. 1 without clusters.

    Source: Fisher 1935; Canay, Romano & Shaikh 2017.
    """
    number = len(gains)
    if not number or not np.isfinite(gains).all():
        return 1.0
    if 2**number <= FLIPS:
        tried = every_sign(number)
    else:
        drawn = np.random.default_rng(0).choice([-1.0, 1.0], (FLIPS - 1, number))
        tried = np.concatenate([np.ones((1, number)), drawn])
    total = tried @ gains
    return float((total >= total[0] - 1e-12 * np.abs(gains).sum()).mean())


def least_number(alpha: float, *, hypotheses: int = 1, sided: int = 2) -> int:
    """How many clusters sign flips need so that one of several hypotheses can reach a level,
    whatever the others do: sided · hypotheses · 2^-G is at most ``alpha``."""
    return max(1, math.ceil(math.log2(sided * hypotheses / alpha) - 1e-9))


def group_sums(
    values: np.ndarray, label: np.ndarray, weight: np.ndarray | None = None
) -> np.ndarray:
    """``(G, ...)`` sums of ``values`` ``(n, ...)`` over the rows of each label 0 ... G - 1, each
    times its ``weight`` ``(n,)``."""
    number, count = int(label.max()) + 1, len(label)
    weight = np.ones(count) if weight is None else weight
    member = csr_array((weight, (label, np.arange(count))), (number, count))
    totals: np.ndarray = member @ values.reshape(count, -1)
    return totals.reshape(number, *values.shape[1:])
