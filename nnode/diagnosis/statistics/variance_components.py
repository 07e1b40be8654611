"""Variance components of agent-specific parameters, from their autocovariance over time.

Source: Searle, Casella & McCulloch 1992 (variance components by products); Bell & McCaffrey 2002
(the share that a mean takes along).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from nnode.data.clusters import group_sums
from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import Fit, grams

#: Number of parts of a sequence's time in which parameters are estimated.
PARTS = 6
#: Number of time constants that are compared, and the longest as a share of the longest lag.
TRIED, LONGEST = 30, 1 / 3
#: Information below this share of the largest counts as zero.
NONE = 1e-6


@dataclass
class PeriodEstimates:
    """O estimates of agents' parameters in parts of their time.

    Attributes:
        agent, sequence, cluster, recording: ``(O,)`` labels; an agent with an identifier is the
            same in all sequences of a recording.
        time: ``(O,)`` s.
        value: ``(O, D)`` per direction.
        info: ``(O,)`` inverse variances of the estimates.
    """

    agent: np.ndarray
    sequence: np.ndarray
    cluster: np.ndarray
    recording: np.ndarray
    time: np.ndarray
    value: np.ndarray
    info: np.ndarray

    @property
    def weight(self) -> np.ndarray:
        """``(O,)`` the weights that minimise the variance of products."""
        weight, noise = self.info, 1 / self.info
        square = (self.value**2).mean(1)
        for _ in range(3):
            spread = max(float((weight**2 * (square - noise)).sum() / (weight**2).sum()), 0.0)
            weight = 1 / (spread + noise)
        return weight


def period_estimates(engine: Engine, fit: Fit, z: np.ndarray) -> PeriodEstimates:
    """The parameters of all agents in every part of their time."""
    n_sequences = len(engine.sequences)
    begin, end = np.full(n_sequences, np.inf), np.full(n_sequences, -np.inf)
    np.minimum.at(begin, engine.sequence, engine.clock)
    np.maximum.at(end, engine.sequence, engine.clock)
    duration = np.maximum(end - begin, 1e-9)
    elapsed = (engine.clock - begin[engine.sequence]) / duration[engine.sequence]
    part = np.minimum((PARTS * elapsed).astype(int), PARTS - 1)
    present, label = np.unique(PARTS * engine.unit + part, return_inverse=True)
    gram, score = grams(z, label), -group_sums(z * fit.residual[:, None], label)
    count = np.bincount(label)
    time = np.bincount(label, engine.clock) / count
    start = np.unique(label, return_index=True)[1]
    noise = fit.cost / len(fit.residual)
    single_agent = len(engine.people[0]) == 1
    smallest = NONE * float(np.einsum("umm->um", gram).max(initial=0.0))
    identity = _Identity(engine)
    places: list[int] = []
    rows: list[tuple[int, int, int, int, float, np.ndarray, float]] = []
    for k, unit in enumerate(present // PARTS):
        identified = np.flatnonzero(np.diag(gram[k]) > smallest)
        if not len(identified) or (single_agent and len(identified) < z.shape[1]):
            continue
        inverse = np.linalg.pinv(gram[k][np.ix_(identified, identified)])
        value, variances = inverse @ score[k][identified], np.maximum(np.diag(inverse), 1e-300)
        cluster, people = int(engine.cluster[start[k]]), engine.people[unit]
        if single_agent:
            b, n = people[0]
            labels = (identity.agent(b, n), b, cluster, identity.recording[b], float(time[k]))
            rows.append((*labels, value, 1 / (noise * float(variances.mean()))))
            continue
        for m, v, w in zip(identified, value, variances, strict=True):
            b, n = people[m]
            labels = (identity.agent(b, n), b, cluster, identity.recording[b], float(time[k]))
            rows.append((*labels, np.array([v]), 1 / (noise * float(w))))
            places.append(engine.sequences[b].n_agents - n)
    columns = list(zip(*rows, strict=True)) or [()] * 7
    agent, sequence, cluster_of, recording, when, values, info = (np.array(c) for c in columns)
    estimates = PeriodEstimates(agent, sequence, cluster_of, recording, when, values, info)
    if single_agent:
        return estimates
    return _without_place_means(estimates, np.array(places, dtype=int))


def _without_place_means(estimates: PeriodEstimates, place: np.ndarray) -> PeriodEstimates:
    """The estimates minus the mean of all at the same place of the platoon.

    The deviations are scaled up by the leverage of their cluster on this mean (as in CR2, see
    :mod:`~nnode.diagnosis.statistics.leverage`). Places that occur in only one cluster are left
    out.
    """
    value, identified = estimates.value.copy(), np.zeros(len(place), dtype=bool)
    weight = estimates.weight if len(place) else estimates.info
    for p in np.unique(place):
        members = np.flatnonzero(place == p)
        cluster, w, v = estimates.cluster[members], weight[members], estimates.value[members]
        share = np.bincount(cluster, w)[cluster] / w.sum()
        centred = v - w @ v / w.sum()
        identified[members] = share < 1 - 1e-9
        value[members] = centred / np.sqrt(np.maximum(1 - share, 1e-9))[:, None]
    kept = np.flatnonzero(identified)
    parts = {f.name: getattr(estimates, f.name)[kept] for f in fields(estimates)}
    return PeriodEstimates(**{**parts, "value": value[kept]})


class _Identity:
    """Identifies agents across sequences."""

    def __init__(self, engine: Engine) -> None:
        self.sequences = engine.sequences
        names = [s.recording for s in engine.sequences]
        self.recording = np.unique(names, return_inverse=True)[1].reshape(-1)
        self._numbers: dict[tuple[Any, ...], int] = {}

    def agent(self, b: int, n: int) -> int:
        sequence = self.sequences[b]
        key = (sequence.recording, sequence.agents[n]) if sequence.agents else (b, n, None)
        return self._numbers.setdefault(key, len(self._numbers))


@dataclass
class Curve:
    """The autocovariance of parameters at every lag.

    Attributes:
        lags: ``(L,)`` s.
        same, between: ``(2, G, L)`` sums of weighted products and of weights in the G clusters:
            within agents, and between different agents of a sequence.
    """

    lags: np.ndarray
    same: np.ndarray
    between: np.ndarray

    @classmethod
    def of(cls, estimates: PeriodEstimates) -> Curve | None:
        """The autocovariance; None if there are fewer than three lags."""
        weight = estimates.weight
        value = weight[:, None] * estimates.value / np.sqrt(estimates.value.shape[1])
        steps = []
        for s in np.unique(estimates.sequence):
            times = np.unique(estimates.time[estimates.sequence == s].round(6))
            steps += list(np.diff(times))
        step = float(np.median(steps)) if steps else 0.0
        if not step > 0:
            return None
        pairs = _pairs(estimates.agent, estimates.time, step, lambda i, j: i != j)
        across = _pairs(
            estimates.sequence,
            estimates.time,
            step,
            lambda i, j: estimates.agent[i] != estimates.agent[j],
        )
        n_clusters = int(estimates.cluster.max()) + 1
        n_bins = int(pairs[2].max(initial=0)) + 1
        collected = [
            _collected(part, value, weight, estimates.cluster, n_clusters, n_bins)
            for part in (pairs, across)
        ]
        total = np.bincount(pairs[2], weight[pairs[0]] * weight[pairs[1]], n_bins)
        apart = np.abs(estimates.time[pairs[0]] - estimates.time[pairs[1]])
        lags = np.bincount(pairs[2], apart * weight[pairs[0]] * weight[pairs[1]], n_bins)
        kept = total > 0
        if kept.sum() < 3:
            return None
        present = collected[0][1].sum(1) > 0
        same, between = (part[:, present][:, :, kept] for part in collected)
        return cls(lags[kept] / total[kept], same, between)

    def fitted(self, same: np.ndarray, between: np.ndarray) -> tuple[float, float, float]:
        """A constant, an exponential's height, and its time constant."""
        return self.plateau(ratio(same) - ratio(between), same[1].sum(0))

    def plateau(self, common: np.ndarray, weight: np.ndarray) -> tuple[float, float, float]:
        """Least squares fit of a constant plus an exponential decay over the lag; all 0 without
        weights."""
        best = (np.inf, 0.0, 0.0, 0.0)
        if not weight.sum() > 0:
            return best[1:]
        level = float((weight * common).sum() / weight.sum())
        for tau in np.geomspace(self.lags[0] / 3, LONGEST * self.lags[-1], TRIED):
            fall = np.exp(-self.lags / tau)
            mean = (weight * fall).sum() / weight.sum()
            centred = fall - mean
            curvature = max(float((weight * centred**2).sum()), 1e-300)
            height = float((weight * centred * common).sum()) / curvature
            height = max(height, 0.0)
            constant = level - height * float(mean)
            misfit = float((weight * (common - constant - height * fall) ** 2).sum())
            if misfit < best[0]:
                best = misfit, constant, height, float(tau)
        return best[1:]


