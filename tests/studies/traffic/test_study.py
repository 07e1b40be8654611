"""The traffic study's tasks on platoons with a known law, and against independent results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nnode.data.sequence import Sequence
from nnode.data.store import write_store
from nnode.errors import ConfigError
from studies.options import TrafficStudyOptions
from studies.traffic import printed, tasks
from studies.traffic import study as traffic
from studies.traffic.tasks import Problem
from tests.builders import linear

V0, L = 24.0, 5.0


def platoons(number: int) -> list[Sequence]:
    """Platoons by the linear law."""
    rng = np.random.default_rng(2)
    return linear([np.cumsum(rng.uniform(7, 25, 4)) for _ in range(number)], V0, L, 7, 0.0005)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("platoons")
    write_store(folder, platoons(8), {"domain": "traffic"})
    return str(folder)


def test_fit_to_noisy_data_ends_at_a_minimum(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    noisy = [replace(s, x=s.x + noise.normal(0.0, 0.1, s.x.shape)) for s in platoons(8)]
    write_store(tmp_path, noisy, {"domain": "traffic"})
    result = tasks.fit(str(tmp_path), "r", "lin", None, 4, 0.002, 60, 20, [0.02, 0.001], 0)
    assert result["cost"] > 1e-2
    assert result["residual"] < 1e-3


def test_fit_recovers_the_truth(store: str) -> None:
    result = tasks.fit(store, "r", "lin", None, 4, 0.002, 60, 20, [0.02, 0.001], 0)
    assert result["parameters"]["v0"] == pytest.approx(V0, rel=2e-3)
    assert result["parameters"]["L"] == pytest.approx(L, rel=5e-3)
    assert result["cost"] == pytest.approx(np.mean(result["costs"]))
    # the data are exact, so that the cost is Euler's error, which falls with the step
    assert (
        result["steps_costs"]["0.001"]
        < result["cost"] + 1e-6
        < result["steps_costs"]["0.02"]
        < 1e-2
    )
    assert len(result["speeds"]) == 49
    assert result["speeds"][18] == pytest.approx(V0 * (1 - L / 20), rel=5e-3)
    low, high = np.quantile(result["bootstrap"]["values"]["L"], [0.025, 0.975])
    assert low <= result["parameters"]["L"] <= high < L * 1.01


def test_weights_in_a_box(store: str) -> None:
    costs = {}
    for box in (None, 0.5):
        result = tasks.fit(store, "r", "n4", box, 4, 0.02, 60, 0, [], 0)
        weights = np.concatenate(
            [np.ravel(v) for k, v in result["parameters"].items() if k.startswith("network")]
        )
        costs[box] = result["cost"]
        if box is not None:
            assert np.abs(weights).max() <= box
    assert costs[None] < 0.5 * costs[0.5]


def test_held_out_sequences_do_not_affect_their_fold(store: str, monkeypatch) -> None:
    original = tasks.cross_validate(store, "r", "lin", None, 4, 3, 0.02, 40, 0)
    assert np.mean(original["costs"]) < 0.01 < np.mean(original["constant_velocity"])
    # a disturbed sequence changes its own cost and those of other folds, but not those of its
    # own fold, which is calibrated without it
    items = platoons(8)
    x = items[0].x.copy()
    x[1:, 0] -= 4.0
    disturbed = [Sequence(name=items[0].name, recording="r", time=items[0].time, x=x), *items[1:]]
    monkeypatch.setattr(tasks, "recording", lambda *_: disturbed)
    repeated = tasks.cross_validate(store, "r", "lin", None, 4, 3, 0.02, 40, 0)
    changed = ~np.isclose(original["costs"], repeated["costs"], rtol=1e-4, atol=1e-9)
    assert changed[0]
    rng = np.random.default_rng(0)
    fold = (rng.permutation(8) % 4)[np.array(original["groups"])]
    same = (fold == fold[0]) & (np.arange(8) > 0)
    assert same.any()
    assert not changed[same].any()
    assert changed[fold != fold[0]].all()


def test_descent_lowers_the_cost(store: str) -> None:
    result = tasks.descend(store, "r", "lin", 2, 300, 0.02, 0.02, 1.0, 3, 0)
    assert result["cost"] < 0.4 * result["history"][0][1]
    best = [row[1] for row in result["history"]]
    assert best == sorted(best, reverse=True)


def test_minimum_of_the_grid_is_the_truth(store: str) -> None:
    result = tasks.scan(store, "r", "lin", 21, 0.02)
    assert result["lengths"][int(np.argmin(result["by_length"]))] == pytest.approx(L, abs=0.51)
    assert min(result["by_length"]) == result["cost"]


@pytest.mark.parametrize("step", [0.03, 1.0])
def test_steps_must_divide_the_sampling_interval(step: float, tmp_path: Path) -> None:
    options = TrafficStudyOptions(source="nowhere", workers=1, dt=step)
    with pytest.raises(ConfigError, match=r"study\.dt="):
        traffic.run(options, tmp_path)


def test_first_starts_are_those_of_the_paper(store: str) -> None:
    problem = Problem(platoons(2), "n4")
    rows = problem.starts(8, 0)
    assert (rows[:4, 1:].abs() <= 1).all()
    assert rows[4:, 1:].abs().max() > 1
    assert (rows[:, 0] == 30.0).all()
    assert torch.equal(rows, problem.starts(8, 0))
    assert Problem(platoons(2), "lin").starts(3, 0)[0].tolist() == [30.0, 5.0]


def test_printed_averages_follow_from_the_printed_rows() -> None:
    for model, row in printed.costs.items():
        assert np.mean(row) == pytest.approx(printed.average_costs[model], abs=0.06), model
    for model, row in printed.lengths.items():
        assert np.mean(row) == pytest.approx(printed.average_lengths[model], abs=0.02), model


#: Costs (m² s) of an independent direct search over (v0, L >= 2 m) with Euler steps of 0.02 s.
#: None: its 82.98 for Lin on 4-1_2 is a local minimum.
SEARCHED = {
    "lin": (48.67, 42.23, 99.17, 30.80, 17.97, 37.73, 37.55, None, 10.03, 45.96),
    "log": (56.05, 49.41, 115.37, 63.44, 26.37, 54.48, 37.57, 58.46, 15.07, 50.90),
}


@pytest.mark.thorough
@pytest.mark.parametrize("model", SEARCHED)
def test_costs_as_a_direct_search(model: str, esimas: str) -> None:
    for name, expected in zip(printed.recordings, SEARCHED[model], strict=True):
        if expected is not None:
            result = tasks.fit(esimas, name, model, None, 8, 0.02, 100, 0, [], 0)
            # to the given digits, or lower, because a direct search may not reach the minimum
            assert expected - 0.4 < result["cost"] < expected + 0.006, name
