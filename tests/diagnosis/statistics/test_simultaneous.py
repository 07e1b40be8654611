"""Agents who are there at one time: alike by chance, or by something that acts on them all."""

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


def lasting(rng: np.random.Generator, length: int, tau: float) -> np.ndarray:
    """An autoregression, whose correlation lasts for ``tau`` samples."""
    keep, found = np.exp(-1 / tau), [rng.normal()]
    for _ in range(length - 1):
        found.append(keep * found[-1] + np.sqrt(1 - keep**2) * rng.normal())
    return np.array(found)


def judged(
    seed: int,
    *,
    clusters: int = 5,
    shock: float = 0.0,
    tau: float = 12.0,
    apart: float = 0.0,
    recordings: int = 1,
    kinds: int = 1,
) -> Simultaneous:
    """Clusters of two agents that begin 15 s after each other and last for 40 s, whose residuals
    last for 6 s; ``shock`` is the size of what they have in common at one time."""
    rng = np.random.default_rng(seed)
    whole = lasting(rng, RATE * (SECONDS + LATER * clusters), tau)
    clock, cluster, component, residual, sequences = [], [], [], [], []
    for c in range(clusters):
        first = RATE * LATER * c
        own = shock * whole[first : first + RATE * SECONDS]
        time = (first + np.arange(RATE * SECONDS)) / RATE + apart * c
        for kind in range(kinds):
            for _ in range(2):
                clock.append(time)
                # what is common changes its sign with the component
                residual.append((-1) ** (kind * c) * own + lasting(rng, len(own), tau))
                cluster.append(np.full(len(own), c))
                component.append(np.full(len(own), kind))
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
def test_independent_agents_give_every_p_value_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SHIFTS", 199)  # the level is exact with any number
    # of more than a few clusters, as what all have in common since their start is taken out
    found = np.array([judged(seed, clusters=10).p_value for seed in range(60)])
    assert stats.kstest(found, "uniform").pvalue > 0.05
    # 3 expected; above 7 would be a chance of 1 %
    assert (found <= 0.05).sum() <= 7
    # single seconds may not be exchanged: what lasts for 6 s would be taken for something common
    draw = np.random.default_rng(0)
    with monkeypatch.context() as context:
        context.setattr(np, "roll", lambda one, by, axis: draw.permutation(one, axis))
        wrong = np.array([judged(seed, clusters=10).p_value for seed in range(40)])
    assert stats.kstest(wrong, "uniform").pvalue < 1e-3


@pytest.mark.thorough
def test_a_shock_in_common_is_seen() -> None:
    found = [judged(seed, shock=1.0, clusters=10) for seed in range(8)]
    assert all(one.p_value <= 0.01 and one.together for one in found)
    # half of each agent's variance is common, and of the mean of two agents two thirds
    assert np.mean([one.correlation for one in found]) == pytest.approx(2 / 3, abs=0.1)
    assert found[0].pairs == 9 + 8
    assert "treated as one cluster" in found[0].plain()
    assert f"p = {found[0].p_value:.3f}" in found[0].plain()
    assert "treated as independent" in judged(0).plain()


def test_only_clusters_of_a_recording_that_meet_are_compared() -> None:
    for alone in (judged(0, apart=100.0), judged(0, shock=1.0, recordings=5)):
        assert (alone.pairs, alone.p_value, alone.together) == (0, 1.0, False)
        assert "overlap in time" in alone.plain()
    # every second of five begins 30 s after the one before it, and they last for 40 s
    assert judged(0, recordings=2).pairs == 3


def test_what_means_different_things_is_not_added_up() -> None:
    # what pushes to one side here pushes to the other there
    assert judged(0, shock=1.0, kinds=2, clusters=10).correlation < 0.2
    assert judged(0, shock=1.0, kinds=1, clusters=10).correlation > 0.4
