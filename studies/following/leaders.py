"""TGSIM: whether people follow automated cars otherwise than they follow people."""

from __future__ import annotations

from typing import Any

import numpy as np

from nnode.calibrate.problem import pooled
from nnode.data.sequence import collate
from studies.following import data
from studies.following.candidates import EVERY, starts
from studies.following.fit import STEPS, TOLERANCE, costs_of, named

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
    pairs = data.sequences(folder)
    batch = collate(pairs)
    kind = np.array([pair.kind[1] if pair.kind else "" for pair in pairs])
    label = data.labels(pairs)
    cost = costs_of(EVERY[name], batch)
    sides = {"both": np.ones(len(pairs), dtype=bool), **{k: kind == k for k in KINDS}}
    begin = starts(EVERY[name], cost, restarts, seed)

    def fitted(keep: np.ndarray, rows: np.ndarray) -> np.ndarray:
        weights = keep / keep.sum()
        fits = [pooled(cost, r, weights, steps=STEPS, tolerance=TOLERANCE) for r in rows]
        return fits[int(np.argmin(np.array([fit.cost for fit in fits])))].row

    whole = {side: fitted(keep, begin) for side, keep in sides.items()}
    without: dict[str, list[list[float]]] = {side: [] for side in sides}
    heldout = {side: np.zeros(len(pairs)) for side in sides}
    for g in range(int(label.max()) + 1):
        for side, keep in sides.items():
            row = fitted(keep & (label != g), begin[:1])
            without[side].append(row.tolist())
            heldout[side][label == g] = cost.costs(row)[label == g]
    speed = [float(np.mean(pair.velocity()[:, 0])) for pair in pairs]
    return {
        "names": list(named(cost, whole["both"])),
        "kinds": kind.tolist(),
        "clusters": label.tolist(),
        "rows": {side: row.tolist() for side, row in whole.items()},
        "without": without,
        "costs": {side: cost.costs(row).tolist() for side, row in whole.items()},
        "heldout": {side: values.tolist() for side, values in heldout.items()},
        "speed": speed,
        "gap": [float(data.gap_of(pair).mean()) for pair in pairs],
    }


def jackknifed(values: np.ndarray, left_out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors of estimates ``(P,)`` from those without each of G clusters ``(G, P)``, and
    the half width of their 95 % intervals (Student's t with G - 1 degrees of freedom).

    Source:
        Efron & Tibshirani 1993, chapter 11.
    """
    from scipy.stats import t

    number = len(left_out)
    away = left_out - left_out.mean(0)
    error = np.sqrt((number - 1) / number * (away**2).sum(0))
    return error, error * float(t.ppf(0.975, number - 1))