def _pairs(
    label: np.ndarray, time: np.ndarray, step: float, keep: Callable[..., np.ndarray]
) -> list[np.ndarray]:
    """Positions i < j of pairs within a label that are apart in time, and their lag's bin."""
    order = np.argsort(label, kind="stable")
    ends = np.flatnonzero(np.diff(label[order])) + 1
    firsts, seconds = [], []
    for members in np.split(order, ends):
        i, j = np.triu_indices(len(members), 1)
        firsts.append(members[i])
        seconds.append(members[j])
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    lag = np.abs(time[first] - time[second]) / step
    kept = (lag > 0.5) & keep(first, second)
    # bins of one step, and from the sixth on wider ones
    number = np.where(lag < 6.5, lag.round(), 6 + (6 * np.log2(np.maximum(lag, 6) / 6)).round())
    return [first[kept], second[kept], number[kept].astype(int)]


def _collected(
    pairs: list[np.ndarray],
    value: np.ndarray,
    weight: np.ndarray,
    cluster: np.ndarray,
    n_clusters: int,
    n_bins: int,
) -> np.ndarray:
    """``(2, G, L)``: see :class:`Curve`."""
    first, second, at = pairs
    inside = at < n_bins
    first, second, at = first[inside], second[inside], at[inside]
    label = cluster[first] * n_bins + at
    product = (value[first] * value[second]).sum(1)
    weighted_sums = [
        np.bincount(label, w, n_clusters * n_bins)
        for w in (product, weight[first] * weight[second])
    ]
    stacked: np.ndarray = np.stack(weighted_sums).reshape(2, n_clusters, n_bins)
    return stacked


