"""The traffic study's calculations: known truths, and figures that others have published."""

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
    """Cars that follow the linear law."""
    rng = np.random.default_rng(2)
    return linear([np.cumsum(rng.uniform(7, 25, 4)) for _ in range(number)], V0, L, 7, 0.0005)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("platoons")
    write_store(folder, platoons(8), {"domain": "traffic"})
    return str(folder)


def test_a_fit_to_noise_ends_at_a_minimum(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    noisy = [replace(s, x=s.x + noise.normal(0.0, 0.1, s.x.shape)) for s in platoons(8)]
    write_store(tmp_path, noisy, {"domain": "traffic"})
    one = tasks.fit(str(tmp_path), "r", "lin", None, 4, 0.002, 60, 20, [0.02, 0.001], 0)
    assert one["cost"] > 1e-2
    assert one["residual"] < 1e-3


def test_fit_finds_the_truth(store: str) -> None:
    one = tasks.fit(store, "r", "lin", None, 4, 0.002, 60, 20, [0.02, 0.001], 0)
    assert one["parameters"]["v0"] == pytest.approx(V0, rel=2e-3)
    assert one["parameters"]["L"] == pytest.approx(L, rel=5e-3)
    assert one["cost"] == pytest.approx(np.mean(one["costs"]))
    # the data are exact: only Euler's error is left, which falls with the step
    assert one["steps_costs"]["0.001"] < one["cost"] + 1e-6 < one["steps_costs"]["0.02"] < 1e-2
    # relative to a cost of 4e-6, the residual is rounding here: see the test below
    assert len(one["speeds"]) == 49
    assert one["speeds"][18] == pytest.approx(V0 * (1 - L / 20), rel=5e-3)
    low, high = np.quantile(one["bootstrap"]["values"]["L"], [0.025, 0.975])
    assert low <= one["parameters"]["L"] <= high < L * 1.01


def test_a_box_holds_the_weights_and_costs(store: str) -> None:
    costs = {}
    for box in (None, 0.5):
        one = tasks.fit(store, "r", "n4", box, 4, 0.02, 60, 0, [], 0)
        weights = np.concatenate(
            [np.ravel(v) for k, v in one["parameters"].items() if k.startswith("network")]
        )
        costs[box] = one["cost"]
        if box is not None:
            assert np.abs(weights).max() <= box
    assert costs[None] < 0.5 * costs[0.5]


def test_held_out_costs_do_not_know_their_own_sequence(store: str, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    honest = tasks.cross_validate(store, "r", "lin", None, 4, 3, 0.02, 40, 0)
    assert np.mean(honest["costs"]) < 0.01 < np.mean(honest["constant_velocity"])
    # disturb one sequence: its own cost changes, and those of its fold, calibrated without
    # it, do not
    items = platoons(8)
    x = items[0].x.copy()
    x[1:, 0] -= 4.0
    spoiled = [Sequence(name=items[0].name, recording="r", time=items[0].time, x=x), *items[1:]]
    monkeypatch.setattr(tasks, "recording", lambda *_: spoiled)
    repeated = tasks.cross_validate(store, "r", "lin", None, 4, 3, 0.02, 40, 0)
    changed = ~np.isclose(honest["costs"], repeated["costs"], rtol=1e-4, atol=1e-9)
    assert changed[0]
    rng = np.random.default_rng(0)
    fold = (rng.permutation(8) % 4)[np.array(honest["groups"])]
    same = (fold == fold[0]) & (np.arange(8) > 0)
    assert same.any()
    assert not changed[same].any()
    assert changed[fold != fold[0]].all()


def test_descent_gets_closer(store: str) -> None:
    down = tasks.descend(store, "r", "lin", 2, 300, 0.02, 0.02, 1.0, 3, 0)
    assert down["cost"] < 0.4 * down["history"][0][1]
    best = [row[1] for row in down["history"]]
    assert best == sorted(best, reverse=True)


def test_a_grid_contains_the_truth(store: str) -> None:
    one = tasks.scan(store, "r", "lin", 21, 0.02)
    assert one["lengths"][int(np.argmin(one["by_length"]))] == pytest.approx(L, abs=0.51)
    assert min(one["by_length"]) == one["cost"]


@pytest.mark.parametrize("step", [0.03, 1.0])
def test_steps_divide_the_sampling_interval(step: float, tmp_path: Path) -> None:
    options = TrafficStudyOptions(source="nowhere", workers=1, dt=step)
    with pytest.raises(ConfigError, match=r"study\.dt="):
        traffic.run(options, tmp_path)


def test_starts_begin_with_the_papers(store: str) -> None:
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


#: Least costs (m² s) of a direct search over (v0, L >= 2 m) with Euler steps of 0.02 s, made
#: independently of this package. Its 82.98 for Lin on 4-1_2 is a local minimum.
SEARCHED = {
    "lin": (48.67, 42.23, 99.17, 30.80, 17.97, 37.73, 37.55, None, 10.03, 45.96),
    "log": (56.05, 49.41, 115.37, 63.44, 26.37, 54.48, 37.57, 58.46, 15.07, 50.90),
}


@pytest.mark.thorough
@pytest.mark.parametrize("model", SEARCHED)
def test_laws_cost_what_a_direct_search_found(model: str, esimas: str) -> None:
    for name, expected in zip(printed.recordings, SEARCHED[model], strict=True):
        if expected is not None:
            one = tasks.fit(esimas, name, model, None, 8, 0.02, 100, 0, [], 0)
            # to the digits given, or lower: a direct search may stop short of the minimum
            assert expected - 0.4 < one["cost"] < expected + 0.006, name
