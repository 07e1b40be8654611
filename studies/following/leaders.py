"""TGSIM: whether people follow automated cars otherwise than they follow people."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import t

from nnode.data.sequence import collate
from studies.following import data
from studies.following.candidates import EVERY
from studies.following.fit import calibrated, costs_of, named
from studies.stores import sequences

Result = dict[str, Any]

#: Kinds of leaders: people, automated cars.
KINDS = ("HV", "CAV")


def by_leader(folder: str, name: str, restarts: int, seed: int) -> Result:
    """Pooled parameters by kind of leader, without each cluster in turn, and held-out costs.

    Returns:
        ``rows``: by kind, of all clusters; ``without``: by kind, one row per cluster that is left
        out; ``heldout``: ``[kind calibrated on][pair]`` costs (m) of pairs of the cluster left
        out, ``both`` calibrated on all of its other clusters.
    """
    pairs = sequences(folder)
    kind = np.array([pair.kind[1] if pair.kind else "" for pair in pairs])
    label = data.labels(pairs)
    cost = costs_of(EVERY[name], collate(pairs))
    result: Result = {"rows": {}, "without": {}, "heldout": {}}
    for side in ("both", *KINDS):
        keep = np.full(len(pairs), side == "both") | (kind == side)
        result["rows"][side] = calibrated(EVERY[name], cost, restarts, seed, keep / keep.sum())
        result["without"][side] = without = []
        result["heldout"][side] = heldout = np.zeros(len(pairs))
        for g in range(label.max() + 1):
            kept = keep & (label != g)
            without.append(calibrated(EVERY[name], cost, 1, seed, kept / kept.sum()))
            heldout[label == g] = cost.costs(without[-1])[label == g]
    return result | {
        "names": list(named(cost, cost.start)),
        "kinds": kind,
        "clusters": label,
        "speed": [np.mean(pair.velocity()[:, 0]) for pair in pairs],
        "gap": [data.gap_of(pair).mean() for pair in pairs],
    }


def jackknifed(left_out: np.ndarray) -> np.ndarray:
    """Half widths ``(P,)`` of 95 % intervals of estimates from those without each of G clusters
    ``(G, P)`` (Student's t with G - 1 degrees of freedom).

    Source:
        Efron & Tibshirani 1993, chapter 11.
    """
    number = len(left_out)
    away = left_out - left_out.mean(0)
    error = np.sqrt((number - 1) / number * (away**2).sum(0))
    return error * float(t.ppf(0.975, number - 1))
