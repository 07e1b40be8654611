"""``nnode discover`` with substituted results, and commands that take the extended model."""

from __future__ import annotations

import dataclasses
import json
import re
import signal
import time
from html import unescape
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import nnode
from nnode.app import discover as app
from nnode.app.python.inputs import data_of, model_options
from nnode.app.python.report import Report
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.diagnosis import diagnose, thresholds
from nnode.diagnosis.inputs import inputs_of
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.report import page
from nnode.errors import ConfigError
from nnode.model import System
from tests.app.conftest import Script, composed, read_json
from tests.app.forked import Forks
from tests.diagnosis import stand_in
from tests.diagnosis.recorded import ALPHA, ZONE, corridor, lane

#: The command with substituted results.
CODE = """
import sys
from nnode.app import discover
from nnode.app.cli.run import run
from nnode.diagnosis import diagnose
from tests.diagnosis import stand_in
if __name__ == "__main__":
    diagnose.diagnose_law = stand_in.diagnose
    run("discover", discover.discover)
"""


def overrides(table: Path, folder: Path) -> list[str]:
    return [
        "model=lin",
        "model.leader=measured",
        "data=table",
        f"data.path={table}",
        "data.domain=traffic",
        f"hydra.run.dir={folder}",
        "discover.confirmation=0.4",
        "discover.compare=[idm]",
    ]


#: The same, then the commands that take its model, in one process because imports are slow.
CHAIN = """
import runpy
import shutil
import sys
from pathlib import Path
from nnode.app import discover
from nnode.app.cli.run import run
from nnode.diagnosis import diagnose
from tests.diagnosis import stand_in

def script(name, *arguments):
    sys.argv = [f"scripts/{name}.py", *arguments]
    runpy.run_path(sys.argv[0], run_name="__main__")

if __name__ == "__main__":
    folder, *overrides = sys.argv[1:]
    sys.argv[1:] = overrides
    diagnose.diagnose_law = stand_in.diagnose
    run("discover", discover.discover)
    checkpoint = f"checkpoint={folder}/run/checkpoints/best.pt"
    print("== evaluate")
    script("evaluate", checkpoint, "solver.dt=0.02", f"hydra.run.dir={folder}/evaluate")
    print("== plot_forces")
    script("plot_forces", checkpoint, f"hydra.run.dir={folder}/forces")
    print("== train")
    models = Path(folder, "conf", "model")
    models.mkdir(parents=True)
    shutil.copy(f"{folder}/run/model.yaml", models / "lin_with_speed_zone.yaml")
    script(
        "train", "--config-dir", f"{folder}/conf", "model=lin_with_speed_zone",
        "solver.dt=0.02", "data=table", f"data.path={folder}/lane.csv", "data.domain=traffic",
        "trainer.max_epochs=1", f"hydra.run.dir={folder}/train",
    )
"""