def ratio(sums_of: np.ndarray) -> np.ndarray:
    ratios: np.ndarray = sums_of[0].sum(0) / np.maximum(sums_of[1].sum(0), 1e-300)
    return ratios


def shares(
    estimates: PeriodEstimates, curve: Curve, agent_variance: float, transient_variance: float
) -> dict[str, float | None]:
    """Variance components as shares of their sum; negative estimates count as 0."""
    shared, transient_common, _ = curve.plateau(ratio(curve.between), curve.between[1].sum(0))
    weight = estimates.weight
    total, size = 0.0, 0.0
    for r in np.unique(estimates.recording):
        inside = estimates.recording == r
        members = [inside & (estimates.cluster == c) for c in np.unique(estimates.cluster[inside])]
        parts = [(weight[m] @ estimates.value[m], weight[m].sum()) for m in members]
        values, sizes = np.stack([v for v, _ in parts]), np.array([w for _, w in parts])
        total += float((values.sum(0) ** 2).sum() - (values**2).sum()) / values.shape[1]
        size += float(sizes.sum() ** 2 - (sizes**2).sum())
    several = len(np.unique(estimates.recording)) > 1 and size > 0
    recording = total / size if several else 0.0
    components = {
        "recording": max(recording, 0.0),
        "sequence": max(shared - max(recording, 0.0), 0.0),
        "agent": max(agent_variance, 0.0),
        "transient": max(transient_variance, 0.0) + max(transient_common, 0.0),
    }
    total_variance = sum(components.values())
    share: dict[str, float | None] = {
        name: value / total_variance if total_variance > 0 else 0.0
        for name, value in components.items()
    }
    if not several:
        share["recording"] = None
    return share
