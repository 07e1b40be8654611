"""Power of the whole decision procedure for an effect of a given size, by simulation.

The signs of the clusters' residual scores are flipped at random, and the effect's trace is added in
a given size. Then all tests of the procedure are applied: the score test, the held-out improvement,
the interval, and the confirmation clusters, which are resampled from the same clusters. Everything
is linearised; competing effects are not simulated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from nnode.data.clusters import every_sign
from nnode.diagnosis import thresholds
from nnode.diagnosis.statistics.combination import combined, least_confirmation
from nnode.diagnosis.statistics.score import Evidence, Score, Screen

#: Number of simulations; the standard error is 2 % at a power of 80 %.
RUNS = 400
#: Sizes, relative to the expected one.
SIZES = 2.0 ** np.linspace(-3, 3, 13)


@dataclass(frozen=True)
class PowerSimulation:
    """Simulates the tests that an effect must pass.

    Attributes:
        screen: of the score tests.
        alpha: level of exploration and confirmation clusters together.
        confirmation_clusters: number of confirmation clusters.
    """

    screen: Screen
    alpha: float
    confirmation_clusters: int

    def power(self, score: Score, evidence: Evidence, size: float, seed: int = 0) -> float:
        """Share of the simulations in which an effect of a size is selected and confirmed."""
        grams, information = evidence.grams[:, None], float(evidence.grams.sum())
        number = len(grams)
        if not information > 0 or number < 2:
            return 0.0
        rng = np.random.default_rng(seed)
        null_parts = evidence.parts - evidence.grams * evidence.parts.sum() / information
        null_parts = null_parts * np.sqrt(number / (number - 1))
        parts = rng.choice([-1.0, 1.0], (number, RUNS)) * null_parts[:, None] - size * grams
        name = score.effect.name
        exploration = self.screen.p_values(name, self.screen.statistic(evidence, parts))
        passed = exploration <= thresholds.EACH
        costs = _with_effect(self.screen.costs(name)[:, None], parts, grams, size)
        left_out_amounts = -(parts.sum(0) - parts) / np.maximum(information - grams, 1e-300)
        gain = _gain(left_out_amounts, parts, grams, costs)
        score_toward = _score_toward(left_out_amounts, parts, grams, costs)
        passed &= (gain.mean(0) > 0) & (
            _t(score_toward) > stats.t.ppf(1 - thresholds.LEVEL, number - 1)
        )
        amount = -parts.sum(0) / information
        error = np.sqrt(
            (number - 1) / number * ((left_out_amounts - left_out_amounts.mean(0)) ** 2).sum(0)
        )
        passed &= np.abs(amount) > stats.t.ppf(0.975, number - 1) * error
        costs = self.screen.costs(name)
        confirmation = self._confirmation(rng, null_parts, evidence.grams, costs, size, amount)
        passed &= confirmation <= thresholds.EACH
        p_value = combined(exploration, confirmation, number, self.confirmation_clusters)
        return float((passed & (p_value <= self.alpha)).mean())

    def _confirmation(
        self,
        rng: np.random.Generator,
        null_parts: np.ndarray,
        grams: np.ndarray,
        costs: np.ndarray,
        size: float,
        amount: np.ndarray,
    ) -> np.ndarray:
        """``(R,)`` p-values of the confirmation clusters; 1 where they are not predicted better."""
        if self.confirmation_clusters < least_confirmation():
            return np.ones(RUNS)
        chosen = rng.integers(0, len(grams), (self.confirmation_clusters, RUNS))
        drawn = grams[chosen]
        parts = rng.choice([-1.0, 1.0], chosen.shape) * null_parts[chosen] - size * drawn
        costs = _with_effect(costs[chosen], parts, drawn, size)
        gain = _gain(amount, parts, drawn, costs)
        score_toward = _score_toward(amount, parts, drawn, costs)
        if self.confirmation_clusters > 12:
            p_values = stats.t.sf(_t(score_toward), self.confirmation_clusters - 1)
        else:
            totals = every_sign(self.confirmation_clusters) @ score_toward
            p_values = (totals >= totals[0] - 1e-12).mean(0)
        return np.where(gain.mean(0) > 0, p_values, 1.0)

    def detectable(self, score: Score, evidence: Evidence, expected: float) -> float:
        """The smallest size with a power of 80 %; infinite if there is none."""
        sizes = expected * SIZES
        powers = np.array([self.power(score, evidence, size) for size in sizes])
        sufficient = np.flatnonzero(powers >= thresholds.POWER)
        if not len(sufficient):
            return float("inf")
        k = int(sufficient[0])
        if k == 0:
            return float(sizes[0])
        share = (thresholds.POWER - powers[k - 1]) / (powers[k] - powers[k - 1])
        return float(sizes[k - 1] * (sizes[k] / sizes[k - 1]) ** share)


def _with_effect(
    costs: np.ndarray, parts: np.ndarray, grams: np.ndarray, size: float
) -> np.ndarray:
    """Costs of clusters after an effect of a size was added to their residuals."""
    new_costs: np.ndarray = costs - 2 * size * parts - size**2 * grams
    return np.maximum(new_costs, 0.0)


def _gain(
    amount: np.ndarray, parts: np.ndarray, grams: np.ndarray, costs: np.ndarray
) -> np.ndarray:
    """Improvement of each cluster's cost by an amount, relative to the larger cost."""
    gain = -(2 * amount * parts + amount**2 * grams)
    relative: np.ndarray = gain / _larger(amount, parts, grams, costs)
    return relative


def _score_toward(
    amount: np.ndarray, parts: np.ndarray, grams: np.ndarray, costs: np.ndarray
) -> np.ndarray:
    """The clusters' scores toward an amount, relative to the larger cost."""
    relative: np.ndarray = -2 * amount * parts / _larger(amount, parts, grams, costs)
    return relative


def _larger(
    amount: np.ndarray, parts: np.ndarray, grams: np.ndarray, costs: np.ndarray
) -> np.ndarray:
    """The larger one of a cluster's costs before and after."""
    larger: np.ndarray = np.maximum(costs, costs + 2 * amount * parts + amount**2 * grams)
    return np.maximum(larger, 1e-300)


def _t(gain: np.ndarray) -> np.ndarray:
    """Student's statistic of the mean over the first axis."""
    # if an effect reduces a cluster's cost to 0, its gain overflows, and the test is not passed
    with np.errstate(over="ignore", invalid="ignore"):
        error = gain.std(0, ddof=1) / np.sqrt(len(gain))
        statistic: np.ndarray = gain.mean(0) / np.maximum(error, 1e-300)
    return statistic
