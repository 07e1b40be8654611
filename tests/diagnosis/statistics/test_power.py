"""With what probability an effect is named: against simulations of all that comes in a search."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.data.clusters import better, group_sums
from nnode.diagnosis import thresholds
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.statistics.combination import combined
from nnode.diagnosis.statistics.paired import gains, heldout, presence_pvalue, score_toward
from nnode.diagnosis.statistics.power import RUNS, PowerSimulation
from nnode.diagnosis.statistics.score import Score, Screen, Trace
from nnode.model.effects import Probe
from nnode.model.effects.lane import RelativeSpeed
from tests.builders import regression

OPEN, EACH, ALPHA, LEVEL = 30, 12, 0.05, thresholds.LEVEL

#: What one parameter of a model and the effect do to the residuals of all clusters.
RNG = np.random.default_rng(8)
LABEL = np.repeat(np.arange(OPEN), EACH)
ROWS = np.arange(OPEN * EACH).reshape(OPEN, EACH)
PARAMETER, EFFECT = RNG.normal(size=(2, OPEN * EACH))
KNOWN = RNG.uniform(0.5, 1.5, OPEN)[LABEL]


def drawn(rng: np.random.Generator, label: np.ndarray) -> np.ndarray:
    """Errors that depend on each other within a cluster."""
    size = rng.normal(size=int(label.max()) + 1)
    return np.asarray(rng.normal(size=len(label)) + 0.4 * size[label])


def scored(residual: np.ndarray, seed: int = 0) -> tuple[Fit, Screen, Score]:
    """The score of the effect in open clusters."""
    fit = regression((PARAMETER * KNOWN)[:, None], residual)
    screen = Screen(fit, LABEL, seed, flips=499)
    probe = Probe({}, {"kappa": 0.05})
    (score,) = screen.scores([Trace(RelativeSpeed, [probe], (EFFECT * KNOWN)[:, None])])
    return fit, screen, score


def is_named(rng: np.random.Generator, size: float, confirmation: int) -> bool:
    """One search on fresh clusters in which the effect has a size."""
    fit, _, score = scored(drawn(rng, LABEL) - size * EFFECT * KNOWN)
    columns = np.stack([PARAMETER, EFFECT], 1) * KNOWN[:, None]
    wider = regression(columns, fit.residual - fit.jacobian @ fit.row)
    nearer = heldout(fit, LABEL).sum() > heldout(wider, LABEL).sum()
    low, high = wider.intervals(LABEL)[1]
    if (
        score.p_value > thresholds.EACH
        or not nearer
        or presence_pvalue(fit, wider, LABEL) >= LEVEL
        or low <= 0 <= high
    ):
        return False
    # confirmation clusters are like the others
    picked = ROWS[rng.integers(0, OPEN, confirmation)].ravel()
    label = np.repeat(np.arange(confirmation), EACH)
    seen = drawn(rng, label) - size * columns[picked, 1]
    before = seen + columns[picked, 0] * fit.row[0]
    after = seen + columns[picked] @ wider.row
    likelier = gains(group_sums(before**2, label), group_sums(after**2, label)).mean() > 0
    p_value = better(score_toward(before, after, label))
    together = combined(score.p_value, p_value, OPEN, confirmation)
    return bool(likelier and p_value <= thresholds.EACH and together <= ALPHA)


@pytest.mark.thorough
@pytest.mark.parametrize(("size", "confirmation"), [(0.15, 5), (0.15, 16)])
def test_power_is_how_often_the_whole_search_names(size: float, confirmation: int) -> None:
    rng = np.random.default_rng(1)
    often = np.mean([is_named(rng, size, confirmation) for _ in range(RUNS)])
    # the power is judged from residuals in which nothing is hidden, of other data each time
    powers = []
    for seed in range(40):
        _, screen, score = scored(drawn(rng, LABEL), seed)
        way = PowerSimulation(screen, ALPHA, confirmation)
        powers.append(way.power(score, score.evidence[0], size, seed))
    error = np.sqrt(often * (1 - often) / RUNS + np.var(powers, ddof=1) / len(powers))
    assert 0.05 < often < 0.95
    assert abs(np.mean(powers) - often) < 3 * error


def test_one_confirmation_cluster_leaves_no_power() -> None:
    _, screen, score = scored(drawn(np.random.default_rng(2), LABEL))
    one, many = (PowerSimulation(screen, ALPHA, confirmation) for confirmation in (1, 2))
    assert one.power(score, score.evidence[0], 3.0) == 0.0
    assert one.detectable(score, score.evidence[0], 1.0) == np.inf
    assert many.power(score, score.evidence[0], 3.0) == 1.0


def test_the_detectable_size_is_found_with_the_power_that_is_asked_for() -> None:
    _, screen, score = scored(drawn(np.random.default_rng(3), LABEL))
    way = PowerSimulation(screen, ALPHA, 8)
    size = way.detectable(score, score.evidence[0], 0.3)
    assert way.power(score, score.evidence[0], size, seed=5) == pytest.approx(0.8, abs=0.08)
