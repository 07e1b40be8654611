"""Effects that differ from agent to agent: a variance, and one number for everybody.

Each agent's number is fitted to one half of his time and tried on the other. Where agents do
not differ the two halves have nothing to do with each other.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from scipy import stats

from nnode.discover.engine import Engine
from nnode.discover.fit import Fit, evaluated, sums
from nnode.models.effects import IndividualEffect
from nnode.models.system import System

#: Standard deviations, relative to the one that the halves have in common, that are tried.
SPREADS = (0.25, 0.5, 0.7, 1.0, 1.4, 2.0, 4.0)
#: Rounds in which numbers are linearised again, and the largest change in one.
SHARPER, LEAP = 3, 0.1
#: Rounds in which the weights of units are found.
ROUNDS = 3
#: Rounds in which a setting is looked for more closely, and by how much each time.
CLOSER, CLOSER_BY = 2, 0.4


@dataclass
class Individuals:
    """An individual effect in the residuals of a calibrated model.

    Attributes:
        effect: its class.
        options: its settings.
        products: per agent the product of the standardised scores of the two halves.
        sigma: standard deviation of the agents' numbers.
        interval: of 95 %, by leaving out each sequence in turn.
        gain: share of the residuals' sum of squares that numbers from the one half remove in
            the other.
        losses: ``(S,)`` sum of squares that is left so.
        people: sequence name to its agents' numbers, from all their time.
        halves: the same from each half of their time.
        amounts: ``(U, M)`` from all their time and from each half.
        spread: standard deviation with which amounts are drawn to zero.
        settings: intervals of 95 % of settings that were chosen among neighbouring ones.
    """

    effect: type[IndividualEffect]
    options: dict[str, Any]
    products: np.ndarray
    sigma: float
    interval: tuple[float, float]
    gain: float
    losses: np.ndarray
    people: dict[str, list[float]]
    halves: tuple[dict[str, list[float]], dict[str, list[float]]]
    amounts: list[np.ndarray]
    spread: float
    settings: dict[str, tuple[float, float]] = field(default_factory=dict)


def individuals(
    engine: Engine,
    fit: Fit,
    effect: type[IndividualEffect],
    options: dict[str, Any] | None = None,
) -> Individuals | None:
    """The best setting of an individual effect; None where it cannot act on these data.

    Args:
        options: its settings, where they are known.
    """
    if options is not None:
        return _at(engine, fit, effect, options)
    found = [
        _at(engine, fit, effect, probe.options) for probe in effect.probes(engine.batch, fit.system)
    ]
    best = max(found, key=lambda one: one.gain, default=None)
    if best is None or len(best.options) != 1 or len(found) < 3:
        return best
    return _between(engine, fit, found, best)


def _between(engine: Engine, fit: Fit, found: list[Individuals], best: Individuals) -> Individuals:
    """The best value of the one setting, which the neighbouring ones only surround."""
    (name,) = best.options
    width = 0.0
    for _ in range(CLOSER):
        found = sorted(found, key=lambda one: float(one.options[name]))
        place = found.index(best)
        if not 0 < place < len(found) - 1:
            return best
        near = found[place - 1 : place + 2]
        at = np.array([one.options[name] for one in near])
        top = float(_vertex(at, np.array([[one.gain for one in near]]))[0])
        width = CLOSER_BY * float(at[2] - at[0]) / 2
        found = [_at(engine, fit, best.effect, {name: top + s * width}) for s in (-1, 0, 1)]
        best = max(found, key=lambda one: one.gain)
    at = np.array([one.options[name] for one in found])
    losses = np.stack([one.losses for one in found], 1)
    # by leaving out one sequence at a time
    tops = _vertex(at, losses - losses.sum(0))
    count = len(losses)
    error = float(np.sqrt((count - 1) / count * ((tops - tops.mean()) ** 2).sum()))
    half = float(stats.t.ppf(0.975, max(count - 1, 1))) * error
    value = float(best.options[name])
    return replace(best, settings={name: (value - half, value + half)})


def _vertex(at: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """``(S,)`` where parabolas through ``(S, 3)`` gains at three places are highest; within
    them."""
    left = (gain[:, 1] - gain[:, 0]) / (at[1] - at[0])
    right = (gain[:, 2] - gain[:, 1]) / (at[2] - at[1])
    bend = np.minimum((right - left) / (at[2] - at[0]), -1e-300)
    top: np.ndarray = (at[0] + at[1]) / 2 - left / (2 * bend)
    return np.clip(top, at[0], at[2])


def _at(
    engine: Engine,
    fit: Fit,
    effect: type[IndividualEffect],
    options: dict[str, Any],
) -> Individuals:
    row = torch.from_numpy(fit.row)
    z = engine.individual(fit.system, row, effect, options).numpy().T
    known = _evidence(z, fit.residual, engine)
    _, (early_gram, early_score), (late_gram, late_score) = known
    sequence_of = np.array([people[0][0] for people in engine.people])
    each = np.einsum("um,um->u", early_score, late_score)
    scale = np.einsum("umn,unm->u", early_gram, late_gram)
    _, early, late = _evidence(_contrasts(z, engine), fit.residual, engine)
    products = _products(engine, early, late)
    count = int(engine.sequence.max()) + 1
    weight = _weights(each, scale, z.shape[1])
    each = np.bincount(sequence_of, weight * each, count)
    scale = np.bincount(sequence_of, weight * scale, count)
    variance = each.sum() / max(scale.sum(), 1e-300)
    # by leaving out one sequence at a time
    others = (each.sum() - each) / np.maximum(scale.sum() - scale, 1e-300)
    error = float(np.sqrt((count - 1) / count * ((others - others.mean()) ** 2).sum()))
    sigma = float(np.sqrt(max(variance, 0.0)))
    low, high = (float(np.sqrt(max(variance + s * 2.1 * error, 0.0))) for s in (-1, 1))
    losses, best = _crossed(z, fit.residual, known, engine, max(sigma, 1e-6))
    amounts = [_amounts(gram, score, best) for gram, score in known]
    full, *halves = (_people(engine, effect, options, each) for each in amounts)
    return Individuals(
        effect=effect,
        options=options,
        products=products,
        sigma=effect.spread(sigma),
        interval=(effect.spread(low), effect.spread(high)),
        gain=1 - float(losses.sum()) / fit.cost,
        losses=losses,
        people=full,
        halves=(halves[0], halves[1]),
        amounts=amounts,
        spread=best,
    )


def sharpened(engine: Engine, system: System, one: Individuals) -> Individuals:
    """The numbers once more, linearised around the motion that they lead to.

    Who is much slower than the others is not where a linear response expects him. Crowds, whose
    windows are short, keep the numbers that they have.

    Args:
        system: a model with the effect.
    """
    if len(engine.people[0]) == 1:
        return one
    system = copy.deepcopy(system)
    own = next(t for t in system.terms if isinstance(t, one.effect))
    found = []
    for part, amounts in enumerate(one.amounts):
        for _ in range(SHARPER):
            own.people = _people(engine, one.effect, one.options, amounts)
            fit = evaluated(engine, system)
            if not np.isfinite(fit.residual).all():
                break
            z = engine.individual(
                fit.system, torch.from_numpy(fit.row), one.effect, one.options
            ).numpy().T  # fmt: skip
            gram, score = _evidence(z, fit.residual, engine)[part]
            ridge = np.eye(z.shape[1]) / one.spread**2
            change = np.linalg.solve(gram + ridge, (score - amounts / one.spread**2)[..., None])
            change = change[..., 0]
            amounts = amounts + np.clip(change, -LEAP, LEAP)
        found.append(amounts)
    full, *halves = (_people(engine, one.effect, one.options, each) for each in found)
    # what the linear response over- or underestimates, it does with the spread as well
    factor = float(found[0].std() / max(one.amounts[0].std(), 1e-300))
    return replace(
        one,
        people=full,
        halves=(halves[0], halves[1]),
        amounts=found,
        sigma=factor * one.sigma,
        interval=(factor * one.interval[0], factor * one.interval[1]),
    )


def _weights(each: np.ndarray, scale: np.ndarray, number: int) -> np.ndarray:
    """``(U,)`` weights with which the variance of the agents' numbers is known best.

    A unit's product of scores varies by chance, and because its agents differ by chance; who is
    known very well counts no more than the others.
    """
    weight = np.ones(len(each))
    for _ in range(ROUNDS):
        variance = max(float((weight * each).sum() / max((weight * scale).sum(), 1e-300)), 0.0)
        weight = 1 / (1 + variance * np.sqrt(scale / number)) ** 2
    return weight


#: Gram matrices ``(U, M, M)`` and scores ``(U, M)``.
_Evidence = tuple[np.ndarray, np.ndarray]


def _evidence(z: np.ndarray, residual: np.ndarray, engine: Engine) -> list[_Evidence]:
    """Of both halves together, of the early and of the late one."""
    halves = []
    units = int(engine.unit.max()) + 1
    for half in (0, 1):
        own = engine.half == half
        part, label = z[own], engine.unit[own]
        matrix = np.zeros((units, z.shape[1], z.shape[1]))
        np.add.at(matrix, label, part[:, :, None] * part[:, None, :])
        vector = np.zeros((units, z.shape[1]))
        np.add.at(vector, label, -part * residual[own][:, None])
        halves.append((matrix, vector))
    (early_gram, early_score), (late_gram, late_score) = halves
    return [(early_gram + late_gram, early_score + late_score), *halves]


def _contrasts(z: np.ndarray, engine: Engine) -> np.ndarray:
    """The directions without what all agents of a unit do in common in a half: that may be the
    hour or the place, and speaks for no difference between them."""
    if len(engine.people[0]) == 1:
        return z
    common = z.sum(1, keepdims=True)
    label = 3 * engine.unit + engine.half + 1
    along, size = sums(common * z, label), sums(common**2, label)
    found: np.ndarray = z - common * (along / np.maximum(size, 1e-300))[label]
    return found


def _products(engine: Engine, early: _Evidence, late: _Evidence) -> np.ndarray:
    """Per agent the product of the two halves' scores, each in units of its standard error.

    What those at one place of their units have in common is no difference between people.
    """
    score = [early[1], late[1]]
    size = [np.sqrt(np.maximum(np.einsum("umm->um", g), 1e-300)) for g in (early[0], late[0])]
    if len(engine.people[0]) == 1:
        return ((score[0] / size[0]) * (score[1] / size[1])).sum(1)
    known = (size[0] > 1e-140) & (size[1] > 1e-140)
    number = np.maximum(known.sum(0), 1)
    parts = []
    for one, width in zip(score, size, strict=True):
        part = np.where(known, one / width, 0.0)
        parts.append(part - part.sum(0) / number)
    return (parts[0] * parts[1])[known]


def _amounts(gram: np.ndarray, score: np.ndarray, sigma: float) -> np.ndarray:
    """``(U, M)`` amounts, drawn to zero as their standard deviation says."""
    ridge = np.eye(gram.shape[1]) / sigma**2
    found: np.ndarray = np.linalg.solve(gram + ridge, score[..., None])[..., 0]
    return found


def _crossed(
    z: np.ndarray, residual: np.ndarray, known: list[_Evidence], engine: Engine, sigma: float
) -> tuple[np.ndarray, float]:
    """``(S,)`` sums of squares of each half under the other's amounts, and the best sigma."""
    best, chosen = None, sigma
    both, early, late = known
    for spread in SPREADS:
        left = residual.copy()
        # what lies in neither half is predicted by both
        for half, (gram, score) in ((0, late), (1, early), (-1, both)):
            amounts = _amounts(gram, score, spread * sigma)
            own = engine.half == half
            left[own] += np.einsum("nm,nm->n", z[own], amounts[engine.unit[own]])
        losses = sums(left**2, engine.sequence)
        if best is None or losses.sum() < best.sum():
            best, chosen = losses, spread * sigma
    assert best is not None
    return best, chosen


def _people(
    engine: Engine, effect: type[IndividualEffect], options: dict[str, Any], amounts: np.ndarray
) -> dict[str, list[float]]:
    names, sizes = engine.names, engine.batch.agent.shape[1]
    found = {name: [0.0] * sizes for name in names}
    for people, own in zip(engine.people, amounts, strict=True):
        if len(people) == 1:
            (b, n) = people[0]
            found[names[b]][n] = effect.person(own, options)
        else:
            for (b, n), number in zip(people, own, strict=True):
                found[names[b]][n] = effect.person(np.array([number]), options)
    return found
