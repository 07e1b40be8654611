"""Errors of followers by pair and by driver."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nnode.app.followers import by_driver, follower_errors, write_followers
from nnode.data.clusters import index_of
from nnode.data.sequence import Batch, Sequence, collate
from nnode.simulation.base import Trajectory
from tests.builders import lane


def pair(number: int, samples: int) -> Sequence:
    x = np.arange(samples)[:, None] + [0.0, 40.0]
    return lane(x, 0.1, v=10.0, name=f"run/{number}", agents=("driver", f"leader {number}"))


def late(batch: Batch) -> Trajectory:
    """Followers of pair b lag by b + 1 m after the first sample, at 0.5 m/s less."""
    x, v = batch.x.clone(), batch.v.clone()
    for b in range(len(batch)):
        x[1:, b, 0] -= b + 1
        v[1:, b, 0] -= 0.5
    given = torch.tensor([[False, True]]).expand(len(batch), 2)
    return Trajectory(x, v, given)


def test_errors_by_pair_and_driver(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequences = [pair(1, 21), pair(2, 11)]
    rows = follower_errors(late, [collate(sequences)], index_of(sequences))
    assert rows["sequence"].tolist() == ["run/1", "run/2"]
    assert rows["samples"].tolist() == [20, 10]
    for key, expected in (
        ("spacing_rmse", [1, 2]),
        ("spacing_bias", [1, 2]),
        ("final_error", [1, 2]),
        ("speed_rmse", [0.5, 0.5]),
        ("speed_bias", [-0.5, -0.5]),
    ):
        np.testing.assert_allclose(rows[key], expected, atol=1e-12)
    (driver,) = by_driver(rows).to_dict("records")
    assert (driver["driver"], driver["sequences"], driver["samples"]) == ("driver", 2, 30)
    # 20 samples of 1 m and 10 samples of 2 m
    assert driver["spacing_rmse"] == pytest.approx(np.sqrt((20 + 10 * 4) / 30))
    assert driver["spacing_bias"] == pytest.approx((20 + 20) / 30)
    assert driver["final_error"] == pytest.approx(1.5)
    write_followers(rows, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"pairs.csv", "drivers.csv", "pairs.png"}
    printed = capsys.readouterr().out
    assert "spacing RMSE (m)" in printed
    assert "run/2" in printed


def test_speeds_are_differentiated_if_absent() -> None:
    def slow(batch: Batch) -> Trajectory:
        return Trajectory(batch.x[:1] + 0.8 * (batch.x - batch.x[:1]), None)

    anonymous = [replace(pair(1, 11), agents=())]
    rows = follower_errors(slow, [collate(anonymous)], index_of(anonymous))
    assert rows["driver"].tolist() == ["run/1 0"]
    np.testing.assert_allclose(rows["speed_bias"], -2.0, atol=1e-9)
    # leader and follower lag equally
    np.testing.assert_allclose(rows["spacing_rmse"], 0.0, atol=1e-9)
    np.testing.assert_allclose(rows["final_error"], 2.0, atol=1e-9)


def test_drivers_are_distinct_between_recordings() -> None:
    sequences = [pair(1, 11), replace(pair(2, 11), recording="other")]
    rows = follower_errors(late, [collate(sequences)], index_of(sequences))
    assert by_driver(rows)["recording"].tolist() == ["run", "other"]
