"""The compared laws, and the calculations on pairs, platoons, and kinds of leaders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from typing import Any

import numpy as np
from scipy.stats import t

from nnode.calibrate.cost import Convention
from nnode.calibrate.intervals import at_bounds, influence
from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.problem import ResidualProblem, pooled, random_starts, separate
from nnode.calibrate.resampling import paired
from nnode.data.clusters import folds as by_cluster
from nnode.data.sequence import Batch, Sequence, collate
from nnode.model.build import build_model
from nnode.model.laws import CAR_FOLLOWING_LAWS, NEURONS
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver
from studies.following import data, printed
from studies.following.data import gap_of
from studies.following.halves import calibrated_halves
from studies.stores import sequences

#: Cost of a network's weight of 1, m: networks of so few pairs are kept flat.
DECAY = 1e-3

#: A network that is told the time gap that a driver keeps at first, and how it fades.
_REMEMBERING: dict[str, Any] = {
    "parameters": {
        "tau_m": {"value": "30 s", "low": "1 s", "high": "2000 s"},
        "T": {"value": "1.2 s", "low": "0.05 s", "high": "5 s"},
    },
    "constants": {"s0": "2 m", "slowest": "2 m/s", "shortest": "0.1 s", "longest": "5 s"},
    "states": {
        "q": [
            "s",
            "(T - q)/tau_m",
            "clip((gap - length_1 - s0)/max(v, slowest), shortest, longest)",
        ]
    },
    "where": {"net": "gap - length_1"},
    "rate": {"v": "NN(net/20, v/10, dv/2, q)"},
    "source": "acceleration as a network of gap, speed, speed difference and a fading time gap",
}


@dataclass(frozen=True)
class Candidate:
    """A law, and what is added to it.

    Attributes:
        law: its name.
        effects: of the catalogue.
        network: neurons of a network beside the law; None: none, or the law's own.
        description: of the law; None: that of :data:`nnode.model.laws.CAR_FOLLOWING_LAWS`.
    """

    law: str
    effects: tuple[str, ...] = ()
    network: int | None = None
    description: Mapping[str, Any] | None = None

    def system(self, seed: int = 0) -> System:
        """The model behind a measured leader; weights of a network depend on the seed.

        In place of Runge and Kutta's steps it has those of the published comparisons, ballistic
        ones of 0.1 s (Treiber & Kanagaraj 2015). Maps keep their own steps.
        """
        law = dict(self.description or CAR_FOLLOWING_LAWS[self.law])
        if law.get("step") == "rk4":
            law["step"] = "ballistic"
        return build_model(
            {
                "term": "formula",
                "name": self.law,
                "leader": "measured",
                "law": law,
                "network": NEURONS.get(self.law, self.network),
                "effects": [{"name": effect} for effect in self.effects],
            },
            seed=seed,
        )


def candidate(name: str) -> Candidate:
    """The law and the effects of a name such as ``idm + reaction delay + network 4``."""
    law, *added = name.replace(" ", "_").split("_+_")
    neurons = {part: int(part.removeprefix("network_")) for part in added if "network" in part}
    effects = tuple(part for part in added if part not in neurons)
    return Candidate(law, effects, next(iter(neurons.values()), None))


def published_law(name: str, values: dict[str, float]) -> dict[str, Any]:
    """A law of :data:`nnode.model.laws.CAR_FOLLOWING_LAWS` with published parameters, its
    acceleration clipped, in the published steps, ballistic ones.

    Args:
        values: by parameter, SI units.
    """
    law, (low, high) = CAR_FOLLOWING_LAWS[name], printed.clipped[name]
    ends = {"least_rate": f"{low} m/s²", "most_rate": f"{high} m/s²"}
    return {
        **law,
        "parameters": {name: f"{value!r} {printed.units[name]}" for name, value in values.items()},
        "constants": {**law.get("constants", {}), **ends},
        "rate": {"v": f"clip({law['rate']['v']}, least_rate, most_rate)"},
        "step": "ballistic",
    }


def key(name: str) -> str:
    """A candidate's name as a file name."""
    return name.replace(" + ", "-").replace(" ", "_")


#: Names to candidates. More than one leader is no candidate, because a pair has one.
EVERY: dict[str, Candidate] = {
    **{
        name: candidate(name)
        for name in (
            *CAR_FOLLOWING_LAWS,
            "idm + memory",
            "idm + inertia",
            "idm + reaction delay",
            "helly + memory",
            "helly + inertia",
            "helly + reaction delay",
            "gipps + memory",
            "krauss + memory",
            "fvdm + reaction delay",
            "idm + memory + inertia",
            "idm + memory + reaction delay",
            "helly + memory + inertia",
            "helly + memory + reaction delay",
            "idm + network 4",
            "idm + memory + network 4",
            "helly + memory + network 4",
        )
    },
    "remembering network": Candidate("remembering_network", network=4, description=_REMEMBERING),
}

#: What others are compared with.
REFERENCE = "idm"


