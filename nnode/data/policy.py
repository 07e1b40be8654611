"""What becomes of faulty sequences, and the account of it that a manifest keeps."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from nnode.data.options import Faults
from nnode.data.quality import Fault, by_kind, usable
from nnode.data.sequence import Sequence
from nnode.errors import DataError, FaultError

#: Faults that the message of a FaultError lists.
LISTED = 5


def drop_absent(sequences: list[Sequence]) -> tuple[list[Sequence], list[dict[str, Any]]]:
    """Leave out people who are not present throughout their sequence, as the paper does.

    Returns:
        The sequences with the people who stay, and per person left out a dict with
        ``sequence``, ``agent`` and ``why``.
    """
    kept, absent = [], []
    for s in sequences:
        missing = np.isnan(s.x).all(axis=2).sum(axis=0)
        for i in np.flatnonzero(missing):
            why = f"absent at {missing[i]} of {s.n_samples} samples"
            name = s.agents[i] if s.agents else str(i)
            absent.append({"sequence": s.name, "agent": name, "why": why})
        kept.append(s.select(missing == 0) if missing.any() else s)
    return kept, absent


def apply_policy(
    policy: Faults, sequences: list[Sequence], faults: dict[str, list[Fault]]
) -> tuple[list[Sequence], list[dict[str, Any]]]:
    """Sort sequences by what was found in them.

    Args:
        policy: ``drop`` leaves faulty sequences out, ``keep`` only those that cannot be
            simulated at all, ``error`` refuses any.
        sequences: all of them.
        faults: each sequence's faults by its name.

    Returns:
        Sequences to keep, and per dropped one a dict with ``sequence`` and ``reasons``.

    Raises:
        FaultError: faults, with ``error``; lists the first few.
        DataError: nothing is left.
    """
    faulty = [s for s in sequences if faults[s.name]]
    if policy is Faults.error and faulty:
        found = [fault for s in faulty for fault in faults[s.name]]
        lines = [f"  {f.sequence}: {f.kind}: {f.detail}" for f in found[:LISTED]]
        more = [f"  ... and {len(found) - LISTED} more"] if len(found) > LISTED else []
        raise FaultError(
            f"{len(faulty)} of {len(sequences)} sequences hold faults "
            f"({_listed(_counts(faulty, faults))}); "
            "data.faults=error refuses them, data.faults=drop leaves them out, data.faults=keep "
            "keeps them:\n" + "\n".join(lines + more)
        )
    keep = policy is Faults.keep

    def stays(s: Sequence) -> bool:
        return not faults[s.name] or (keep and s.n_agents > 0 and usable(s, faults[s.name]))

    kept = [s for s in sequences if stays(s)]
    dropped = [
        {
            "sequence": s.name,
            "reasons": [{"kind": f.kind, "detail": f.detail} for f in faults[s.name]],
        }
        for s in sequences
        if not stays(s)
    ]
    if not kept:
        raise DataError(
            f"nothing is left of {len(sequences)} sequences: {_listed(_counts(faulty, faults))}; "
            + _advice(faulty, faults, keep)
        )
    return kept, dropped


def without(
    read: list[Sequence], dropped: list[dict[str, Any]], left_out: list[dict[str, str]]
) -> list[str]:
    """Sentences that say how much is not used, and why.

    Args:
        read: all sequences.
        dropped: see :func:`apply_policy`.
        left_out: see :class:`nnode.data.cut.Reading`.
    """
    told = []
    if left_out:
        why = Counter(entry["why"] for entry in left_out)
        listed = "; ".join(f"{text} in {n}" for text, n in why.most_common(LISTED))
        told.append(
            f"records that are left out, as there is no sequence of them: {len(left_out)} "
            f"({listed}; first {left_out[0]['name']})"
        )
    if dropped:
        listed = _listed(by_kind([r["kind"] for r in d["reasons"]] for d in dropped))
        told.append(
            f"{len(dropped)} of {len(read)} sequences are left out for their faults: {listed}"
        )
    return told


def _advice(sequences: list[Sequence], faults: dict[str, list[Fault]], keep: bool) -> str:
    """What to do where nothing is left."""
    if not keep and any(s.n_agents and usable(s, faults[s.name]) for s in sequences):
        return "data.faults=keep keeps faulty ones"
    if any(fault.kind == "gap_in_time" for s in sequences for fault in faults[s.name]):
        return (
            "what is missing cannot be simulated; data.fill=SECONDS interpolates longer "
            "holes, or cut the sequences where vehicles come and go"
        )
    return "these cannot be simulated; correct the rows that the faults name"


def told_filled(filled: list[dict[str, Any]]) -> str:
    """How many samples were interpolated, in a sentence."""
    names = ", ".join(one["sequence"] for one in filled[:LISTED])
    more = f" and {len(filled) - LISTED} more" if len(filled) > LISTED else ""
    return (
        f"{sum(one['samples'] for one in filled)} missing samples in {len(filled)} sequences "
        f"({names}{more}) are interpolated; data.fill sets up to how many seconds"
    )


def _counts(sequences: list[Sequence], faults: dict[str, list[Fault]]) -> dict[str, int]:
    return by_kind([fault.kind for fault in faults[s.name]] for s in sequences)


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{kind} in {n}" for kind, n in counts.items()) or "no sequence at all"


def by_recording(
    read: list[Sequence], kept: list[Sequence], faults: dict[str, list[Fault]]
) -> dict[str, Any]:
    """Per recording, how many sequences were read, kept and dropped, and how many are faulty."""
    staying = {s.name for s in kept}
    table = {}
    for recording in dict.fromkeys(s.recording for s in read):
        own = [s for s in read if s.recording == recording]
        n_kept = sum(s.name in staying for s in own)
        table[recording] = {
            "read": len(own),
            "kept": n_kept,
            "dropped": len(own) - n_kept,
            "faulty": _counts(own, faults),
        }
    return table
