"""Folds, pairs of platoons, and calibrations of pairs with a known law."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from nnode.calibrate.cost import Convention
from nnode.calibrate.problem import ResidualProblem
from nnode.data.clusters import folds
from nnode.data.sequence import Sequence, collate
from nnode.model.laws import CAR_FOLLOWING_LAWS, law_from
from nnode.simulation.fused import FusedSolver
from studies.following import data, printed, tasks
from studies.following.tasks import EVERY, decay, key, published_law, starts
from tests.builders import lane

HELLY = {"c_s": 0.15, "c_v": 0.7, "T": 1.4, "s0": 3.0}


def helly_pairs(number: int = 6, time_gaps: np.ndarray | None = None) -> list[Sequence]:
    """Followers by Helly's law, simulated in a plain loop behind oscillating leaders."""
    result = []
    time = 0.1 * np.arange(301)
    for i in range(number):
        lead_v = 10 + 2 * np.sin(0.3 * time + i) + np.cos(0.11 * time * (1 + i / 5))
        lead = np.concatenate([[0.0], np.cumsum((lead_v[1:] + lead_v[:-1]) / 2 * 0.1)])
        gap_time = HELLY["T"] if time_gaps is None else time_gaps[i]
        x, v = np.empty(301), np.empty(301)
        x[0], v[0] = -25.0 - i, 9.0
        for k in range(300):
            gap = lead[k] - x[k] - 4.0
            a = HELLY["c_s"] * (gap - HELLY["s0"] - gap_time * v[k])
            a -= HELLY["c_v"] * (v[k] - lead_v[k])
            v[k + 1] = v[k] + 0.1 * a
            x[k + 1] = x[k] + 0.1 * (v[k] + v[k + 1]) / 2
        length, agents = np.array([np.nan, 4.0]), (f"f{i}", f"l{i // 2}")
        extra = {"length": length, "agents": agents, "split": "train"}
        x, v = np.stack([x, lead], -1), np.stack([v, lead_v], -1)
        result.append(lane(x, 0.1, v=v, name=f"r/{i}", **extra))
    return result


@pytest.fixture
def study_pairs(monkeypatch: pytest.MonkeyPatch) -> list[Sequence]:
    """The pairs by Helly's law as the data of the study."""
    pairs = helly_pairs()
    monkeypatch.setattr(data, "pairs", lambda folder, test=False: tuple(pairs))
    monkeypatch.setattr(data, "batch", lambda folder, test=False: collate(pairs))
    return pairs


def test_integration_methods_of_candidates() -> None:
    steps = {name: candidate.system().step for name, candidate in EVERY.items()}
    maps = {name for name in steps if name.split(" ")[0] in ("krauss", "newell")}
    assert {steps[name] for name in maps} == {"semi_implicit"}
    assert {steps[name] for name in steps.keys() - maps} == {"ballistic"}
    for law in printed.clipped:
        values = dict.fromkeys(CAR_FOLLOWING_LAWS[law]["parameters"], 1.0)
        assert law_from(law, published_law(law, values)).step == "ballistic"


def test_clusters_stay_in_one_fold() -> None:
    label = data.labels(helly_pairs())
    assert label.tolist() == [0, 0, 1, 1, 2, 2]
    fold = folds(label, 2, seed=3)
    assert fold[::2].tolist() == fold[1::2].tolist()
    assert set(fold) == {0, 1}


def test_pairs_of_a_platoon() -> None:
    x = np.array([0.0, 20, 50, 90])[None, :] + 10 * 0.1 * np.arange(50)[:, None]
    pairs = data.behind(lane(x, 0.1, name="p", agents=tuple("dcba")))
    assert [pair.agents for pair in pairs] == [("b", "a"), ("c", "b"), ("d", "c")]
    last = pairs[0].part(0.7, 1.0)
    assert (last.n_samples, last.time[0]) == (15, pytest.approx(3.5))
    assert np.diff(last.x[0, :, 0]) == pytest.approx(40)


