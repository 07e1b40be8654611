"""What the neighbouring programs simulate is calibrated, and what their models have beyond the
calibrated one is found, by the scripts.

Positions get an error as a camera's, but for one test of what a program wrote.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from nnode.calibrate.checkpoint import load_checkpoint
from nnode.exchange.sumo import equilibrium_gap
from nnode.model import Law, System
from tests.app.conftest import Script, forks, script  # noqa: F401
from tests.exchange import by_jupedsim, by_sumo

pytestmark = pytest.mark.slow

#: Errors of measured positions, m: of vehicles, of people.
ROAD_ERROR, ROOM_ERROR = 0.3, 0.01
#: Where drivers keep a longer time, m, and which, s.
STRETCH, LONGER = (500.0, 650.0), 1.5
#: What Krauss' drivers have beyond a law of the gap: v = (1 - kappa) (gap - L) / tau + kappa v_l
#: with kappa = 1 - 1/(v/decel + tau), here at the mean of the leaders' speeds.
MEAN = (by_sumo.SLOW + by_sumo.FAST) / 2
KAPPA = 1 - 1 / (MEAN / by_sumo.DECEL + by_sumo.TAU)
#: Their gap at this speed, m, from front to front.
GAP = by_sumo.LENGTH + by_sumo.MIN_GAP + by_sumo.TAU * MEAN
#: Of a diagnosis of the linear law on whole platoons.
PLATOONS = ("model=lin", "model.leader=measured", "data=sumo", "data.window=null")


@pytest.fixture(scope="module")
def drive(sumo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Platoons by SUMO, measured."""
    return by_sumo.measured(by_sumo.platoons(sumo, tmp_path_factory.mktemp("drive")), ROAD_ERROR)


def keep_longer_times(traci: ModuleType) -> None:
    """Let all drivers within the stretch keep a longer time."""
    for name in traci.vehicle.getIDList():
        inside = STRETCH[0] <= traci.vehicle.getLanePosition(name) < STRETCH[1]
        traci.vehicle.setTau(name, LONGER if inside else by_sumo.TAU)


def diagnosed(script: Script, folder: Path, *overrides: str) -> dict[str, Any]:  # noqa: F811
    script("discover", *overrides, "discover.page=false", f"hydra.run.dir={folder}")
    report: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return report


def law(model: System) -> Law:
    result = model.find_law("lin")
    assert result is not None
    return result


def test_the_law_of_sumo_s_drivers_is_calibrated(
    drive: Path,
    script: Script,  # noqa: F811
    tmp_path: Path,
) -> None:
    script(
        "train",
        "model=lin",
        "model.leader=measured",
        "data=sumo",
        f"data.path={drive}",
        "solver=fused",
        "optimizer=lbfgs",
        "trainer.max_epochs=30",
        f"hydra.run.dir={tmp_path}",
    )
    model = load_checkpoint(tmp_path / "checkpoints" / "best.pt").build()
    assert equilibrium_gap(law(model), MEAN) == pytest.approx(GAP, rel=0.05)


def test_sumo_s_drivers_mind_the_speed_ahead(
    drive: Path,
    script: Script,  # noqa: F811
    tmp_path: Path,
) -> None:
    report = diagnosed(
        script,
        tmp_path,
        *PLATOONS,
        f"data.path={drive}",
    )
    effect, *bounds = report["effects"]
    assert effect["name"] == "asymmetric_response"
    # SUMO bounds accelerations, which a law of first order does not: a short inertia
    assert [bound["name"] for bound in bounds] in ([], ["inertia"])
    assert all(bound["coefficients"]["tau_v"]["value"] < 0.5 for bound in bounds)
    # one kappa for both, its special case, is told apart
    assert effect["alternatives"] == []
    assert report["verdict"] == "named"
    kappa = {name: c["value"] for name, c in effect["coefficients"].items()}
    # Krauss' drivers have one kappa; a bound on accelerations makes that of opening gaps seem less
    assert kappa["kappa_close"] == pytest.approx(KAPPA, abs=0.06)
    assert 0 < kappa["kappa_open"] < kappa["kappa_close"]
    # of followers behind measured leaders, each with his most likely start
    assert report["gap"]["closed"] > 0.8
    assert report["gap"]["after"] < 0.3 * report["gap"]["before"]
    own = load_checkpoint(tmp_path / "checkpoints" / "best.pt").build()
    assert equilibrium_gap(law(own), MEAN) == pytest.approx(GAP, rel=0.05)


def test_sumo_s_drivers_are_understood_without_any_noise(
    sumo: Path,
    script: Script,  # noqa: F811
    tmp_path: Path,
) -> None:
    path = by_sumo.platoons(sumo, tmp_path)
    report = diagnosed(
        script,
        tmp_path / "run",
        *PLATOONS,
        f"data.path={path}",
    )
    # without noise every law that is not exactly right leaves structure: beside what drivers
    # mind first, the bounds on their accelerations may be seen, as a short inertia
    effect, *bounds = report["effects"] + report["hypotheses"]
    assert [bound["name"] for bound in bounds] in ([], ["inertia"])
    assert all(bound["coefficients"]["tau_v"]["value"] < 0.5 for bound in bounds)
    kin = {"asymmetric_response", "relative_speed"}
    assert effect["name"] in kin
    assert {other["name"] for other in effect["alternatives"]} <= kin
    result = {name: c["value"] for name, c in effect["coefficients"].items()}
    assert result.get("kappa_close", result.get("kappa")) == pytest.approx(KAPPA, abs=0.1)
    # of followers behind measured leaders, each with his most likely start; the bounds on
    # accelerations remain
    assert (report["gap"]["closed"] > 0.7) == bool(report["effects"])


def test_the_stretch_of_longer_times_is_found(
    sumo: Path,
    script: Script,  # noqa: F811
    tmp_path: Path,
) -> None:
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
    # where the stretch begins and ends, SUMO bounds accelerations, which the model does not
    assert {other["name"] for other in others} <= {"inertia", "time_gap"}
    result = {name: c["value"] for name, c in effect["coefficients"].items()}
    assert result["alpha"] == pytest.approx(by_sumo.TAU / LONGER, abs=0.05)
    assert result["a"] == pytest.approx(STRETCH[0], abs=10)
    assert result["b"] == pytest.approx(STRETCH[1], abs=10)
    assert report["gap"]["closed"] > 0.9


def test_jupedsim_s_people_return_to_their_speed(
    jupedsim: ModuleType,
    script: Script,  # noqa: F811
    tmp_path: Path,
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
    result = {name: c["value"] for name, c in effect["coefficients"].items()}
    assert result["c"] == pytest.approx(1 / by_jupedsim.REACTION, rel=0.1)
    assert result["v_pref"] == pytest.approx(by_jupedsim.SPEED, rel=0.02)
    assert report["gap"]["closed"] > 0.9
    assert report["gap"]["after"] < 0.3 * report["gap"]["before"]
