"""Calibration and diagnosis of simulations by SUMO and JuPedSim.

The diagnosis finds the effects by which their models differ from the calibrated law. Positions have
measurement errors except in one test.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from nnode.calibrate.checkpoint import load_checkpoint
from nnode.exchange.sumo import equilibrium_gap
from tests.app.conftest import Script, read_json
from tests.exchange import by_jupedsim, by_sumo

pytestmark = pytest.mark.slow

#: Measurement errors of positions of vehicles and of people (m).
ROAD_ERROR, ROOM_ERROR = 0.3, 0.01
#: Stretch with a longer time gap (m), and this time gap (s).
STRETCH, LONG_TAU = (500.0, 650.0), 1.5
#: The law of Krauss is v = (1 - kappa) (gap - L) / tau + kappa v_l with
#: kappa = 1 - 1/(v/decel + tau), here at the mean of the leaders' speeds.
MEAN = (by_sumo.SLOW + by_sumo.FAST) / 2
KAPPA = 1 - 1 / (MEAN / by_sumo.DECEL + by_sumo.TAU)
#: Front-to-front gap at this speed (m).
GAP = by_sumo.LENGTH + by_sumo.MIN_GAP + by_sumo.TAU * MEAN
#: Options of a diagnosis of the linear law on whole platoons.
PLATOONS = ("model=lin", "model.leader=measured", "data=sumo", "data.window=null")


@pytest.fixture(scope="module")
def drive(sumo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SUMO's platoons with measurement errors."""
    return by_sumo.measured(by_sumo.platoons(sumo, tmp_path_factory.mktemp("drive")), ROAD_ERROR)


def keep_longer_times(traci: ModuleType) -> None:
    """Give all drivers within the stretch a longer time gap."""
    for name in traci.vehicle.getIDList():
        inside = STRETCH[0] <= traci.vehicle.getLanePosition(name) < STRETCH[1]
        traci.vehicle.setTau(name, LONG_TAU if inside else by_sumo.TAU)


def diagnosed(script: Script, folder: Path, *overrides: str) -> dict[str, Any]:
    script("discover", *overrides, "discover.page=false", folder=folder)
    report: dict[str, Any] = read_json(folder / "report.json")
    return report


def calibrated_gap(run: Path) -> float:
    """The calibrated law's gap at the mean speed."""
    law = load_checkpoint(run / "checkpoints" / "best.pt").build().find_law("lin")
    assert law is not None
    return equilibrium_gap(law, MEAN)


def values(effect: dict[str, Any]) -> dict[str, float]:
    return {name: c["value"] for name, c in effect["coefficients"].items()}


def check_bounds(effects: list[dict[str, Any]]) -> None:
    """SUMO bounds accelerations, which a law of first order represents by a short inertia."""
    assert [effect["name"] for effect in effects] in ([], ["inertia"])
    assert all(effect["coefficients"]["tau_v"]["value"] < 0.5 for effect in effects)


def test_law_of_sumo_is_calibrated(drive: Path, script: Script, tmp_path: Path) -> None:
    script(
        "train",
        "model=lin",
        "model.leader=measured",
        "data=sumo",
        f"data.path={drive}",
        "solver=fused",
        "optimizer=lbfgs",
        "trainer.max_epochs=30",
        folder=tmp_path,
    )
    assert calibrated_gap(tmp_path) == pytest.approx(GAP, rel=0.05)


def test_relative_speed_in_sumo_is_named(drive: Path, script: Script, tmp_path: Path) -> None:
    report = diagnosed(script, tmp_path, *PLATOONS, f"data.path={drive}")
    effect, *bounds = report["effects"]
    assert effect["name"] == "asymmetric_response"
    check_bounds(bounds)
    # the special case of equal kappas is rejected
    assert effect["alternatives"] == []
    assert report["verdict"] == "named"
    kappa = values(effect)
    # the law of Krauss has one kappa; bounded accelerations reduce that of opening gaps
    assert kappa["kappa_close"] == pytest.approx(KAPPA, abs=0.06)
    assert 0 < kappa["kappa_open"] < kappa["kappa_close"]
    assert report["gap"]["closed"] > 0.8
    assert report["gap"]["after"] < 0.3 * report["gap"]["before"]
    assert calibrated_gap(tmp_path) == pytest.approx(GAP, rel=0.05)


def test_relative_speed_in_sumo_is_found_without_noise(
    sumo: Path, script: Script, tmp_path: Path
) -> None:
    path = by_sumo.platoons(sumo, tmp_path)
    report = diagnosed(script, tmp_path / "run", *PLATOONS, f"data.path={path}")
    effect, *bounds = report["effects"] + report["hypotheses"]
    check_bounds(bounds)
    similar = {"asymmetric_response", "relative_speed"}
    assert effect["name"] in similar
    assert {other["name"] for other in effect["alternatives"]} <= similar
    result = values(effect)
    assert result.get("kappa_close", result.get("kappa")) == pytest.approx(KAPPA, abs=0.1)
    # the bounds of accelerations remain
    assert (report["gap"]["closed"] > 0.7) == bool(report["effects"])


def test_stretch_of_longer_time_gaps_is_named(sumo: Path, script: Script, tmp_path: Path) -> None:
    path = by_sumo.platoons(sumo, tmp_path, spread=350.0, steer=keep_longer_times)
    report = diagnosed(
        script,
        tmp_path / "run",
        *PLATOONS,
        f"model.effects=[{{name: asymmetric_response, kappa_open: {KAPPA}, kappa_close: {KAPPA}}}]",
        f"data.path={by_sumo.measured(path, ROAD_ERROR)}",
    )
    assert report["verdict"] == "named"
    effect, *others = report["effects"]
    assert effect["name"] == "speed_zone"
    # SUMO bounds accelerations at both ends of the stretch
    assert {other["name"] for other in others} <= {"inertia", "time_gap"}
    result = values(effect)
    assert result["alpha"] == pytest.approx(by_sumo.TAU / LONG_TAU, abs=0.05)
    assert result["a"] == pytest.approx(STRETCH[0], abs=10)
    assert result["b"] == pytest.approx(STRETCH[1], abs=10)
    assert report["gap"]["closed"] > 0.9


def test_preferred_speed_in_jupedsim_is_named(
    jupedsim: ModuleType, script: Script, tmp_path: Path
) -> None:
    path = by_jupedsim.crowds(jupedsim, tmp_path / "walk.sqlite")
    report = diagnosed(
        script,
        tmp_path / "run",
        "model=sf",
        f"model.r={by_jupedsim.RADIUS}",
        "model.B=0.08",
        "data=jupedsim",
        f"data.path={by_jupedsim.measured(path, ROOM_ERROR)}",
        "data.t_seq=3",
    )
    assert report["verdict"] == "named"
    (effect,) = report["effects"]
    assert effect["name"] == "preferred_speed"
    result = values(effect)
    assert result["c"] == pytest.approx(1 / by_jupedsim.REACTION, rel=0.1)
    assert result["v_pref"] == pytest.approx(by_jupedsim.SPEED, rel=0.02)
    assert report["gap"]["closed"] > 0.9
    assert report["gap"]["after"] < 0.3 * report["gap"]["before"]