def starts(model: Candidate, cost: ResidualProblem, number: int, seed: int) -> np.ndarray:
    """``(number, P)`` rows: the shelf's own values, then random ones within the limits.

    Weights of networks are drawn as models draw them, those beside a law start at 0 in their
    last layer.
    """
    systems = (model.system(seed + i) for i in range(number))
    rows = (ParameterVector(system, cost.vector.places).row.numpy() for system in systems)
    return random_starts(cost, rows, seed)


def decay(cost: ResidualProblem) -> tuple[np.ndarray, np.ndarray] | None:
    """Centre and weights of the penalty on a network's weights; None where there is none."""
    free = ~(np.isfinite(cost.low) & np.isfinite(cost.high))
    return (np.zeros(len(free)), DECAY * free) if free.any() else None


Result = dict[str, Any]

#: What is reported, whichever of them is minimised, with its unit.
OBJECTIVES = {
    "spacing": "gap, RMSE (m)",
    "gap": "gap, MSE (m²)",
    "relative_gap": "relative gap, MSE",
    "log_gap": "log of the gap, MSE",
    "speed": "speed, MSE (m²/s²)",
}
#: A calibration ends after so many steps, or when one lowers the cost by less than this share.
STEPS, TOLERANCE = 60, 1e-7


def costs_of(candidate: Candidate, batch: Batch, objective: str = "spacing") -> ResidualProblem:
    """A candidate's cost on pairs; the usual steps of its law."""
    return ResidualProblem(candidate.system(), batch, FusedSolver(), Convention(objective))


def calibrated(
    candidate: Candidate,
    cost: ResidualProblem,
    restarts: int,
    seed: int,
    weights: np.ndarray | None = None,
) -> np.ndarray:
    """``(P,)`` parameters of the best of several starts, penalty included."""
    fits = [
        pooled(cost, row, weights, penalty=decay(cost), steps=STEPS, tolerance=TOLERANCE)
        for row in starts(candidate, cost, restarts, seed)
    ]
    return min(fits, key=lambda fit: float(fit.cost)).row


def named(cost: ResidualProblem, row: np.ndarray) -> dict[str, float]:
    """Parameters by name; one that a term before has as well bears its own term's before it."""
    parameters: dict[str, float] = {}
    for address, value in zip(cost.names, row, strict=True):
        name = address.split(".", 1)[1]
        parameters[address if name in parameters else name] = float(value)
    return parameters


def at_limits(cost: ResidualProblem, row: np.ndarray) -> list[str]:
    """Names of the parameters that ended at a limit."""
    bounds = at_bounds(row, cost.low, cost.high)
    return [name for name, bound in zip(named(cost, row), bounds, strict=True) if bound]


def _costs_by_objective(name: str, folder: str) -> dict[str, ResidualProblem]:
    """The costs of a candidate on the training pairs, by objective."""
    batch = data.batch(folder)
    return {o: costs_of(EVERY[name], batch, o) for o in OBJECTIVES}


