"""The probability that a search names an effect, against simulations of the whole search."""

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

CLUSTERS, SIZE, ALPHA, LEVEL = 30, 12, 0.05, thresholds.LEVEL

#: Derivatives of the residuals by a parameter of the model and by the effect.
RNG = np.random.default_rng(8)
LABEL = np.repeat(np.arange(CLUSTERS), SIZE)
ROWS = np.arange(CLUSTERS * SIZE).reshape(CLUSTERS, SIZE)
PARAMETER, EFFECT = RNG.normal(size=(2, CLUSTERS * SIZE))
SCALE = RNG.uniform(0.5, 1.5, CLUSTERS)[LABEL]


def errors(rng: np.random.Generator, label: np.ndarray) -> np.ndarray:
    """Errors that are correlated within a cluster."""
    shared = rng.normal(size=int(label.max()) + 1)
    return np.asarray(rng.normal(size=len(label)) + 0.4 * shared[label])


def scored(residual: np.ndarray, seed: int = 0) -> tuple[Fit, Screen, Score]:
    """The score of the effect in exploration clusters."""
    fit = regression((PARAMETER * SCALE)[:, None], residual)
    screen = Screen(fit, LABEL, seed, flips=499)
    probe = Probe({}, {"kappa": 0.05})
    (score,) = screen.scores([Trace(RelativeSpeed, [probe], (EFFECT * SCALE)[:, None])])
    return fit, screen, score


def is_named(rng: np.random.Generator, size: float, confirmation: int) -> bool:
    """Whether a search of new data with an effect of this size names it."""
    fit, _, score = scored(errors(rng, LABEL) - size * EFFECT * SCALE)
    columns = np.stack([PARAMETER, EFFECT], 1) * SCALE[:, None]
    wider = regression(columns, fit.residual - fit.jacobian @ fit.row)
    predicts_better = heldout(fit, LABEL).sum() > heldout(wider, LABEL).sum()
    low, high = wider.intervals(LABEL)[1]
    if (
        score.p_value > thresholds.EACH
        or not predicts_better
        or presence_pvalue(fit, wider, LABEL) >= LEVEL
        or low <= 0 <= high
    ):
        return False
    # confirmation clusters have the derivatives of exploration clusters
    picked = ROWS[rng.integers(0, CLUSTERS, confirmation)].ravel()
    label = np.repeat(np.arange(confirmation), SIZE)
    residual = errors(rng, label) - size * columns[picked, 1]
    before = residual + columns[picked, 0] * fit.row[0]
    after = residual + columns[picked] @ wider.row
    gained = gains(group_sums(before**2, label), group_sums(after**2, label)).mean() > 0
    p_value = better(score_toward(before, after, label))
    combined_p = combined(score.p_value, p_value, CLUSTERS, confirmation)
    return bool(gained and p_value <= thresholds.EACH and combined_p <= ALPHA)


@pytest.mark.thorough
@pytest.mark.parametrize(("size", "confirmation"), [(0.15, 5), (0.15, 16)])
def test_power_is_frequency_of_naming(size: float, confirmation: int) -> None:
    rng = np.random.default_rng(1)
    frequency = np.mean([is_named(rng, size, confirmation) for _ in range(RUNS)])
    # the power is computed from residuals without the effect, of other data each time
    powers = []
    for seed in range(40):
        _, screen, score = scored(errors(rng, LABEL), seed)
        simulation = PowerSimulation(screen, ALPHA, confirmation)
        powers.append(simulation.power(score, score.evidence[0], size, seed))
    error = np.sqrt(frequency * (1 - frequency) / RUNS + np.var(powers, ddof=1) / len(powers))
    assert 0.05 < frequency < 0.95
    assert abs(np.mean(powers) - frequency) < 3 * error


def test_one_confirmation_cluster_has_no_power() -> None:
    _, screen, score = scored(errors(np.random.default_rng(2), LABEL))
    one, two = (PowerSimulation(screen, ALPHA, confirmation) for confirmation in (1, 2))
    assert one.power(score, score.evidence[0], 3.0) == 0.0
    assert one.detectable(score, score.evidence[0], 1.0) == np.inf
    assert two.power(score, score.evidence[0], 3.0) == 1.0


def test_detectable_size_has_required_power() -> None:
    _, screen, score = scored(errors(np.random.default_rng(3), LABEL))
    simulation = PowerSimulation(screen, ALPHA, 8)
    size = simulation.detectable(score, score.evidence[0], 0.3)
    assert simulation.power(score, score.evidence[0], size, seed=5) == pytest.approx(0.8, abs=0.08)
