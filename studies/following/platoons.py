"""OpenACC's platoons: every follower behind its measured leader, by itself."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from nnode.calibrate.pooling import best_alone
from nnode.calibrate.problem import ResidualProblem
from nnode.data.sequence import Batch, Sequence, collate
from studies.following import data, printed
from studies.following.candidates import Candidate, candidate, decay, published_law, starts
from studies.following.data import gap_of
from studies.following.fit import STEPS, TOLERANCE, at_limits, costs_of, named
from studies.stores import sequences

Result = dict[str, Any]

#: Laws that are tried on commercial cars, those of accelerations also with what delays them.
ACCELERATIONS = ("idm", "gipps", "ovm", "fvdm", "helly")
CANDIDATES = [
    *(
        f"{law}{added}"
        for law in ACCELERATIONS
        for added in ("", " + inertia", " + reaction delay")
    ),
    *("krauss", "newell", "a2", "a4"),
]


def followers(folder: str, run: str | None = None) -> list[Sequence]:
    """Pairs of all followers of a run, or of all runs."""
    return [
        pair
        for platoon in sequences(folder)
        if run is None or platoon.recording == run
        for pair in data.behind(platoon)
    ]


def separate_rows(
    name: str, batch: Batch, restarts: int, seed: int
) -> tuple[ResidualProblem, np.ndarray]:
    """The cost, and ``(B, P)`` the best rows of several starts, separately for every pair."""
    law = candidate(name)
    cost = costs_of(law, batch)
    begin = starts(law, cost, restarts, seed)
    rows, _ = best_alone(cost, begin, steps=STEPS, tolerance=TOLERANCE, penalty=decay(cost))
    return cost, rows


def reproduced(folder: str) -> Result:
    """By make, the error (m) of the published parameters on the last part: ``law`` as it is
    simulated here, ``stopped`` with the published rule for collisions."""
    by_make: Result = {"law": {}, "stopped": {}}
    for pair in followers(folder, printed.platoon):
        make = pair.agents[0]
        values = printed.platoon_parameters[make]
        law = Candidate("ovm", description=published_law("ovm", values))
        last_part = pair.part(printed.first, 1.0)
        cost = costs_of(law, collate([last_part]))
        by_make["law"][make] = cost.costs(cost.start)[0]
        by_make["stopped"][make] = collided(last_part, values)
    return by_make


def collided(pair: Sequence, values: dict[str, float]) -> float:
    """Error of the gap, m, of optimal velocity where a gap below 0.1 m becomes 0.1 m and the
    speed at most the leader's: no law, but what the published figures were made with.

    Args:
        values: ``kappa``, ``v0``, ``s_c``, ``w`` in SI units.
    """
    least, (low, high) = 0.1, printed.clipped["ovm"]
    kappa, v0, s_c, w = (values[name] for name in ("kappa", "v0", "s_c", "w"))
    measured, (own, lead) = gap_of(pair), pair.velocity()[..., 0].T
    gap, v, gaps = float(measured[0]), float(own[0]), [float(measured[0])]
    shift = math.tanh(s_c / w)
    for now, then in pairwise(lead):
        wish = v0 * (math.tanh((max(gap, least) - s_c) / w) + shift) / (1 + shift)
        rate = min(max(kappa * (wish - v), low), high)
        after = v + rate * pair.dt
        way = (v + after) / 2 * pair.dt if after > 0 else -v * v / (2 * rate)
        gap, v = gap + (now + then) / 2 * pair.dt - way, max(after, 0.0)
        if gap < least:
            gap, v = least, min(v, then)
        gaps.append(gap)
    return float(np.sqrt(np.mean((np.array(gaps) - measured) ** 2)))


def compare(folder: str, name: str, restarts: int, seed: int) -> Result:
    """One law on the published platoon.

    Returns:
        By follower ``chosen``: errors on the last 30 % of the first part, calibrated on what
        stands before; ``train`` and ``heldout``: calibrated on the whole first part. m.
    """
    pairs, first = followers(folder, printed.platoon), printed.first

    def share(low: float, high: float) -> Batch:
        return collate([pair.part(low, high) for pair in pairs])

    _, rows = separate_rows(name, share(0.0, first**2), restarts, seed)
    chosen = costs_of(candidate(name), share(first**2, first)).costs(rows)
    cost, rows = separate_rows(name, share(0.0, first), restarts, seed)
    return {
        "makes": [pair.agents[0] for pair in pairs],
        "chosen": chosen,
        "train": cost.costs(rows),
        "heldout": costs_of(candidate(name), share(first, 1.0)).costs(rows),
        "limits": [at_limits(cost, row) for row in rows],
    }


def every_run(folder: str, name: str, restarts: int, seed: int) -> Result:
    """One law on every follower of every run, each by itself."""
    pairs = followers(folder)
    cost, rows = separate_rows(name, collate(pairs), restarts, seed)
    return {
        "runs": [pair.recording for pair in pairs],
        "makes": [pair.agents[0] for pair in pairs],
        "settings": [str(pair.group[0]) if pair.group else "" for pair in pairs],
        "costs": cost.costs(rows),
        "parameters": [named(cost, row) for row in rows],
        "limits": [at_limits(cost, row) for row in rows],
    }