def cross_validate(folder: str, name: str, restarts: int, folds: int, seed: int) -> Result:
    """Calibrate on all training pairs, and, from half the starts, on those outside each fold.

    Returns:
        Costs of all training pairs, and costs by objective of those that were held out.
    """
    candidate, costs = EVERY[name], _costs_by_objective(name, folder)
    cost = costs["spacing"]
    label = data.labels(data.pairs(folder))
    fold = by_cluster(label, folds, seed)
    whole = calibrated(candidate, cost, restarts, seed)
    heldout = {objective: np.zeros(len(label)) for objective in OBJECTIVES}
    for k in range(folds):
        weights = (fold != k) / (fold != k).sum()
        row = calibrated(candidate, cost, max(1, restarts // 2), seed, weights)
        for objective, values in heldout.items():
            values[fold == k] = costs[objective].costs(row)[fold == k]
    return {
        "parameters": named(cost, whole),
        "row": whole,
        "limits": at_limits(cost, whole),
        "train": cost.costs(whole),
        "heldout": heldout,
        "clusters": label,
    }


def floor(folder: str, name: str, restarts: int, seed: int) -> Result:
    """Every training pair with parameters of its own."""
    candidate = EVERY[name]
    cost = costs_of(candidate, data.batch(folder))
    centre = calibrated(candidate, cost, 1, seed)
    rows, costs = separate(cost, (centre, *starts(candidate, cost, restarts, seed)))
    return {"costs": costs, "limits": [at_limits(cost, row) for row in rows]}


def objectives(folder: str, name: str, restarts: int, seed: int) -> Result:
    """All objectives on the training pairs, whichever is minimised."""
    costs = _costs_by_objective(name, folder)
    by_objective: Result = {}
    for minimised, cost in costs.items():
        row = calibrated(EVERY[name], cost, restarts, seed)
        by_objective[minimised] = {
            "reached": {other: costs[other].costs(row).mean() for other in OBJECTIVES},
            "parameters": named(cost, row),
            "limits": at_limits(cost, row),
        }
    return by_objective


def tested(folder: str, name: str, row: list[float]) -> Result:
    """Costs of the test pairs."""
    cost = costs_of(EVERY[name], data.batch(folder, test=True))
    return {"costs": cost.costs(np.array(row))}


def reproduced_pairs(folder: str) -> Result:
    """Costs of the test pairs, m, of the published parameters; the first sample counts as well."""
    batch = data.batch(folder, test=True)
    samples = batch.valid[:, :, 0].sum(0).numpy()
    first = np.sqrt((samples - 1) / samples)
    errors: Result = {}
    for law, parameters in printed.parameters.items():
        for k, objective in enumerate(printed.objectives):
            values = {name: each[k] for name, each in parameters.items()}
            cost = costs_of(Candidate(law, description=published_law(law, values)), batch)
            errors[f"{law} {objective}"] = cost.costs(cost.start) * first
    return errors


#: Factors on a parameter, at which all others are calibrated again.
PROFILE = np.geomspace(0.25, 4, 17)


def precision(folder: str, name: str, row: list[float]) -> Result:
    """Half widths of intervals from clusters, correlations, and a profile of every parameter."""
    label = data.labels(data.pairs(folder))
    cost, best = costs_of(EVERY[name], data.batch(folder)), np.array(row)
    names = list(named(cost, best))
    free = at_bounds(best, cost.low, cost.high) == ""
    influences = influence(cost, best, label, free)
    covariance, half = np.zeros((len(best), len(best))), np.zeros(len(best))
    covariance[np.ix_(free, free)], half[free] = influences.covariance(), influences.half_widths()
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    return {
        "names": names,
        "row": row,
        "half": half,
        "correlation": covariance / np.outer(scale, scale),
        "profiles": {n: profile(cost, best, i, label) for i, n in enumerate(names)},
    }


def profile(cost: ResidualProblem, best: np.ndarray, place: int, label: np.ndarray) -> Result:
    """Costs with one parameter held at other values, all others calibrated again.

    Returns:
        ``values``; ``rise``: mean over pairs, m; ``low`` and ``high``: of its 95 % interval,
        clusters resampled.
    """
    low, high = cost.low.copy(), cost.high.copy()
    before, points = cost.costs(best), []
    try:
        # from the best value downwards, and upwards
        for factors in (PROFILE[PROFILE < 1][::-1], PROFILE[PROFILE >= 1]):
            start = best
            for factor in factors:
                value = float(np.clip(best[place] * factor, low[place], high[place]))
                cost.low[place] = cost.high[place] = value
                row = start.copy()
                row[place] = value
                start = pooled(cost, row).row
                rise = paired(cost.costs(start), before, label, seed=0)
                points.append((value, rise.difference, rise.low, rise.high))
    finally:
        cost.low[:], cost.high[:] = low, high
    columns = zip(*sorted(points, key=itemgetter(0)), strict=True)
    return dict(zip(("values", "rise", "low", "high"), columns, strict=True))


def halves(
    folder: str, name: str, row: list[float], folds: int, restarts: int, seed: int
) -> Result:
    """Pooled, alone and in between: calibrated on the first half of every pair, judged on the
    second.

    How much pairs are drawn towards the pool is chosen for each fold from the pairs outside it.
    """
    pairs = data.pairs(folder)
    first, second = (
        costs_of(EVERY[name], collate([s.part(low, low + 0.5) for s in pairs]))
        for low in (0.0, 0.5)
    )
    label = data.labels(pairs)
    fold = by_cluster(label, folds, seed)
    others = starts(EVERY[name], first, restarts, seed)
    results = calibrated_halves(first, second, np.array(row), others, fold)
    return {"names": list(named(first, results.centre)), **vars(results), "clusters": label}


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


#: Laws that are tried on commercial cars, those of accelerations also with what delays them.
ACCELERATIONS = ("idm", "gipps", "ovm", "fvdm", "helly")
ON_TRACK = [
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
    rows, _ = separate(cost, begin, steps=STEPS, tolerance=TOLERANCE, penalty=decay(cost))
    return cost, rows


def reproduced_platoon(folder: str) -> Result:
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
    smallest, (low, high) = 0.1, printed.clipped["ovm"]
    kappa, v0, s_c, w = (values[name] for name in ("kappa", "v0", "s_c", "w"))
    measured, (follower, lead) = gap_of(pair), pair.velocity()[..., 0].T
    gap, v, gaps = float(measured[0]), float(follower[0]), [float(measured[0])]
    shift = math.tanh(s_c / w)
    for now, then in pairwise(lead):
        wish = v0 * (math.tanh((max(gap, smallest) - s_c) / w) + shift) / (1 + shift)
        rate = min(max(kappa * (wish - v), low), high)
        after = v + rate * pair.dt
        way = (v + after) / 2 * pair.dt if after > 0 else -v * v / (2 * rate)
        gap, v = gap + (now + then) / 2 * pair.dt - way, max(after, 0.0)
        if gap < smallest:
            gap, v = smallest, min(v, then)
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
