"""The test whether residuals of simultaneous clusters are correlated."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from nnode.data.sequence import Sequence
from nnode.diagnosis.statistics import simultaneous as module
from nnode.diagnosis.statistics.simultaneous import Simultaneous, simultaneous

SECONDS, LATER, RATE = 40, 15, 2


def autoregression(rng: np.random.Generator, length: int, tau: float) -> np.ndarray:
    """Values with a correlation time of ``tau`` samples."""
    keep, values = np.exp(-1 / tau), [rng.normal()]
    for _ in range(length - 1):
        values.append(keep * values[-1] + np.sqrt(1 - keep**2) * rng.normal())
    return np.array(values)


def result_of(
    seed: int,
    *,
    clusters: int = 5,
    shock: float = 0.0,
    tau: float = 12.0,
    apart: float = 0.0,
    recordings: int = 1,
    kinds: int = 1,
) -> Simultaneous:
    """Clusters of two agents that start every 15 s and last 40 s.

    Args:
        shock: standard deviation of their common residuals at one time.
        tau: correlation time of residuals, in samples.
        apart: additional time between the starts, s.
        kinds: number of components; the sign of common residuals depends on it.
    """
    rng = np.random.default_rng(seed)
    common = autoregression(rng, RATE * (SECONDS + LATER * clusters), tau)
    clock, cluster, component, residual, sequences = [], [], [], [], []
    for c in range(clusters):
        first = RATE * LATER * c
        shared = shock * common[first : first + RATE * SECONDS]
        time = (first + np.arange(RATE * SECONDS)) / RATE + apart * c
        for kind in range(kinds):
            for _ in range(2):
                clock.append(time)
                own = autoregression(rng, len(time), tau)
                residual.append((-1) ** (kind * c) * shared + own)
                cluster.append(np.full(len(time), c))
                component.append(np.full(len(time), kind))
        x = np.zeros((len(time), 2, 1)) + np.arange(2)[:, None]
        name = f"r{c % recordings}"
        sequences.append(Sequence(name=f"{name}/{c}", recording=name, time=time, x=x))
    labels = np.concatenate(cluster)
    engine = SimpleNamespace(
        clock=np.concatenate(clock),
        cluster=labels,
        sequence=labels,
        component=np.concatenate(component),
        sequences=sequences,
    )
    fit = SimpleNamespace(residual=np.concatenate(residual))
    return simultaneous(cast(Any, engine), cast(Any, fit), seed)


@pytest.mark.thorough
def test_p_values_of_independent_clusters_are_uniform(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SHIFTS", 199)  # the level is exact with any number
    # ten clusters, because the mean course since the start is subtracted
    p_values = np.array([result_of(seed, clusters=10).p_value for seed in range(60)])
    assert stats.kstest(p_values, "uniform").pvalue > 0.05
    # 3 are expected; more than 7 have a probability of 1 %
    assert (p_values <= 0.05).sum() <= 7
    # permutations of single seconds would ignore the autocorrelation
    draw = np.random.default_rng(0)
    with monkeypatch.context() as context:
        context.setattr(np, "roll", lambda series, by, axis: draw.permutation(series, axis))
        wrong = np.array([result_of(seed, clusters=10).p_value for seed in range(40)])
    assert stats.kstest(wrong, "uniform").pvalue < 1e-3


@pytest.mark.thorough
def test_common_shock_is_detected() -> None:
    results = [result_of(seed, shock=1.0, clusters=10) for seed in range(8)]
    assert all(result.p_value <= 0.01 and result.together for result in results)
    # half of each agent's variance is common, two thirds of the variance of the mean of two agents
    assert np.mean([result.correlation for result in results]) == pytest.approx(2 / 3, abs=0.1)
    assert results[0].pairs == 9 + 8
    assert "treated as one cluster" in results[0].plain()
    assert f"p = {results[0].p_value:.3f}" in results[0].plain()
    assert "treated as independent" in result_of(0).plain()


def test_pairs_are_simultaneous_clusters_of_one_recording() -> None:
    for result in (result_of(0, apart=100.0), result_of(0, shock=1.0, recordings=5)):
        assert (result.pairs, result.p_value, result.together) == (0, 1.0, False)
        assert "overlap in time" in result.plain()
    # clusters of a recording start every 30 s and last 40 s
    assert result_of(0, recordings=2).pairs == 3


def test_components_are_compared_separately() -> None:
    assert result_of(0, shock=1.0, kinds=2, clusters=10).correlation < 0.2
    assert result_of(0, shock=1.0, kinds=1, clusters=10).correlation > 0.4