def faulty_lane(path: Path) -> Path:
    """A table in which a vehicle of the first sequence jumps after 3 s."""
    frame = pd.read_csv(lane(path, sequences=6, seconds=4.0, cars=3))
    frame.loc[(frame["agent"] == "v0-1") & (frame["time"] > 3), "x"] += 40
    frame.to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def run(script: Script, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a diagnosis of a table with one faulty sequence."""
    folder = tmp_path_factory.mktemp("discover")
    options = overrides(faulty_lane(folder / "lane.csv"), folder / "run")
    done = script(CHAIN, str(folder), *options, "discover.replay=false")
    (folder / "run" / "shown.txt").write_text(done.stdout.partition("== evaluate")[0])
    return folder / "run"


def test_command_prints_verdict_and_paths(run: Path) -> None:
    shown = (run / "shown.txt").read_text()
    assert "verdict: named" in shown
    assert "The model lin lacks speed_zone" in shown
    assert "  speed_zone: alpha = 0.650 [0.627, 0.680], a = 400.0 [392.0, 400.0] m" in shown
    assert "not distinguishable from speed_period without platoons at other times" in shown
    for label, name in (
        ("report", "report.json"),
        ("page", "report.html"),
        ("extended model", "model.yaml"),
        ("checkpoint", "checkpoints/best.pt"),
    ):
        assert f"{label}: {run / name}" in shown.splitlines()
        assert (run / name).is_file()
    assert not list(run.rglob(".*.tmp")) + [p for p in run.iterdir() if p.name.startswith(".r")]


def test_report_has_faults_and_commands(run: Path) -> None:
    report = read_json(run / "report.json")
    assert report["model"] == "lin"
    assert report["verdict"] == "named"
    fault = report["data_faults"][0]
    assert fault["sequence"] == "lane/0"
    assert "v0-1" in fault["agents"]
    assert fault["time"] == pytest.approx(3.2)
    assert "lane/0" not in report["split"]["exploration"] + report["split"]["confirmation"]
    assert report["seconds"]["reading"] > 0
    page = unescape((run / "report.html").read_text())
    assert f"nnode evaluate checkpoint={run / 'checkpoints' / 'best.pt'}" in page
    assert (
        f"mkdir -p conf/model && cp {run / 'model.yaml'} conf/model/lin_with_speed_zone.yaml"
        in page
    )
    (train,) = re.findall(r"nnode train --config-dir conf model=lin_with_speed_zone data=t.*", page)
    assert "data.domain=traffic" in train
    assert f"data.path={run.parent / 'lane.csv'}" in train


def test_checkpoint_is_evaluated_on_confirmation_data(run: Path) -> None:
    metrics = read_json(run.parent / "evaluate" / "metrics.json")
    report = read_json(run / "report.json")
    assert metrics["part"] == "heldout"
    assert metrics["trained_on"] == 0
    assert sorted(metrics["costs"]) == sorted(report["split"]["confirmation"])
    assert metrics["parameters"]["speed_zone.alpha"] == pytest.approx(0.65)
    # both are mean square errors of followers; the steps differ
    assert metrics["rmse"] ** 2 == pytest.approx(report["gap"]["after"], rel=0.2)


def test_plot_forces_takes_the_checkpoint(run: Path) -> None:
    forces = run.parent / "forces"
    assert (forces / "forces.png").stat().st_size > 10_000
    assert list(pd.read_csv(forces / "forces.csv"))[-1] == "lin_with_speed_zone"


def test_model_yaml_starts_training_from_the_estimates(run: Path) -> None:
    start = read_json(run.parent / "train" / "result.json")["history"][0]
    assert start["parameters/speed_zone.alpha"] == pytest.approx(0.65)
    assert start["parameters/speed_zone.a"] == pytest.approx(ZONE[0])
    checkpoint = load_checkpoint(run.parent / "train" / "checkpoints" / "last.pt")
    assert checkpoint.history[-1]["parameters/speed_zone.alpha"] != 0.65


@pytest.mark.slow
def test_training_resumes_with_exploration_data(script: Script, run: Path, tmp_path: Path) -> None:
    resume = f"resume={run / 'checkpoints' / 'best.pt'}"
    script("train", resume, "trainer.max_epochs=1", folder=tmp_path)
    before = load_checkpoint(run / "checkpoints" / "best.pt")
    after = load_checkpoint(tmp_path / "checkpoints" / "last.pt")
    report = read_json(run / "report.json")
    assert after.split["heldout"] == before.split["heldout"] == report["split"]["confirmation"]
    assert after.split["train"] == report["split"]["exploration"]
    assert after.history[0]["parameters/speed_zone.alpha"] == pytest.approx(0.65)


def test_signal_leaves_no_partial_report(forks: Forks, run: Path, tmp_path: Path) -> None:
    started = tmp_path / "started"
    options = overrides(run.parent / "lane.csv", tmp_path / "run")
    process = forks.start(CODE, *options, **{stand_in.WAIT: str(started)})
    while process.poll() is None and not started.exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, errors
    assert "stopped by SIGTERM: the diagnosis was not finished and nothing of it" in errors
    assert "Traceback" not in errors
    assert {p.name for p in (tmp_path / "run").iterdir()} <= {
        "data",
        ".hydra",
        ".lock",
        "discover.log",
    }


def test_effects_on_the_command_line() -> None:
    effects = composed("train", "model.effects=[{name: relative_speed, kappa: 0.3}]").model.effects
    assert effects == [{"name": "relative_speed", "kappa": 0.3}]


@pytest.mark.parametrize(
    ("model", "effects", "message"),
    [
        ({"term": "social_force"}, None, "model=social_force is a crowd model, data=table are"),
        ({"term": "lin"}, ["relative_sped"], r"no traffic effect relative_sped.*relative_speed\?"),
        ({"term": "linn"}, None, r"model\.term=linn is unknown"),
        ({}, None, r"model\.term= is unknown"),
        ({"term": "lin", "w0": 3}, None, "w0"),
        ({"term": "lin", "v0": "fast"}, None, "v0|fast"),
    ],
)
def test_wrong_options_are_refused_before_reading(
    tmp_path: Path, model: dict[str, Any], effects: list[str] | None, message: str
) -> None:
    table = tmp_path / "one_vehicle.csv"  # invalid data
    table.write_text("sequence,time,agent,x\n0,0,a,0\n0,1,a,9\n")
    options = DiscoverOptions(effects=effects)
    with pytest.raises(ConfigError, match=message):
        app.diagnose_table(table, "traffic", model=model, options=options)


@pytest.fixture
def substituted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Substituted results; drawing fails the test."""
    monkeypatch.setattr(diagnose, "diagnose_law", stand_in.diagnose)

    monkeypatch.setattr(page, "draw", lambda *_: pytest.fail("a page was drawn"))


def lin_diagnosed(folder: Path) -> Report:
    """The diagnosis of the linear law without a page; the law is compared with the IDM."""
    table = lane(folder / "lane.csv", sequences=4, seconds=3.0, cars=3)
    options = DiscoverOptions(page=False, compare=["idm"])
    return app.diagnose_table(
        table, "traffic", model={"term": "lin"}, folder=folder / "run", options=options
    )


@pytest.mark.usefixtures("substituted")
def test_configuration_group_may_have_another_name_than_the_model(tmp_path: Path) -> None:
    data = nnode.sequences(
        lane(tmp_path / "lane.csv", sequences=4, seconds=3.0, cars=3), domain="traffic"
    )
    groups = {"model": "lin", "data": "table"}
    model = {**model_options("lin", "measured"), "name": "mine"}
    ((job, outcome),) = app._diagnoses(
        model,
        data_of(data),
        {},
        groups,
        DiscoverOptions(compare=[]),
        lambda: inputs_of(data, data_of(data)),
    )
    assert job.groups == groups
    assert outcome.diagnosis.model == job.model["name"] == "mine"


@pytest.mark.usefixtures("substituted")
def test_without_a_folder_no_file_is_written(tmp_path: Path, monkeypatch) -> None:
    table, walls = corridor(tmp_path / "walk.csv", sequences=4, seconds=2.0, people=4)
    before = sorted(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    report = app.diagnose_table(
        table,
        "crowd",
        model={"term": "social_force", "B": 0.3, "walls": False},
        walls=walls,
        seed=3,
        options=DiscoverOptions(compare=[]),
    ).plain()
    assert report["verdict"] == "named"
    assert report["model"] == "social_force"
    assert report["effects"][0]["coefficients"]["w_y"]["value"] == pytest.approx(0.35)
    assert sorted(tmp_path.iterdir()) == before
    json.dumps(report, allow_nan=False)


@pytest.mark.thorough
@pytest.mark.usefixtures("substituted")
def test_better_fitting_law_is_diagnosed_as_well(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(diagnose, "with_effects", lambda laws, effects: laws)
    monkeypatch.setattr(thresholds, "STRICT", 0.5)
    report = lin_diagnosed(tmp_path)
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert report.nearest is not None
    assert report.nearest.diagnosis.model == "idm"
    assert report.nearest.diagnosis.laws is None
    nearest = read_json(tmp_path / "run" / "nearest_law" / "report.json")
    assert nearest == report.nearest.plain()
    report = report.plain()
    assert [law["name"] for law in report["laws"]["ranking"]] == ["idm", "lin"]
    assert report["laws"]["nearest"] == "idm"
    assert names == {"checkpoints", "model.yaml", "report.json", "nearest_law"}
    assert read_json(tmp_path / "run" / "report.json") == report
    assert load_checkpoint(tmp_path / "run" / "checkpoints" / "best.pt").config["seed"] == 0


@pytest.mark.thorough
@pytest.mark.usefixtures("substituted")
def test_law_that_is_not_rejected_is_diagnosed_alone(tmp_path: Path) -> None:
    report = lin_diagnosed(tmp_path)
    laws = report.plain()["laws"]
    assert laws["ranking"][0]["name"] == "idm"
    assert laws["ranking"][1]["p_value"] > 0.01
    assert laws["nearest"] == "lin"
    assert "fits best" not in report.summary()
    assert report.diagnosis.model == "lin"
    assert report.nearest is None


@pytest.mark.thorough
@pytest.mark.usefixtures("substituted")
@pytest.mark.parametrize("imitated", [False, True])
def test_laws_are_compared_again_with_the_effect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, imitated: bool
) -> None:
    """Without the zone, the IDM fits best. With it, lin does, also where the IDM imitates the zone
    and therefore needs no effect."""

    def diagnose_law(system: System, *arguments: Any, **options: Any) -> DiagnosisOutcome:
        outcome = stand_in.diagnose(system, *arguments, **options)
        if imitated and system.order > 1:
            return dataclasses.replace(outcome, searched=system)
        return outcome

    monkeypatch.setattr(diagnose, "diagnose_law", diagnose_law)
    monkeypatch.setattr(thresholds, "STRICT", 0.5)
    monkeypatch.setattr(thresholds, "LEVEL", 0.5)
    report = lin_diagnosed(tmp_path)
    assert report.nearest is None
    first, repeated = report.diagnosis.laws, report.diagnosis.laws_again
    assert first is not None
    assert repeated is not None
    assert (first.best, first.effects) == ("idm", [])
    assert (repeated.best, repeated.effects) == ("lin", ["speed_zone"])
    assert repeated.ranking[1].behind > 0


@pytest.mark.usefixtures("substituted")
def test_faulty_sequences_are_reported_and_left_out(tmp_path: Path) -> None:
    table, options = faulty_lane(tmp_path / "lane.csv"), DiscoverOptions(compare=[])
    report = app.diagnose_table(table, "traffic", model={"term": "lin"}, options=options).plain()
    assert report["verdict"] == "named"
    faults = [(fault["sequence"], *fault["agents"]) for fault in report["data_faults"]]
    assert ("lane/0", "v0-1") in {fault[:2] for fault in faults}
    assert "lane/0" not in report["split"]["exploration"] + report["split"]["confirmation"]


@pytest.mark.slow
def test_simulated_speed_zone_is_named(tmp_path: Path) -> None:
    table = lane(tmp_path / "lane.csv", sequences=12, seconds=20.0, cars=6)
    report = app.diagnose_table(
        table,
        "traffic",
        model={"term": "lin"},
        folder=tmp_path / "run",
        options=DiscoverOptions(effects=["speed_zone", "relative_speed"]),
    ).plain()
    assert report["verdict"] == "named"
    (effect,) = report["effects"]
    assert effect["name"] == "speed_zone"
    assert effect["coefficients"]["alpha"]["value"] == pytest.approx(ALPHA, abs=0.02)
    assert effect["coefficients"]["a"]["value"] == pytest.approx(ZONE[0], abs=3)
    assert effect["coefficients"]["b"]["value"] == pytest.approx(ZONE[1], abs=3)
    assert report["gap"]["closed"] > 0.98
    assert (tmp_path / "run" / "report.html").is_file()
