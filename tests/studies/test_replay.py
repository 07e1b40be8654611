"""Simulated and measured scenes of a study's player."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nnode.errors import SimulationError
from nnode.pages.replay import ReplayBlock
from studies import replay
from studies.traffic.tasks import system_of
from tests.builders import lane
from tests.studies.traffic.invented import platoons

V0, L = 25.0, 5.0


def test_simulated_scenes_follow_the_law() -> None:
    sequences = platoons("a")[:2]
    system = system_of("lin", {"v0": V0, "L": L})
    for scene in replay.scenes(sequences, {"lin": system}, dt=0.001):
        s = scene.sequence
        time = s.time - s.time[0]
        x = scene.simulated["lin"][:, :, 0]
        np.testing.assert_allclose(x[:, -1], s.x[0, -1, 0] + V0 * time, atol=1e-9)
        # the initial speed follows from the law v0 (1 - L/gap)
        gap = s.x[0, -1, 0] - s.x[0, -2, 0]
        first = (x[1, -2] - x[0, -2]) / time[1]
        assert first == pytest.approx(V0 * (1 - L / gap), rel=0.03)


def test_positions_after_a_blow_up_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise SimulationError("it blew up")

    monkeypatch.setattr(replay.FusedSolver, "__call__", fail)
    (s,) = platoons("a")[:1]
    (scene,) = replay.scenes([s], {"lin": system_of("lin", {"v0": V0, "L": L})})
    x = scene.simulated["lin"]
    np.testing.assert_array_equal(x[0], s.x[0])
    assert np.isnan(x[1:]).all()
    text, caption = ReplayBlock("replay", [scene], "One.", "One.", total=7).data()
    assert caption.startswith("The player contains 1 of 7 sequences.")
    rows = json.loads(text)["scenes"][0]["simulated"][0]["x"]
    assert all(row[1:] == [None] * (s.n_samples - 1) for row in rows)


def test_sequence_of_a_single_car() -> None:
    s = lane(4.0 * np.arange(4)[:, None])
    (scene,) = replay.scenes([s], {"lin": system_of("lin", {"v0": V0, "L": L})})
    np.testing.assert_allclose(scene.simulated["lin"][:, 0, 0], V0 * s.time, atol=1e-9)
