"""Score tests of missing effects by sign flips of clusters.

The trace of an effect is the derivative of the residuals by its strength. It is projected
orthogonally to the tangents of the model's parameters (efficient scores), because recalibration
would absorb the rest. Under the null hypothesis, the scores of clusters are symmetric, so their
signs can be flipped. The statistic of each effect is compared with its own distribution under
flips, and the smallest of these p-values with the distribution of the smallest (min-p). So an
effect with many intervals, whose maximum is large by chance, does not reduce the power for the
other effects.

Residuals have small systematic errors: measured positions are smoothed, and people are simulated
among the measured paths of others who have reacted to them. Under the null hypothesis, these errors
amount to a twentieth of the minimum size of some effects, which is significant in large data sets.
Therefore the tests are of a minimal effect: whether it exceeds a tenth of the minimum size.

Source: Rao 1948 (scores); Canay, Romano & Shaikh 2017 (sign changes); Hemerik, Goeman & Finos 2020
(of scores that are free of nuisance parameters); Westfall & Young 1993 (least p-value over
hypotheses); Murphy & Myors 1999 (tests of a minimal effect).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from nnode.data.clusters import group_sums, signs
from nnode.diagnosis import thresholds
from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.residuals.fit import grams as grams_of
from nnode.diagnosis.statistics.leverage import leverage_adjusted, orthonormal, without_span
from nnode.diagnosis.statistics.standard import cluster_variance_of, joint, standardised
from nnode.model.effects import Effect, Probe

#: Number of sign flips of a p-value.
FLIPS = 1999
#: Parts of a cell in steps of which an effect increases over its width.
PARTS = 4


@dataclass
class Trace:
    """The linear response of the residuals to an effect.

    Attributes:
        effect: its class.
        probes: one; or the neighbouring cells of an effect on an interval.
        columns: ``(n, k)`` per unit of each strength of the probe, or per cell.
        bias: ``(G, k)`` mean scores under the null hypothesis.
    """

    effect: type[Effect]
    probes: list[Probe]
    columns: np.ndarray
    bias: np.ndarray | float = 0.0


@dataclass
class Evidence:
    """The scores of clusters in one direction.

    Attributes:
        options: of the probe.
        size: the finite strength of the trace of an effect with memory; otherwise 0.
        parts, grams: ``(G,)`` scores and their information.
        minimal: the largest negligible strength.
        amount, error: of intervals, the estimated strength and its standard error.
    """

    options: dict[str, Any]
    size: float
    parts: np.ndarray
    grams: np.ndarray
    minimal: float
    amount: float = float("nan")
    error: float = float("nan")


@dataclass
class Score:
    """The score test of an effect, for its best trace.

    Attributes:
        effect: its class.
        options: start values for a calibration with this effect.
        statistic: on the scale of a standard normal variable.
        p_value: corrected for all effects (min-p).
        gain: share of the sum of squares that the trace explains.
        amount: estimated strengths minus their neutral values.
        error: standard errors of ``amount``.
        evidence: of every strength; for an effect with memory, or without a strength, of every
            probe; for an effect on an interval, of every interval of the usual length.
    """

    effect: type[Effect]
    options: dict[str, Any]
    statistic: float
    p_value: float
    gain: float
    amount: dict[str, float]
    error: dict[str, float]
    evidence: list[Evidence] = field(default_factory=list)


def traces(engine: Engine, fit: Fit, effect: type[Effect]) -> list[Trace]:
    """The traces of an effect's probes in the residuals of a calibrated model."""
    probes = effect.probes(engine.batch, fit.system)
    if not probes:
        return []
    if not effect.consecutive:
        columns = _columns(engine, fit, effect, *probes)
        ends = np.cumsum([max(len(probe.steps), 1) for probe in probes])
        parts = np.split(columns, ends[:-1], 1)
        return [Trace(effect, [p], part) for p, part in zip(probes, parts, strict=True)]
    # cells of one size are neighbours of each other
    sizes = dict.fromkeys(tuple(probe.steps.values()) for probe in probes)
    sized = [[p for p in probes if tuple(p.steps.values()) == size] for size in sizes]
    if effect.overlapping:
        return [_overlapping_cells(engine, fit, effect, cells) for cells in sized]
    return [Trace(effect, cells, _columns(engine, fit, effect, *cells)) for cells in sized]


def _columns(engine: Engine, fit: Fit, effect: type[Effect], *probes: Probe) -> np.ndarray:
    """``(n, k)`` the linear response of the residuals to the strengths of probes."""
    row = torch.from_numpy(fit.row)
    columns: np.ndarray = engine.screen_columns(fit.system, row, effect, *probes).numpy().T
    return columns


