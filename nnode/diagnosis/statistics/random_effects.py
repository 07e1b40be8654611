"""Random effects of agents, separated from transient deviations.

An agent's parameter is estimated in every part of its time. The autocovariance over these parts,
beyond that between different agents of a sequence, is modelled as a constant plus an exponential
decay. The constant is the variance between agents. The exponential is a transient deviation with a
time constant of at most a third of the longest lag; longer ones cannot be distinguished from a
constant difference between agents.

Source: MacKinnon, Nielsen & Webb 2023 (jackknife by cluster).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy import stats

from nnode.data.clusters import group_sums
from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import Fit, evaluated, grams
from nnode.diagnosis.statistics.variance_components import (
    LONGEST,
    Curve,
    period_estimates,
    ratio,
    shares,
)
from nnode.model.effects import IndividualEffect
from nnode.model.extend import effects_of, extended, without
from nnode.model.system import System

#: Number of relinearisations of the parameters, and the largest change in each.
RELINEARISATIONS, LARGEST_CHANGE = 3, 0.1


@dataclass
class IndividualEstimate:
    """An individual effect in the residuals of a calibrated model.

    Attributes:
        effect: its class.
        options: its settings.
        variance: between agents, per direction; the estimate may be negative.
        error: its standard error, by the jackknife over clusters.
        p_value: one-sided, Student's t by cluster, corrected for the number of settings.
        share: variance components as shares: ``recording`` (None if there is only one),
            ``sequence``, ``agent`` and ``transient``.
        lags: s; ``common``: the autocovariance at each lag.
        lasts: s, the longest time constant of a transient deviation that is separable from a
            constant difference.
        transient: variance of the transient deviation, and its time constant in s.
        shared: variance between sequences.
        settings: 95 % intervals of settings that were interpolated between neighbouring ones.
    """

    effect: type[IndividualEffect]
    options: dict[str, Any]
    variance: float
    error: float
    p_value: float
    share: dict[str, float | None]
    lags: list[float]
    common: list[float]
    lasts: float
    transient: tuple[float, float]
    shared: float
    settings: dict[str, tuple[float, float]] = field(default_factory=dict)
    left_out: np.ndarray = field(default_factory=lambda: np.empty(0))

    @property
    def sigma(self) -> float:
        """The effect's strength: the standard deviation between agents, per direction."""
        return float(np.sqrt(max(self.variance, 0.0)))

    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the strength."""
        half = float(stats.t.ppf(0.975, max(len(self.left_out) - 1, 1))) * self.error
        low, high = (float(np.sqrt(np.maximum(self.variance + s * half, 0.0))) for s in (-1, 1))
        return low, high

    def detectable(self, alpha: float, power: float = 0.8) -> float:
        """The smallest strength whose variance is significant with a power of 80 %."""
        quantiles = stats.t.ppf([1 - alpha, power], max(len(self.left_out) - 1, 1))
        return float(np.sqrt(self.error * quantiles.sum()))


def estimate_individual(
    engine: Engine, fit: Fit, effect: type[IndividualEffect]
) -> IndividualEstimate | None:
    """The best setting of an individual effect; None if no agent is observed long enough."""
    probes = effect.probes(engine.batch, fit.system)
    fits = [_at(engine, fit, effect, probe.options) for probe in probes]
    estimates = [estimate for estimate in fits if estimate is not None]
    best = max(estimates, key=lambda estimate: estimate.variance, default=None)
    if best is None:
        return None
    best.p_value = min(1.0, best.p_value * len(probes))
    if len(best.options) == 1 and len(estimates) > 2:
        _with_interval(estimates, best)
    return best


def agent_parameters(
    engine: Engine, system: System, estimate: IndividualEstimate, *, common: bool = False
) -> dict[str, list[float]]:
    """The agents' parameters by sequence name, from all data of the engine.

    They are empirical Bayes modes: shrunk according to the variance between agents and that of
    transient deviations, which are noise. They are relinearised, because the linear response is
    inaccurate for agents that differ much from the others.

    Args:
        engine: with fitted whitening.
        system: with the effect or without.
        estimate: provides the variances and settings.
        common: one parameter for all agents of a sequence.
    """
    system = with_agent_parameters(system, estimate, {})
    effect = next(t for t in system.terms if isinstance(t, estimate.effect))
    label = engine.sequence if common else engine.unit
    amounts: np.ndarray | None = None
    for _ in range(RELINEARISATIONS if len(engine.people[0]) > 1 else 1):
        fit = evaluated(engine, system)
        if not np.isfinite(fit.residual).all():
            break
        z = _directions(engine, fit, estimate.effect, estimate.options)
        if common and len(engine.people[0]) > 1:
            z = z.sum(1, keepdims=True)
        gram, score = grams(z, label), -group_sums(z * fit.residual[:, None], label)
        gram, score = _with_transient_variance(
            gram, score, _mean_transient_variance(engine, estimate)
        )
        ridge = np.eye(z.shape[1]) / max(estimate.shared if common else estimate.variance, 1e-12)
        start = np.zeros(score.shape) if amounts is None else amounts
        change = np.linalg.solve(gram + ridge, (score - start @ ridge)[..., None])[..., 0]
        amounts = (
            change if amounts is None else start + np.clip(change, -LARGEST_CHANGE, LARGEST_CHANGE)
        )
        effect.people = _people(engine, estimate, amounts, common)
    return effect.people


def _mean_transient_variance(engine: Engine, estimate: IndividualEstimate) -> float:
    """Variance of the transient deviation averaged over the duration of sequences."""
    height, tau = estimate.transient
    last = np.array([s.time[-1] - s.time[0] for s in engine.sequences]).mean()
    x = max(float(last) / max(tau, 1e-9), 1e-9)
    return height * 2 / x * (1 + np.expm1(-x) / x)


def _with_transient_variance(
    gram: np.ndarray, score: np.ndarray, transient: float
) -> tuple[np.ndarray, np.ndarray]:
    """Information and scores of parameters, with transient deviations as additional noise."""
    if transient <= 0:
        return gram, score
    number = gram.shape[1]
    size = np.trace(gram, axis1=1, axis2=2)[:, None, None] / number
    information = gram + (1e-9 * size + 1e-12) * np.eye(number)
    # (gram^-1 + transient)^-1 = (1 + gram transient)^-1 gram
    shrink = np.linalg.inv(np.eye(number) + transient * information)
    return shrink @ information, np.einsum("uij,uj->ui", shrink, score)


def with_agent_parameters(
    system: System, estimate: IndividualEstimate, people: dict[str, list[float]]
) -> System:
    """A copy of a model with an individual effect and its agents' parameters."""
    if any(isinstance(effect, estimate.effect) for effect in effects_of(system)):
        system = without(system, estimate.effect.name)
    options = dict(estimate.options)
    options.update(dict.fromkeys(estimate.effect.strengths, estimate.sigma))
    model, _ = extended(system, estimate.effect(**options, people=people))
    return model