def test_cross_validation_recovers_the_law(study_pairs: list[Sequence]) -> None:
    result = tasks.cross_validate("", "helly", restarts=2, folds=2, seed=0)
    assert result["parameters"] == pytest.approx(HELLY, rel=1e-3)
    assert max(result["heldout"]["spacing"]) < 1e-3
    assert result["limits"] == []


def halves(monkeypatch: pytest.MonkeyPatch, pairs: list[Sequence]) -> dict[str, Any]:
    """Separate, pooled and shrunk calibrations of the halves of pairs."""
    monkeypatch.setattr(data, "pairs", lambda folder, test=False: tuple(pairs))
    return tasks.halves("", "helly", list(HELLY.values()), folds=2, restarts=1, seed=0)


@pytest.mark.thorough  # calibrates all pairs some thirty times
def test_persistent_driver_differences_are_recovered(monkeypatch: pytest.MonkeyPatch) -> None:
    gap_times = np.array([1.0, 1.2, 1.4, 1.6, 1.8, 2.0])
    result = halves(monkeypatch, helly_pairs(time_gaps=gap_times))
    assert result["names"] == list(HELLY)
    # the spread of the six time gaps, winsorised at their 5 % quantiles
    winsorised = np.clip(gap_times, *np.quantile(gap_times, [0.05, 0.95]))
    assert result["spread"][2] == pytest.approx(np.std(winsorised, ddof=1), rel=0.05)
    assert max(result["alone"]) < 0.01
    assert np.mean(result["pooled"]) > 0.5
    assert np.mean(result["shrunk"]) < 0.1 * np.mean(result["pooled"])


@pytest.mark.thorough
def test_shrinkage_removes_measurement_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drivers are identical: separate calibrations differ by measurement errors only."""
    rng, pairs = np.random.default_rng(1), helly_pairs()
    for pair in pairs:
        pair.x[1:, 0] += 0.5 * rng.standard_normal((300, 1))
    result = halves(monkeypatch, pairs)
    alone = np.mean(result["alone"])
    assert np.mean(result["shrunk"]) < alone
    assert np.mean(result["pooled"]) < alone


def test_profile_is_minimal_at_the_estimate(study_pairs: list[Sequence]) -> None:
    cost = ResidualProblem(
        EVERY["helly"].system(), collate(study_pairs), FusedSolver(), Convention.spacing
    )
    best = np.array([HELLY[n] for n in tasks.named(cost, cost.start)])
    before = cost.low.copy()
    result = tasks.profile(cost, best, 2, np.arange(6))
    rise = np.array(result["rise"])
    assert list(result["values"]) == sorted(result["values"])
    assert result["values"][int(rise.argmin())] == pytest.approx(HELLY["T"], rel=1e-9)
    assert (rise >= -1e-9).all()
    assert cost.low.tolist() == before.tolist()


def test_only_networks_are_penalised() -> None:
    batch = collate(helly_pairs(2))
    law = ResidualProblem(EVERY["helly"].system(), batch, FusedSolver())
    assert decay(law) is None
    with_network = ResidualProblem(EVERY["idm + network 4"].system(), batch, FusedSolver())
    penalty = decay(with_network)
    assert penalty is not None
    assert (penalty[1] == 0).sum() == 5
    rows = starts(EVERY["idm + network 4"], with_network, 3, seed=1)
    assert rows[0, :5] == pytest.approx([30, 1.2, 2, 1.3, 1.7])
    assert len(np.unique(rows[:, 0])) == 3


def test_keys_of_candidates_are_unique_file_names() -> None:
    assert key("idm + reaction delay") == "idm-reaction_delay"
    assert len({key(name).casefold() for name in EVERY}) == len(EVERY)


def test_jackknife_of_a_mean_is_its_t_interval() -> None:
    values = np.random.default_rng(0).normal(size=(10, 2))
    without = (values.sum(0) - values) / 9
    error = values.std(0, ddof=1) / np.sqrt(10)
    assert tasks.jackknifed(without) == pytest.approx(error * stats.t.ppf(0.975, 9))
