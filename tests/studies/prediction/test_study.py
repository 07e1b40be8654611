"""Parts of the prediction study on synthetic pairs and on the published data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.app.python.inputs import data_options
from nnode.data.prepare import prepare
from nnode.data.sequence import Sequence
from nnode.data.store import write_store
from nnode.model.build import build_model
from studies.prediction import printed, study, tasks
from studies.prediction.tasks import AHEAD, SCENES, SEEN, events, scene
from studies.walking import tasks as walking
from studies.walking.study import errors_by_run
from studies.walking.tasks import chosen
from tests.builders import lane

FREE = {"parameters": {"v0": "12 m/s"}, "rate": {"x": "v0"}}


def pair(number: int, v0: float, split: str) -> Sequence:
    """A follower at the leader's constant speed, with a net gap of 40 m."""
    x = v0 * 0.1 * np.arange(31)[:, None] + np.array([0.0, 44.0])
    extra = {"agents": (f"f{number}", f"l{number}"), "length": np.array([np.nan, 4.0])}
    return lane(x, 0.1, v=v0, name=f"{split}/{number}", split=split, **extra)


def test_rmspe_of_all_samples() -> None:
    system = build_model({"term": "formula", "name": "free", "leader": "measured", "law": FREE})
    sums = tasks.squares(system, [pair(1, 12.0, "test"), pair(2, 10.0, "test")])
    time = 0.1 * np.arange(31)
    np.testing.assert_allclose(sums["error"], [0, ((2 * time) ** 2).sum()], atol=1e-9)
    np.testing.assert_allclose(sums["spacing"], [31 * 40**2] * 2)
    expected = np.sqrt(((2 * time) ** 2).sum() / (2 * 31 * 40**2))
    assert tasks.rmspe(sums) == pytest.approx(expected)
    assert tasks.rmspe(sums, np.array([1.0, 0.0])) == pytest.approx(0.0, abs=1e-9)


def test_calibration_uses_training_events_only(tmp_path: Path) -> None:
    pairs = [pair(1, 9.0, "train"), pair(2, 9.0, "train"), pair(3, 11.0, "test")]
    write_store(tmp_path, pairs, {"dt": 0.1})
    result = tasks.follow("newell", str(tmp_path), 2, 0)
    assert tasks.rmspe(result["train"]) < 0.01
    assert len(result["test"]["error"]) == 1


@pytest.mark.real
def test_constant_velocity_errors_as_published(real_data: Path, tmp_path: Path) -> None:
    """Windows are consecutive here; in the published figures they begin at every sample."""
    if not (real_data / "eth_ucy").is_dir():
        pytest.skip("eth_ucy is not there")
    for name in SCENES[1:]:
        store = prepare(scene(name, str(real_data)), tmp_path / name)
        errors = walking.baselines([str(store.folder)], [name])["errors"]
        result = errors["constant_velocity"][name]
        ade, fde = printed.constant_velocity[name]
        assert result["ade"] == pytest.approx(ade, rel=0.08)
        assert result["fde"] == pytest.approx(fde, rel=0.08)
        (batch,) = chosen([str(store.folder)], [name], test=True)
        assert batch.n_samples == AHEAD + 1
        assert batch.preferred is not None
        # everyone is present in all observed samples
        (first, *_) = store
        assert first.dt * (SEEN - 1) == pytest.approx(2.8)


@pytest.mark.real
def test_configurations_as_in_the_study(real_data: Path) -> None:
    for name, option in (("waymo_pairs", events(str(real_data))), ("eth_ucy", scene("x", ""))):
        packaged = data_options(name, {"path": option.path, "source": option.source})
        chosen = ("columns", "time_unit", "frame_rate", "velocity", "history", "t_seq")
        for key in (key for key in chosen if hasattr(option, key)):
            assert getattr(packaged, key) == pytest.approx(getattr(option, key)), key


def test_tables_of_errors() -> None:
    sums = {"error": [1.0, 9.0], "spacing": [100.0, 100.0]}
    run = {"people": 4, "ade": 0.5, "fde": 1.0}
    result = pd.DataFrame(
        [
            {"task": "follow", "law": "idm", "row": {"T": 1.5}, "train": sums, "test": sums},
            {"errors": {name: {"eth_univ": run} for name in study.SIMPLE}},
            {"errors": {"alone": {"eth_univ": {**run, "ade": 0.25}}}},
        ]
    )
    table = study.following(result, 0)
    assert table.loc["idm", "test"] == pytest.approx(np.sqrt(10 / 200))
    assert table.loc["idm", "low"] < table.loc["idm", "test"] < table.loc["idm", "high"]
    assert table.loc["idm", "parameters"] == "T = 1.5"
    assert list(table.index[1:]) == ["idm, published", "learned, published"]
    distances = errors_by_run(result["errors"].dropna(), study.SIMPLE | study.PEOPLE)
    ade = study.by_scene(distances, "ade")["eth_univ"]
    assert ade.to_dict() == {
        "constant velocity": 0.5,
        "mean speed with the stream": 0.5,
        "no interaction": 0.25,
        "constant velocity, published": printed.constant_velocity["eth_univ"][0],
    }
