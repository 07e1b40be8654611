"""The walking study's pieces on made-up people."""

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


def walker(run: str, tau: float, known: bool = True) -> Sequence:
    """Two people far apart who relax from half their preferred speed to it, in closed form."""
    time = 0.05 * np.arange(21)
    way = 1.2 * time - 0.6 * tau * (1 - np.exp(-time / tau))
    x = np.zeros((21, 2, 2))
    x[:, 0, 0], x[:, 1, 0] = way, 50 - way
    v = np.zeros_like(x)
    v[:, 0, 0] = 1.2 - 0.6 * np.exp(-time / tau)
    v[:, 1, 0] = -v[:, 0, 0]
    wish = np.array([[1.2, 0.0], [-1.2 if known else np.nan, 0.0]])
    return Sequence(name=f"{run}/0", recording=run, time=time, x=x, v=v, preferred=wish)


def test_every_run_is_held_out_once() -> None:
    dealt = [run for group in groups(3) for run in group]
    assert sorted(dealt) == sorted(run for kind in RUNS for run in RUNS[kind])


def test_a_calibration_finds_the_law_and_tests_it_elsewhere(tmp_path: Path) -> None:
    write_store(tmp_path, [walker("a", 0.8), walker("b", 0.8, known=False)], {"dt": 0.05})
    result = tasks.fit("alone", "direction", [str(tmp_path)], ["b"])
    assert result["row"]["tau"] == pytest.approx(0.8, rel=0.05)  # Euler's steps are 0.05 s
    # who was not measured before is not asked for
    errors = result["errors"]["alone"]["b"]
    assert errors["people"] == 1
    assert errors["mean"] < 1e-4
    simple = tasks.baselines([str(tmp_path)], ["b"])["errors"]
    gone = 0.6 * 0.05 * np.arange(21) - walker("b", 0.8).x[:, 0, 0]
    wanted = float((gone[1:] ** 2).mean())
    assert simple["constant_velocity"]["b"]["mean"] == pytest.approx(wanted, rel=1e-9)
    assert len(chosen([str(tmp_path)], ["b"], test=False)) == 1


def test_laws_have_names_and_starts() -> None:
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
            "errors": {name: {f"r{i}": one} for name in SIMPLE},
        }
        for i, one in enumerate(runs)
    ]
    study = Walking(WalkingStudyOptions(horizons=[1.0], folds=2), pd.DataFrame(rows), [])
    label = LABELS["preferred"]
    assert study.costs("direction", 1.0)[label].mean() == 1.0
    assert study.costs("direction", 1.0, "end")[label].mean() == 0.75
    compared = [(label, LABELS["constant_velocity"])]
    same = differences(study.costs("direction", 1.0), compared, 0).iloc[0]
    assert (same["difference"], same["low"], same["high"]) == (0, 0, 0)


def test_predictions_that_go_straight() -> None:
    batch = collate([walker("a", 0.8)])
    np.testing.assert_allclose(tasks.along_stream(batch)[0], [[1.2, 0], [-1.2, 0]], atol=1e-9)
    x = tasks.straight(batch, batch.v[0])
    np.testing.assert_allclose(x[-1, 0], [[0.6, 0], [49.4, 0]], atol=1e-9)


def test_who_stood_before_is_predicted_to_stay() -> None:
    one = walker("a", 0.8)
    batch = collate([replace(one, preferred=np.array([[0.0, 0.0], [-1.2, 0.0]]))])
    np.testing.assert_allclose(tasks.along_stream(batch)[0], [[0, 0], [-1.2, 0]], atol=1e-9)
