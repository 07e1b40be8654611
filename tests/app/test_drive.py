"""``nnode drive`` and ``nnode.drive``: a calibrated model drives vehicles in SUMO."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import nnode
from benchmarks.programs import sumo as by_sumo
from nnode.app.drive import _has_lengths, steps_of
from nnode.app.python.inputs import model_options
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from nnode.data.prepare import prepare
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.readers.table import TableOptions
from nnode.errors import CheckpointError, ConfigError
from nnode.exchange.running_sumo import Steps
from nnode.model import build_model
from tests.app.conftest import Script, read_json
from tests.data.tables import saved, tidy
from tests.exchange.by_sumo import configured


@pytest.fixture(scope="module")
def sumo() -> Path:
    """SUMO's folder."""
    return Path(pytest.importorskip("sumo").SUMO_HOME)


def run_of(folder: Path, name: str, *effects: dict[str, Any], **solver: Any) -> Path:
    """A run's folder that holds only the checkpoint."""
    options = {**model_options(name, "measured"), "effects": list(effects)}
    checkpoint = Checkpoint(
        config={
            "model": options,
            "seed": 0,
            "trainer": {"dtype": "float64"},
            "data": {"name": "sumo"},
            "solver": {"name": "fused", "dt": 0.1, "method": None, **solver},
        },
        manifest={"dt": 0.2},
        model=build_model(options).state_dict(),
        optimizer={},
        progress={},
    )
    save_checkpoint(checkpoint, folder / "checkpoints" / "best.pt")
    return folder


@pytest.fixture
def scene(sumo: Path, tmp_path: Path) -> Path:
    """Seven vehicles of type ``own`` behind one of type ``lead``, ballistic steps of 0.1 s."""
    by_sumo.write_scene(sumo, tmp_path, "Krauss", {"decel": 4.5})
    return configured(tmp_path, end=20.0, ballistic=True)


@pytest.mark.thorough
def test_command(script: Script, scene: Path, tmp_path: Path) -> None:
    run, out = run_of(tmp_path / "run", "idm"), tmp_path / "out"
    options = [f"run={run}", f"sumo={scene}", "program=traci", "lengths=true"]
    done = script("drive", *options, "vehicles=own", folder=out)
    summary = read_json(out / "drive.json")
    assert (summary["driven"], summary["steps"], summary["collisions"]) == (7, 200, 0)
    assert "driven: 7 vehicles, mean " in done.stdout
    assert "200 ballistic steps of 0.1 s" in done.stdout
    (observed,) = read_sumo(out / "fcd.xml.gz", SumoOptions(path="", dt=0.1))
    assert (observed.n_agents, observed.n_samples) == (8, 200)
    assert observed.kind == ("own",) * 7 + ("lead",)
    store = prepare(SumoOptions(path=str(out / "fcd.xml.gz")), tmp_path / "store")
    assert len(store) == 1

    done = script("drive", *options, "vehicles=car", folder=out, status=2)
    assert "error: vehicles=car is no vehicle type of the scenario, it has lead, own" in done.stderr


def test_drive_in_python(scene: Path, tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", "idm")
    result = nnode.drive(run, sumo=scene, vehicles=["own", "lead"], program="traci", lengths=True)
    assert result.driven == 8
    assert result.trajectories.is_file()
    assert (result.step, result.method, result.seconds) == (0.1, "ballistic", pytest.approx(20.0))
    assert 0 < result.in_sumo < result.wall


@pytest.mark.thorough
def test_conflicting_steps_need_a_choice(scene: Path, tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", "idm", dt=0.05, method="semi_implicit")
    options: dict[str, Any] = {"sumo": scene, "vehicles": "own", "program": "traci"}
    options.update(folder=tmp_path, lengths=True)
    words = r"ballistic steps of 0\.1 s.*semi_implicit steps of 0\.05 s.*solver\.dt=0\.1"
    with pytest.raises(ConfigError, match=words):
        nnode.drive(run, **options)
    result = nnode.drive(run, steps="run", **options)
    assert (result.step, result.method, result.steps) == (0.05, "semi_implicit", 400)
    result = nnode.drive(run, steps="scenario", **options)
    assert (result.step, result.method, result.steps) == (0.1, "ballistic", 200)
    with pytest.raises(ConfigError, match="steps=any is unknown, expected one of match"):
        nnode.drive(run, steps="any", **options)


@pytest.mark.parametrize(
    ("name", "solver", "expected"),
    [
        ("idm", {}, Steps(0.1, "ballistic")),
        ("krauss", {}, Steps(0.1, "semi_implicit")),
        ("idm", {"dt": None}, Steps(0.1, "ballistic")),
        ("lin", {"dt": None}, Steps(0.002, "euler")),
        ("lin", {"dt": 0.2}, Steps(0.2, "euler")),
    ],
)
def test_steps_of_a_run(name: str, solver: dict[str, Any], expected: Steps, tmp_path: Path) -> None:
    checkpoint = load_checkpoint(run_of(tmp_path, name, **solver) / "checkpoints" / "best.pt")
    result = steps_of(checkpoint, checkpoint.build())
    assert (result.seconds, result.method) == (pytest.approx(expected.seconds), expected.method)


def test_unsuitable_runs_are_refused(tmp_path: Path) -> None:
    options: dict[str, Any] = {"sumo": tmp_path / "a.sumocfg", "vehicles": "car"}
    with pytest.raises(CheckpointError, match=r"no checkpoint .*best\.pt"):
        nnode.drive(tmp_path / "none", **options)
    with pytest.raises(ConfigError, match=r"one of people"):
        nnode.drive(run_of(tmp_path / "sf", "sf"), **options)
    with pytest.raises(ConfigError, match=r"leader_length needs longer"):
        nnode.drive(run_of(tmp_path / "l", "lin", {"leader_length": {"beta": 0.2}}), **options)
    with pytest.raises(ConfigError, match=r"rk4 steps of 0\.1 s, SUMO can make semi_implicit or"):
        nnode.drive(run_of(tmp_path / "rk", "idm", method="rk4"), steps="run", **options)


@pytest.mark.parametrize("with_length", [True, False])
def test_lengths_follow_the_training_data(with_length: bool, tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", "idm")
    checkpoint = load_checkpoint(run / "checkpoints" / "best.pt")
    with pytest.raises(ConfigError, match=r"run/data, are not there.*lengths=true"):
        _has_lengths(checkpoint, str(run), checkpoint.build())
    table = tidy(samples=20, agents=2)
    path = saved(tmp_path / "a.csv", table.assign(length=4.5) if with_length else table)
    prepare(TableOptions(domain="traffic", path=str(path)), run / "data")
    assert _has_lengths(checkpoint, str(run), checkpoint.build()) is with_length
    # a law without lengths needs no data
    assert _has_lengths(checkpoint, str(tmp_path), build_model(model_options("lin", "measured")))
