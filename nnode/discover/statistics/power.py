"""With what probability an effect of some size would be named: the whole way is simulated.

The residuals of the clusters, without what the effect explains of them, change their signs at
random; the effect's trace is added in a given size; then comes what comes in a search: the score,
the held-out improvement, the interval, and the sealed clusters, which are drawn from the same ones.
All of it in the linear response: squared positions stand for whitened residuals, and two effects
that compete are not simulated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from nnode.data.clusters import every_sign
from nnode.discover.rules import rules
from nnode.discover.statistics.score import Evidence, Score, Screen

#: Simulations; an error of 2 % at a power of 80 %.
RUNS = 400
#: Sizes that are tried, relative to the one that is asked for.
SIZES = 2.0 ** np.linspace(-3, 3, 13)


@dataclass(frozen=True)
class PowerSimulation:
    """What an effect must pass.

    Attributes:
        screen: that its score comes from.
        alpha: level of the screen, over all effects.
        confirmation_clusters: number of confirmation clusters.
    """

    screen: Screen
    alpha: float
    confirmation_clusters: int

    def power(self, score: Score, one: Evidence, size: float, seed: int = 0) -> float:
        """Share of the simulations in which an effect of a size is found and confirmed."""
        grams, total = one.grams[:, None], float(one.grams.sum())
        number = len(grams)
        if not total > 0 or number < 2:
            return 0.0
        rng = np.random.default_rng(seed)
        rest = one.parts - one.grams * one.parts.sum() / total
        rest = rest * np.sqrt(number / (number - 1))
        parts = rng.choice([-1.0, 1.0], (number, RUNS)) * rest[:, None] - size * grams
        name = score.effect.name
        passed = self.screen.statistic(one, parts) > self.screen.critical(name, self.alpha)
        costs = _with_effect(self.screen.costs(name)[:, None], parts, grams, size)
        others = -(parts.sum(0) - parts) / np.maximum(total - grams, 1e-300)
        gain = _gain(others, parts, grams, costs)
        score_toward = _score_toward(others, parts, grams, costs)
        passed &= (gain.mean(0) > 0) & (
            _t(score_toward) > stats.t.ppf(1 - rules().level, number - 1)
        )
        amount = -parts.sum(0) / total
        error = np.sqrt((number - 1) / number * ((others - others.mean(0)) ** 2).sum(0))
        passed &= np.abs(amount) > stats.t.ppf(0.975, number - 1) * error
        costs = self.screen.costs(name)
        return float((passed & self._confirmed(rng, rest, one.grams, costs, size, amount)).mean())

    def _confirmed(
        self,
        rng: np.random.Generator,
        rest: np.ndarray,
        grams: np.ndarray,
        costs: np.ndarray,
        size: float,
        amount: np.ndarray,
    ) -> np.ndarray:
        """``(R,)`` whether sealed clusters lean towards the effect and are predicted better."""
        if rules().level * 2**self.confirmation_clusters < 1:
            return np.zeros(RUNS, dtype=bool)
        chosen = rng.integers(0, len(grams), (self.confirmation_clusters, RUNS))
        drawn = grams[chosen]
        parts = rng.choice([-1.0, 1.0], chosen.shape) * rest[chosen] - size * drawn
        costs = _with_effect(costs[chosen], parts, drawn, size)
        gain = _gain(amount, parts, drawn, costs)
        score_toward = _score_toward(amount, parts, drawn, costs)
        likelier: np.ndarray = gain.mean(0) > 0
        if self.confirmation_clusters > 12:
            return likelier & (
                _t(score_toward) > stats.t.ppf(1 - rules().level, self.confirmation_clusters - 1)
            )
        totals = every_sign(self.confirmation_clusters) @ score_toward
        passed: np.ndarray = (totals >= totals[0] - 1e-12).mean(0) <= rules().level
        return likelier & passed

    def detectable(self, score: Score, one: Evidence, expected: float) -> float:
        """The least size found with a probability of 80 %; infinite where none is."""
        sizes = expected * SIZES
        powers = np.array([self.power(score, one, size) for size in sizes])
        enough = np.flatnonzero(powers >= rules().power)
        if not len(enough):
            return float("inf")
        k = int(enough[0])
        if k == 0:
            return float(sizes[0])
        share = (rules().power - powers[k - 1]) / (powers[k] - powers[k - 1])
        return float(sizes[k - 1] * (sizes[k] / sizes[k - 1]) ** share)


def _with_effect(
    costs: np.ndarray, parts: np.ndarray, grams: np.ndarray, size: float
) -> np.ndarray:
    """Costs of clusters to whose residuals an effect of a size was added, with its scores."""
    found: np.ndarray = costs - 2 * size * parts - size**2 * grams
    return np.maximum(found, 0.0)


def _gain(
    amount: np.ndarray, parts: np.ndarray, grams: np.ndarray, costs: np.ndarray
) -> np.ndarray:
    """Improvement of each cluster's cost by an amount, relative to the greater cost."""
    gain = -(2 * amount * parts + amount**2 * grams)
    found: np.ndarray = gain / _larger(amount, parts, grams, costs)
    return found


def _score_toward(
    amount: np.ndarray, parts: np.ndarray, grams: np.ndarray, costs: np.ndarray
) -> np.ndarray:
    """How far each cluster leans towards an amount, relative to the greater cost."""
    found: np.ndarray = -2 * amount * parts / _larger(amount, parts, grams, costs)
    return found


def _larger(
    amount: np.ndarray, parts: np.ndarray, grams: np.ndarray, costs: np.ndarray
) -> np.ndarray:
    """The greater one of a cluster's costs before and after."""
    found: np.ndarray = np.maximum(costs, costs + 2 * amount * parts + amount**2 * grams)
    return np.maximum(found, 1e-300)


def _t(gain: np.ndarray) -> np.ndarray:
    """Student's statistic of the mean over the first axis."""
    # where an effect leaves a cluster no cost, its gain is beyond all numbers: nothing is passed
    with np.errstate(over="ignore", invalid="ignore"):
        error = gain.std(0, ddof=1) / np.sqrt(len(gain))
        found: np.ndarray = gain.mean(0) / np.maximum(error, 1e-300)
    return found
