"""Parts of the walking study on synthetic paths."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.data.sequence import Sequence, collate
from nnode.data.store import write_store
from studies.frame import differences
from studies.options import WalkingStudyOptions
from studies.walking import tasks
from studies.walking.study import Walking, groups
from studies.walking.tasks import GRID, LABELS, LAWS, RUNS, SIMPLE, chosen, new_system
from tests.builders import people


def walker(run: str, tau: float, measured: bool = True) -> Sequence:
    """Two distant people who accelerate from half their preferred speed, in closed form."""
    time = 0.05 * np.arange(21)
    distance = 1.2 * time - 0.6 * tau * (1 - np.exp(-time / tau))
    speed = 1.2 - 0.6 * np.exp(-time / tau)
    x, v = np.zeros((2, 21, 2, 2))
    x[..., 0] = np.stack([distance, 50 - distance], 1)
    v[..., 0] = np.stack([speed, -speed], 1)
    preferred = np.array([[1.2, 0.0], [-1.2 if measured else np.nan, 0.0]])
    return people(x, 0.05, name=f"{run}/0", v=v, preferred=preferred)


def test_every_run_is_held_out_once() -> None:
    held_out = [run for group in groups(3) for run in group]
    assert sorted(held_out) == sorted(run for kind in RUNS for run in RUNS[kind])


def test_calibration_recovers_tau_and_tests_held_out_runs(tmp_path: Path) -> None:
    write_store(tmp_path, [walker("a", 0.8), walker("b", 0.8, measured=False)], {"dt": 0.05})
    result = tasks.fit("alone", "direction", [str(tmp_path)], ["b"])
    assert result["row"]["tau"] == pytest.approx(
        0.8, rel=0.05
    )  # Euler's method with steps of 0.05 s
    # people without a measured preferred velocity are excluded
    errors = result["errors"]["alone"]["b"]
    assert errors["people"] == 1
    assert errors["mean"] < 1e-4
    baselines = tasks.baselines([str(tmp_path)], ["b"])["errors"]
    difference = 0.6 * 0.05 * np.arange(21) - walker("b", 0.8).x[:, 0, 0]
    expected = float((difference[1:] ** 2).mean())
    assert baselines["constant_velocity"]["b"]["mean"] == pytest.approx(expected, rel=1e-9)
    assert len(chosen([str(tmp_path)], ["b"], test=False)) == 1


def test_laws_have_labels_and_start_values() -> None:
    assert set(LAWS) <= set(LABELS)
    assert set(LAWS) == set(GRID)
    for law, grid in GRID.items():
        names = {name for name, _ in new_system(law, "last").terms[0].named_parameters()}
        assert set(grid) <= names


def test_errors_are_means_over_people() -> None:
    runs = [{"people": 1, "mean": 4.0, "end": 0.0}, {"people": 3, "mean": 0.0, "end": 1.0}]
    rows = [
        {
            "task": "baselines",
            "desired": np.nan,
            "horizon": 1.0,
            "errors": {name: {f"r{i}": run} for name in SIMPLE},
        }
        for i, run in enumerate(runs)
    ]
    study = Walking(WalkingStudyOptions(horizons=[1.0], folds=2), pd.DataFrame(rows), [])
    label = LABELS["preferred"]
    assert study.costs("direction", 1.0)[label].mean() == 1.0
    assert study.costs("direction", 1.0, "end")[label].mean() == 0.75
    pairs = [(label, LABELS["constant_velocity"])]
    row = differences(study.costs("direction", 1.0), pairs, 0).iloc[0]
    assert (row["difference"], row["low"], row["high"]) == (0, 0, 0)


@pytest.mark.parametrize("first", [1.2, 0.0])
def test_predictions_along_the_stream(first: float) -> None:
    """People who move or stand are predicted to keep their preferred velocity."""
    preferred = np.array([[first, 0.0], [-1.2, 0.0]])
    batch = collate([replace(walker("a", 0.8), preferred=preferred)])
    np.testing.assert_allclose(tasks.along_stream(batch)[0], preferred, atol=1e-9)


def test_straight_predictions() -> None:
    batch = collate([walker("a", 0.8)])
    x = tasks.straight(batch, batch.v[0])
    np.testing.assert_allclose(x[-1, 0], [[0.6, 0], [49.4, 0]], atol=1e-9)
