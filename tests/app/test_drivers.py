"""Calibration with driver-specific parameters, in Python and by the command."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.app.drivers import planned
from nnode.app.python.inputs import model_options
from nnode.calibrate.options import TrainerOptions
from nnode.errors import ConfigError
from nnode.model import build_model
from nnode.population import drivers as population
from tests.app.conftest import Script, background, read_json
from tests.app.different import PUSH, PUSH_TIME, TRUE, table
from tests.app.following import TRUE as EXACT
from tests.app.following import pairs

DIFFER = {"T": 0.15}

DriverValues = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def simulated() -> tuple[pd.DataFrame, DriverValues]:
    return table(1, platoons=6, cars=4, seconds=30.0, noise=0.05, differ=DIFFER)


@pytest.fixture(scope="module")
def small(simulated: tuple[pd.DataFrame, DriverValues]) -> pd.DataFrame:
    return simulated[0]


@pytest.fixture(scope="module")
def fitted(small: pd.DataFrame) -> nnode.Calibrator:
    return nnode.Calibrator("idm", drivers=["T"], seed=3).fit(small)


@pytest.mark.thorough
def test_typical_and_individual_drivers_are_recovered(
    simulated: tuple[pd.DataFrame, DriverValues], fitted: nnode.Calibrator
) -> None:
    result = fitted.result_
    assert result.drivers is not None
    for name in ("T", "s0"):
        row = result.parameters.loc[f"idm.{name}"]
        assert row["lower"] < TRUE[name] < row["upper"] < 2 * row["lower"]
    rows = result.drivers.variability
    for name, true in {"T": 15.0, "push": PUSH, "push_time": PUSH_TIME}.items():
        assert rows.lower[name] < true < rows.upper[name]
    assert list(rows.unit) == ["m/s²", "s", "m", "%"]
    assert rows.estimate["measurement"] == pytest.approx(0.05, rel=0.1)
    true_T = simulated[1]["T"]
    drivers = result.drivers.table.set_index("driver")
    true = pd.Series({str(10 * b + i + 1): true_T[b, i] for b in range(6) for i in range(3)})
    z = ((drivers["T"] - true) / drivers["T_error"]).abs()
    assert len(drivers) == 18
    assert z.max() < 5
    assert (z < 2).mean() > 0.8
    assert (drivers["T_shrinkage"] < 0.2).all()
    assert "18 drivers; parameters that differ" in result.summary()
    intervals = result.conf_int()
    for end in ("lower", "upper"):
        expected = result.parameters[end].to_numpy(dtype=float)
        assert intervals[end].to_numpy() == pytest.approx(expected, rel=1e-6, nan_ok=True)
    assert result.fit.likelihood == "mixed-effects model"
    assert np.isfinite(result.fit.bic)
    assert result.drivers.plot().axes[0].get_xlabel() == "T (s)"


def options(table: pd.DataFrame, folder: Path) -> list[str]:
    """Options of the command for the calibration of `fitted`."""
    table.to_parquet(folder / "table.parquet")
    return [
        "model=idm",
        "trainer.drivers=[T]",
        "seed=3",
        "data=table",
        "data.domain=traffic",
        "data.split.heldout=0",
        f"data.path={folder / 'table.parquet'}",
        f"hydra.run.dir={folder / 'run'}",
    ]


@pytest.mark.thorough
def test_command_writes_the_results_of_python(
    script: Script, tmp_path: Path, small: pd.DataFrame, fitted: nnode.Calibrator
) -> None:
    script("train", *options(small, tmp_path))
    run = tmp_path / "run"
    written = read_json(run / "result.json")
    result = fitted.result_
    assert result.drivers is not None
    expected = result.plain(written["paths"])
    for key in ("parameters", "drivers"):
        assert json.dumps(written[key], sort_keys=True) == json.dumps(expected[key], sort_keys=True)
    drivers = pd.read_csv(run / "drivers.csv", dtype={"driver": str})
    pd.testing.assert_frame_equal(drivers, result.drivers.table)
    model = nnode.load(run / "checkpoints" / "best.pt")
    values = {name: float(value) for name, (value, _) in model.physical().items()}
    assert values == {name: row["value"] for name, row in written["parameters"].items()}
    evaluation = [f"checkpoint={run}/checkpoints/best.pt", "part=train", "replay=false"]
    script("evaluate", *evaluation, f"hydra.run.dir={tmp_path}/evaluation")


@pytest.mark.thorough
@pytest.mark.parametrize("model", ["idm", "fvdm"])
def test_identical_drivers_keep_shared_parameters(model: str) -> None:
    calibrator = nnode.Calibrator(model, drivers="auto", method="ballistic")
    calibrator.fit(pairs(number=6, seconds=20.0))
    if model == "idm":
        assert calibrator.result_.drivers is None
        assert calibrator.parameters_.estimate["idm.T"] == pytest.approx(EXACT["T"], rel=1e-4)
    else:  # the wrong law leaves residuals
        assert calibrator.result_.drivers is not None


@pytest.mark.parametrize(
    ("model", "noise", "options", "plan"),
    [
        ("idm", True, {}, None),
        ("idm", False, {}, None),
        ("lin", True, {}, "none"),
        ("a2", True, {}, "none"),
        ("idm", True, {"drivers": "alone"}, "alone"),
        ("idm", True, {"drivers": "none"}, "none"),
        ("idm", False, {"drivers": "auto"}, "auto"),
        ("lin", True, {"drivers": ["v0"]}, ["v0"]),
    ],
)
def test_default_treatment_of_drivers(
    small: pd.DataFrame, model: str, noise: bool, options: dict[str, Any], plan: Any
) -> None:
    sequences = list(nnode.sequences(small if noise else pairs(number=6, seconds=20.0)))
    system = build_model(model_options(model, "measured"), 0)
    for exact in (True, False):
        if plan == "alone" and not exact:
            continue  # refused: test_invalid_options_are_refused
        result = planned(TrainerOptions(**options), system, lambda: sequences, exact)
        assert result == (plan if exact or options.get("drivers") else "none")


def test_diverging_simulations_share_parameters_or_are_refused(
    small: pd.DataFrame, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(population, "_simulated_finitely", lambda model: False)
    result = nnode.Calibrator("idm", epochs=3).fit(small).result_
    assert result.drivers is None
    assert "how drivers differ could not be estimated" in caplog.text
    with pytest.raises(ConfigError, match=r"not simulated to finite .* drivers=none"):
        nnode.Calibrator("idm", drivers="auto", epochs=3).fit(small)


@pytest.mark.thorough
def test_reaction_delay_with_different_drivers(small: pd.DataFrame) -> None:
    delay = {"name": "reaction_delay", "T": 0.3}
    result = nnode.Calibrator("idm", effects=[delay], drivers=["T"], epochs=3).fit(small).result_
    assert result.drivers is not None
    assert result.drivers.differ == ["idm.T"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"drivers": ["foo"]}, r"drivers=foo is no parameter .* v0, T, s0, a, b"),
        (
            {"drivers": "some"},
            r"drivers=some is unknown, expected one of auto, none, alone, or a list",
        ),
        ({"drivers": []}, r"drivers=\[\] is unknown"),
        ({"drivers": "auto", "model": "krauss"}, r"map from step to step; take .*drivers=none"),
        ({"drivers": ["v0"], "model": "n2"}, r"a network, whose weights"),
        ({"drivers": "alone", "model": "a2"}, r"a network, whose weights"),
        ({"drivers": "alone", "optimizer": "lbfgs"}, r"alone needs optimizer=gauss_newton"),
    ],
)
def test_invalid_options_are_refused(
    small: pd.DataFrame, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        nnode.Calibrator(**{"model": "idm", **options}).fit(small)


def test_driver_specific_parameters_of_people_are_refused() -> None:
    rows = [(0, 0.1 * k, a, 0.1 * k + a, 1.0 * a) for k in range(4) for a in range(2)]
    people = pd.DataFrame(rows, columns=["sequence", "time", "agent", "x", "y"])
    with pytest.raises(ConfigError, match="people meet everybody"):
        nnode.Calibrator("sf", drivers="alone", epochs=1).fit(people)


def test_too_few_followers_are_refused(small: pd.DataFrame) -> None:
    with pytest.raises(ConfigError, match="3 followers behind measured leaders, fewer than 5"):
        nnode.Calibrator("idm", drivers="auto").fit(small[small["sequence"] == 0])


@pytest.mark.thorough
def test_interrupted_estimation_of_drivers_resumes(
    script: Script, tmp_path: Path, small: pd.DataFrame, fitted: nnode.Calibrator
) -> None:
    folder = tmp_path / "run"
    process = background(*options(small, tmp_path))
    assert process.stdout is not None
    for line in process.stdout:
        if "with drivers who differ" in line:
            break
    before = nnode.load(folder / "checkpoints" / "best.pt").physical()
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, errors
    last = folder / "checkpoints" / "last.pt"
    assert f"resume={last} hydra.run.dir={folder}" in errors
    assert not (folder / "drivers.csv").exists()
    script("train", f"resume={last}", folder=folder)
    written = read_json(folder / "result.json")["parameters"]
    for name, row in fitted.parameters_.iterrows():
        assert written[name]["value"] == pytest.approx(row["estimate"], rel=1e-9)
        assert written[name]["value"] != float(before[name][0])


@pytest.mark.thorough
def test_drivers_are_recovered_from_noisy_positions() -> None:
    differ = {"T": 0.15, "v0": 0.15}
    measured, _ = table(201, platoons=20, cars=5, seconds=60.0, noise=0.3, differ=differ)
    result = nnode.fit(measured, model="idm", heldout=0.0)
    assert result.drivers is not None
    assert sorted(result.drivers.differ) == ["T", "v0"]
    values = result.parameters.estimate
    for name in ("T", "v0"):
        assert values[f"idm.{name}"] == pytest.approx(TRUE[name], rel=0.05)
        assert 12 < result.drivers.variability.estimate[name] < 18
    assert values["idm.s0"] == pytest.approx(TRUE["s0"], abs=0.5)


@pytest.mark.thorough
def test_summary_names_estimates_at_a_bound(fitted: nnode.Calibrator) -> None:
    drivers = fitted.result_.drivers
    assert drivers is not None
    assert "allowed value" not in "".join(drivers.summary())
    variability = drivers.variability.copy()
    variability.loc["T", "at_bound"] = "low"
    (line,) = [
        line
        for line in replace(drivers, variability=variability).summary()
        if "allowed value" in line
    ]
    assert "variation of T is estimated at its smallest allowed value" in line