def _overlapping_cells(
    engine: Engine, fit: Fit, effect: type[Effect], probes: list[Probe]
) -> Trace:
    """The trace of neighbouring cells, in which an effect increases and decreases linearly over the
    width of a cell.

    The sum of neighbouring cells is an interval with such ends. Where the true ends are sharp and
    lie within a cell, sharp ends at its boundaries would have jumps at wrong places, and
    generalised least squares would weight them more than all that lies between them.
    """
    number = len(probes)
    low, high = probes[0].options["a"], probes[-1].options["b"]
    places = np.linspace(low, high, PARTS * number + 1)
    # the effect's own ends are not within what was measured
    places[0], places[-1] = 2 * low - high, 2 * high - low
    to_the_end = [
        replace(probes[0], options={**probes[0].options, "a": place, "b": 2 * high - low})
        for place in places.tolist()
    ]
    parts = -np.diff(_columns(engine, fit, effect, *to_the_end))
    padded = np.pad(parts, ((0, 0), (PARTS // 2, PARTS // 2)))
    rising = (np.arange(PARTS) + 0.5) / PARTS
    weights = np.tile(np.concatenate([rising, rising[::-1]]), (number, 1))
    # nothing was measured beyond the first and the last cell
    weights[0, :PARTS] = weights[-1, PARTS:] = 1.0
    columns = [padded[:, PARTS * k : PARTS * (k + 2)] @ weight for k, weight in enumerate(weights)]
    return Trace(effect, probes, np.stack(columns, 1))


class Screen:
    """Score tests of effects against the residuals of one fit.

    Args:
        fit: the calibrated model.
        cluster: ``(n,)`` see :class:`~nnode.diagnosis.residuals.engine.Engine`.
        seed: of the sign flips.
        flips: their largest number; with few clusters, all combinations are used.
        levels: by an effect's name, the independent clusters ``(n,)`` of its test, if coarser.
    """

    def __init__(
        self,
        fit: Fit,
        cluster: np.ndarray,
        seed: int = 0,
        flips: int = FLIPS,
        levels: dict[str, np.ndarray] | None = None,
    ) -> None:
        self.fit, self.cluster, self.levels = fit, cluster, levels or {}
        self.residual = fit.residual
        self.variance = fit.cost / len(fit.residual)
        self._basis = orthonormal(fit.jacobian)
        self._rng = np.random.default_rng(seed)
        #: ``(F, G)``; the first row is the data without flips
        self._signs = signs(int(cluster.max()) + 1, flips, self._rng)
        #: by an effect's name, the largest statistic of its probes under each flip
        self._null_statistics: dict[str, np.ndarray] = {}
        self._smallest_shares = np.ones(len(self._signs))
        self._adjusted_residuals: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def adjusted(self, columns: np.ndarray) -> np.ndarray:
        """``columns`` projected orthogonally to the tangents of all of the model's parameters, also
        those at a bound."""
        return without_span(columns, self._basis)

    def parts(self, z: np.ndarray, label: np.ndarray) -> np.ndarray:
        """``(G, k)`` scores of directions that are orthogonal to the model's tangents.

        Fitted residuals have smaller variances than the errors, so sign flips of their scores would
        be anticonservative. Therefore each cluster's residuals are scaled up by its leverage, and
        the sum of the scores is kept.

        Source: Bell & McCaffrey 2002 (CR2).
        """
        key = id(label)
        if key not in self._adjusted_residuals:
            self._adjusted_residuals[key] = (
                leverage_adjusted(self.residual, self._basis, label),
                label,
            )
        raw = z.T @ self.residual
        scores, size = (
            group_sums(z, label, self._adjusted_residuals[key][0]),
            group_sums(z**2, label),
        )
        share = size / np.maximum(size.sum(0), 1e-300)
        balanced: np.ndarray = scores + (raw - scores.sum(0)) * share
        return balanced

    def flipped(self, parts: np.ndarray) -> np.ndarray:
        """``(F, C)`` sums of the clusters ``(G, C)`` under every flip, the data first."""
        total: np.ndarray = self._signs @ parts
        return total

    def label(self, name: str) -> np.ndarray:
        """``(n,)`` the independent clusters of an effect's test."""
        return self.levels.get(name, self.cluster)

    def scores(self, effect_traces: Iterable[Trace]) -> list[Score]:
        """The score test of each effect, ordered by decreasing gain."""
        best: dict[str, Score] = {}
        largest: dict[str, float] = {}
        for trace in effect_traces:
            scores = self._interval(trace) if trace.effect.consecutive else [self._single(trace)]
            for score in scores:
                name, previous = score.effect.name, best.get(score.effect.name)
                largest[name] = max(largest.get(name, 0.0), score.statistic)
                all_evidence = (previous.evidence if previous else []) + score.evidence
                if previous is None or score.gain > previous.gain:
                    best[name] = score
                if trace.effect.remembers() or not trace.effect.strengths:
                    best[name].evidence = all_evidence
        if best:
            self._judge(best, largest)
        return sorted(best.values(), key=lambda score: -score.gain)

    def _judge(self, best: dict[str, Score], largest: dict[str, float]) -> None:
        """Set the p-values, corrected for all effects."""
        # the data themselves are one of the flips
        statistics = np.stack(
            [np.append(largest[name], self._null_statistics[name][1:]) for name in best]
        )
        share = np.stack([at_least(row) for row in statistics])
        self._smallest_shares = share.min(0)
        for score, p_value in zip(best.values(), share[:, 0], strict=True):
            score.p_value = float((self._smallest_shares <= p_value + 1e-12).mean())

    def p_values(self, name: str, statistics: np.ndarray) -> np.ndarray:
        """``(R,)`` p-values, corrected for all effects, that an effect would have with these
        statistics."""
        null = np.sort(self._null_statistics[name])
        share = 1 - np.searchsorted(null, statistics, side="left") / len(null)
        shares = np.sort(self._smallest_shares)
        corrected = np.searchsorted(shares, share + 1e-12, side="right") / len(shares)
        return np.asarray(np.maximum(corrected, 1 / len(shares)))

    def statistic(self, evidence: Evidence, parts: np.ndarray) -> np.ndarray:
        """``(R,)`` the statistic of a direction if its scores were ``parts`` ``(G, R)``."""
        cluster_variance = cluster_variance_of(
            evidence.parts[:, None], evidence.grams[:, None], self.variance
        )
        sizes = np.repeat(evidence.grams[:, None], parts.shape[1], 1)
        amount = -parts.sum(0) / max(float(evidence.grams.sum()), 1e-300)
        parts = parts + sizes * _negligible(amount, evidence.minimal)
        return standardised(parts, sizes, np.ones((1, len(parts))), cluster_variance)[0]

    def costs(self, name: str) -> np.ndarray:
        """``(G,)`` sums of squared residuals of the clusters of an effect's test."""
        return group_sums(self.residual**2, self.label(name))

    def _store_null(self, name: str, statistics: np.ndarray) -> None:
        """Update an effect's largest statistics ``(F,)`` under the flips."""
        self._null_statistics[name] = np.maximum(self._null_statistics.get(name, 0.0), statistics)

    def _flips(self, name: str) -> np.ndarray:
        """``(F, G)`` signs of the clusters of an effect's test, the data first."""
        if name not in self.levels:
            return self._signs
        shape = len(self._signs), int(self.levels[name].max()) + 1
        flips: np.ndarray = self._rng.choice([-1.0, 1.0], shape)
        flips[0] = 1.0
        return flips

    def _single(self, trace: Trace) -> Score:
        z, label = self.adjusted(trace.columns), self.label(trace.effect.name)
        parts = self.parts(z, label) - trace.bias
        grams = grams_of(z, label)
        minimal = negligible_strengths(trace.effect, z.shape[1])
        margin = _negligible(-np.linalg.pinv(grams.sum(0), rcond=1e-10) @ parts.sum(0), minimal)
        shifted = parts + grams @ margin
        chance = joint(shifted, grams, self._flips(trace.effect.name), self.variance)
        statistic = float(chance[0])
        amount, error, gain = self._estimate(parts, grams)
        (probe,) = trace.probes
        options, amounts, errors = dict(probe.options), {}, {}
        for name, value, width in zip(probe.steps, amount, error, strict=False):
            strength = trace.effect.strengths[name]
            options[name] = strength.at(value)
            amounts[name], errors[name] = float(value), float(width)
        if len(probe.steps) == 1 and value != 0:
            # an implausible strength indicates another effect
            share = float(np.clip((options[name] - strength.neutral) / value, 0.0, 1.0))
            if share < thresholds.PLAUSIBLE:
                statistic, gain = statistic * share, gain * share * (2 - share)
        self._store_null(trace.effect.name, chance)
        # the trace of an effect with memory is that of a finite strength
        size = max(map(abs, probe.steps.values()), default=0.0) if trace.effect.remembers() else 0.0
        evidence = [
            Evidence(probe.options, size, parts[:, i], grams[:, i, i], minimal[i])
            for i in range(z.shape[1])
        ]
        return Score(trace.effect, options, statistic, 1.0, gain, amounts, errors, evidence)

    def _interval(self, trace: Trace) -> list[Score]:
        """The best interval of neighbouring cells."""
        z, label = self.adjusted(trace.columns), self.label(trace.effect.name)
        parts = self.parts(z, label) - trace.bias
        grams = grams_of(z, label)
        cells = z.shape[1]
        first, last = np.triu_indices(cells)
        cumulative = np.concatenate([np.zeros((len(parts), 1)), parts.cumsum(1)], 1)
        interval_parts = cumulative[:, last + 1] - cumulative[:, first]
        square = np.zeros((len(parts), cells + 1, cells + 1))
        square[:, 1:, 1:] = grams.cumsum(1).cumsum(2)
        sizes = (
            square[:, last + 1, last + 1]
            - square[:, first, last + 1]
            - square[:, last + 1, first]
            + square[:, first, first]
        )
        size = sizes.sum(0)
        usable = size > 1e-9 * max(size.max(), 1e-300)
        interval_parts, sizes, size = interval_parts[:, usable], sizes[:, usable], size[usable]
        if not size.size:
            return []
        first, last = first[usable], last[usable]
        cluster_variance = cluster_variance_of(parts, np.einsum("bii->bi", grams), self.variance)
        (minimal,) = negligible_strengths(trace.effect, 1)
        shifted = interval_parts + sizes * _negligible(-interval_parts.sum(0) / size, minimal)
        flipped = standardised(shifted, sizes, self._flips(trace.effect.name), cluster_variance)
        self._store_null(trace.effect.name, flipped.max(1))
        total = interval_parts.sum(0)
        gain = total**2 / size / (self.residual @ self.residual)
        (name,) = trace.effect.strengths
        strength = trace.effect.strengths[name]
        amount = -total / size
        residual_square = ((interval_parts + amount * sizes) ** 2).sum(0)
        blocks = size**2 / (sizes**2).sum(0)
        prior = thresholds.PRIOR
        variance = (blocks * residual_square + prior * cluster_variance * size) / (blocks + prior)
        error = np.sqrt(variance) / size

        def options(i: int) -> dict[str, Any]:
            ends = {"a": trace.probes[first[i]].options["a"]}
            ends["b"] = trace.probes[last[i]].options["b"]
            return {**trace.probes[0].options, **ends, name: strength.at(amount[i])}

        i = int(np.argmax(gain))
        ends = trace.effect.settings
        cell = trace.probes[0].options
        length = (ends["b"].value - ends["a"].value) / (cell["b"] - cell["a"])
        usual_length = last - first + 1 == np.clip(round(length), 1, cells)
        return [
            Score(
                trace.effect,
                options(i),
                float(flipped[0].max()),
                1.0,
                float(gain[i]),
                {name: float(amount[i])},
                {name: float(error[i])},
                [
                    Evidence(
                        options(k),
                        0.0,
                        interval_parts[:, k],
                        sizes[:, k],
                        minimal,
                        float(amount[k]),
                        float(error[k]),
                    )
                    for k in np.flatnonzero(usual_length).tolist()
                ],
            )
        ]

    def _estimate(
        self, parts: np.ndarray, grams: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float]:
        inverse = np.linalg.pinv(grams.sum(0), rcond=1e-10)
        total = parts.sum(0)
        amount = -inverse @ total
        residual_parts = parts + np.einsum("bij,j->bi", grams, amount)
        cov = inverse @ (residual_parts.T @ residual_parts) @ inverse
        gain = float(total @ inverse @ total / (self.residual @ self.residual))
        return amount, np.sqrt(np.maximum(np.diag(cov), 0)), gain


def negligible_strengths(effect: type[Effect], number: int) -> np.ndarray:
    """``(k,)`` the largest negligible strengths of an effect; 0 if it declares no minimum size."""
    negligible = [
        thresholds.NEGLIGIBLE * (strength.min_effect_size or 0.0)
        for strength in effect.strengths.values()
    ]
    return np.array(negligible or [0.0] * number)[:number]


def _negligible(amount: np.ndarray, minimal: np.ndarray | float) -> np.ndarray:
    """The part of estimated strengths that is negligible, to be subtracted from them."""
    negligible: np.ndarray = np.sign(amount) * np.minimum(np.abs(amount), minimal)
    return negligible


def at_least(values: np.ndarray) -> np.ndarray:
    """``(F,)`` share of the values that are at least as large as each, up to rounding."""
    order = np.sort(values)
    below = np.searchsorted(order, values * (1 - 1e-12), side="left")
    return 1 - below / len(values)