# -- parts ---------------------------------------------------------------------------------------


def _at(
    engine: Engine, fit: Fit, effect: type[IndividualEffect], options: dict[str, Any]
) -> IndividualEstimate | None:
    estimates = period_estimates(engine, fit, _directions(engine, fit, effect, options))
    if len(estimates.agent) < 2:
        return None
    curve = Curve.of(estimates)
    if curve is None:
        return None
    constant, *transient = curve.fitted(curve.same, curve.between)
    count = curve.same.shape[1]
    left_out = np.array(
        [
            curve.fitted(np.delete(curve.same, c, 1), np.delete(curve.between, c, 1))[0]
            for c in range(count)
        ]
    )
    error = float(np.sqrt((count - 1) / count * ((left_out - left_out.mean()) ** 2).sum()))
    if count < 3:  # as for all jackknife intervals
        error = float("nan")
    p_value = float(stats.t.sf(constant / error, count - 1)) if error > 0 else 1.0
    return IndividualEstimate(
        effect=effect,
        options=options,
        variance=constant,
        error=error,
        p_value=p_value,
        share=shares(estimates, curve, constant, transient[0]),
        lags=curve.lags.tolist(),
        common=(ratio(curve.same) - ratio(curve.between)).tolist(),
        lasts=float(LONGEST * curve.lags[-1]),
        transient=(transient[0], transient[1]),
        shared=max(curve.plateau(ratio(curve.between), curve.between[1].sum(0))[0], 0.0),
        left_out=left_out,
    )


def _directions(
    engine: Engine, fit: Fit, effect: type[IndividualEffect], options: dict[str, Any]
) -> np.ndarray:
    """``(n, M)`` derivatives of the residuals with respect to the parameters of every unit."""
    row = torch.from_numpy(fit.row)
    directions: np.ndarray = engine.individual(fit.system, row, effect, options).numpy().T
    return directions


def _with_interval(estimates: list[IndividualEstimate], best: IndividualEstimate) -> None:
    """Interpolate the setting with the largest variance by a parabola through its neighbours, with
    a jackknife interval."""
    (name,) = best.options
    estimates = sorted(estimates, key=lambda estimate: float(estimate.options[name]))
    place = estimates.index(best)
    if not 0 < place < len(estimates) - 1:
        return
    neighbours = estimates[place - 1 : place + 2]
    if len({len(estimate.left_out) for estimate in neighbours}) > 1:
        return
    settings = np.array([estimate.options[name] for estimate in neighbours])
    value = float(_vertex(settings, np.array([[estimate.variance for estimate in neighbours]]))[0])
    tops = _vertex(settings, np.stack([estimate.left_out for estimate in neighbours], 1))
    count = len(tops)
    error = float(np.sqrt((count - 1) / count * ((tops - tops.mean()) ** 2).sum()))
    half = float(stats.t.ppf(0.975, max(count - 1, 1))) * error
    best.options = {name: value}
    best.settings = {name: (value - half, value + half)}


def _vertex(at: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """``(S,)`` maxima of parabolas through ``(S, 3)`` gains at three places, clipped to them."""
    left = (gain[:, 1] - gain[:, 0]) / (at[1] - at[0])
    right = (gain[:, 2] - gain[:, 1]) / (at[2] - at[1])
    bend = np.minimum((right - left) / (at[2] - at[0]), -1e-300)
    vertex: np.ndarray = (at[0] + at[1]) / 2 - left / (2 * bend)
    return np.clip(vertex, at[0], at[2])


def _people(
    engine: Engine, estimate: IndividualEstimate, amounts: np.ndarray, common: bool
) -> dict[str, list[float]]:
    names, size = [s.name for s in engine.sequences], engine.batch.agent.shape[1]
    people_numbers = {name: [0.0] * size for name in names}
    for unit, people in enumerate(engine.people):
        for m, (b, n) in enumerate(people):
            amount = amounts[b] if common else amounts[unit]
            shared = common or len(people) == 1
            number = amount if shared else amount[m : m + 1]
            people_numbers[names[b]][n] = estimate.effect.person(number, estimate.options)
    return people_numbers
