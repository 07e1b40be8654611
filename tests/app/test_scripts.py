"""Commands from end to end on synthetic recordings in the raw formats."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

import pandas as pd
import pytest
import torch

from nnode.calibrate.checkpoint import load_checkpoint
from tests.app.conftest import ROOT, Script, background, read_json


def files_outside(folder: Path) -> set[Path]:
    """Files in the repository's folders of runs and data."""
    return {p for name in ("runs", "data") for p in (ROOT / name).rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def traffic(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished training on synthetic traffic."""
    folder = tmp_path_factory.mktemp("run") / "traffic"
    before = files_outside(folder)
    # in a new Python process, as a user starts it
    process = background("experiment=demo_traffic", f"data.source={raw}", f"hydra.run.dir={folder}")
    output, errors = process.communicate(timeout=1500)
    assert process.returncode == 0, errors
    assert files_outside(folder) == before
    for name in ("tensorboard", "checkpoints/best.pt", "checkpoints/last.pt"):
        assert str(folder / name) in output
        assert (folder / name).exists()
    return folder


def test_training_recovers_the_parameters(traffic: Path) -> None:
    result = read_json(traffic / "result.json")["summary"]
    # true values: v0 = 25 m/s, L = 6 m; noise 0.05 m; Euler steps of 0.02 s
    assert result["lin.v0"] == pytest.approx(25, abs=0.1)
    assert result["lin.L"] == pytest.approx(6, abs=0.1)
    assert result["cost_train"] < 0.01 * result["cost_start"]
    assert result["cost_heldout"] < 0.01 * result["cost_start"]


def test_evaluation_agrees_with_training_and_beats_baselines(
    script: Script, traffic: Path, raw: Path, tmp_path: Path
) -> None:
    best = traffic / "checkpoints" / "best.pt"
    script("evaluate", f"checkpoint={best}", folder=tmp_path)
    metrics = read_json(tmp_path / "metrics.json")
    result = read_json(traffic / "result.json")["summary"]
    assert metrics["part"] == "heldout"
    page = (tmp_path / "replay.html").read_text(encoding="utf-8")
    assert page.count('"measured":[') == metrics["sequences"]
    assert metrics["J"] == pytest.approx(result["cost_heldout"], rel=1e-12)
    for baseline in metrics["baselines"].values():
        assert metrics["J"] < baseline["J"]
        assert metrics["rmse"] < baseline["rmse"]
    script(
        "evaluate",
        f"checkpoint={best}",
        "data=demo_traffic",
        f"data.source={raw}",
        "data.faults=keep",
        folder=tmp_path / "all",
    )
    everything = read_json(tmp_path / "all" / "metrics.json")
    assert everything["part"] == "heldout"  # the split of the checkpoint, for the same files
    assert everything["J"] == metrics["J"]  # the files have no faults


@pytest.mark.thorough
def test_plot_forces_of_two_checkpoints(script: Script, traffic: Path, tmp_path: Path) -> None:
    paths = ",".join(str(traffic / "checkpoints" / name) for name in ("best.pt", "last.pt"))
    script("plot_forces", f"checkpoint=[{paths}]", folder=tmp_path)
    assert (tmp_path / "forces.png").stat().st_size > 10_000
    assert len(pd.read_csv(tmp_path / "forces.csv")) > 10


@pytest.mark.thorough
def test_crowd_from_raw_data_to_plots(script: Script, raw: Path, tmp_path: Path) -> None:
    run = tmp_path / "crowd"
    options = ("experiment=demo_crowd", "model=sf", "trainer.max_epochs=2", f"data.source={raw}")
    script("train", *options, folder=run)
    best = run / "checkpoints" / "best.pt"
    script("plot_forces", f"checkpoint=[{best}]", folder=tmp_path / "plots")
    names = {p.name for p in (tmp_path / "plots").glob("sf_*")}
    assert names == {"sf_force_x.png", "sf_force_y.png", "sf_settings.png", "sf_settings.csv"}


@pytest.mark.parametrize(
    ("stops", "epochs"),
    [
        pytest.param(2, 12, marks=pytest.mark.thorough),
        pytest.param(10, 40, marks=pytest.mark.slow),
    ],
)
def test_interrupted_and_resumed_run_is_bit_identical(
    raw: Path, tmp_path: Path, stops: int, epochs: int
) -> None:
    """SIGTERM and SIGKILL alternate at random times."""
    common = [
        "experiment=demo_traffic",
        "model=n2",
        "optimizer=adadelta",
        f"trainer.max_epochs={epochs}",
        "trainer.save_every=0.1",
        f"data.source={raw}",
    ]
    uninterrupted, resumed = tmp_path / "uninterrupted", tmp_path / "resumed"
    done = background(*common, f"hydra.run.dir={uninterrupted}")
    _, errors = done.communicate(timeout=300)
    assert done.returncode == 0, errors
    rng, arguments = random.Random(0), [*common, f"hydra.run.dir={resumed}"]
    last = resumed / "checkpoints" / "last.pt"
    for stop in range(stops):
        process = background(*arguments)
        # wait for this process's first checkpoint and then for a random time
        before = last.stat().st_mtime_ns if last.exists() else 0
        while process.poll() is None and (not last.exists() or last.stat().st_mtime_ns == before):
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.15))
        kill = stop % 2 == 1
        process.send_signal(signal.SIGKILL if kill else signal.SIGTERM)
        _, errors = process.communicate(timeout=60)
        assert process.returncode == (-signal.SIGKILL if kill else 128 + signal.SIGTERM), errors
        arguments = [f"resume={last}", f"data.source={raw}", f"hydra.run.dir={resumed}"]
        if not kill:
            assert f"resume={last} hydra.run.dir={resumed}" in errors
    done = background(*arguments)
    _, errors = done.communicate(timeout=300)
    assert done.returncode == 0, errors
    for name in ("last.pt", "best.pt"):
        a = load_checkpoint(uninterrupted / "checkpoints" / name)
        b = load_checkpoint(resumed / "checkpoints" / name)
        assert a.model.keys() == b.model.keys()
        assert all(torch.equal(a.model[key], b.model[key]) for key in a.model)
        assert a.history == b.history


def test_resume_refuses_changed_options(script: Script, traffic: Path, tmp_path: Path) -> None:
    last = traffic / "checkpoints" / "last.pt"
    for change in ("model=n4", "seed=5"):
        done = script("train", f"resume={last}", change, folder=tmp_path, status=2)
        assert "cannot change when a run is resumed" in done.stderr
    assert os.path.exists(last)


@pytest.mark.thorough
def test_resume_and_evaluate_accept_sweeps(script: Script, traffic: Path, tmp_path: Path) -> None:
    best, last = (traffic / "checkpoints" / name for name in ("best.pt", "last.pt"))
    for name, overrides in (
        ("train", [f"resume={last}", "trainer.max_epochs=7,8"]),
        ("evaluate", [f"checkpoint={best},{last}"]),
    ):
        script(name, "-m", *overrides, f"hydra.sweep.dir={tmp_path / name}")
        assert {p.name for p in (tmp_path / name).iterdir() if p.is_dir()} == {"0", "1"}


@pytest.mark.thorough
def test_evaluation_counts_training_sequences(
    script: Script, traffic: Path, tmp_path: Path
) -> None:
    best = traffic / "checkpoints" / "best.pt"
    training = len(load_checkpoint(best).split["train"])
    for part, trained_on in (("heldout", 0), ("train", training), ("all", training)):
        run = tmp_path / part
        script("evaluate", f"checkpoint={best}", f"part={part}", folder=run)
        metrics = read_json(run / "metrics.json")
        assert metrics["trained_on"] == trained_on
        assert metrics["sequences"] >= metrics["trained_on"]


#: A user's effect that cannot be compiled.
USER_EFFECT = """
import torch
from nnode.model.effects import CATALOGUE, Effect, Strength
from nnode.model.term import Interval

@CATALOGUE.add
class Draught(Effect):
    name = "draught"
    domain = "crowd"
    formula = "+ (c, 0)"
    source = "none"
    strengths = {"c": Strength(neutral=0.0, step=0.1, range=Interval(-1.0, 1.0), unit="m/s²")}

    def forward(self, state):
        return torch.stack([self.c, 0 * self.c]).expand_as(state.x)
"""


@pytest.mark.thorough
def test_uncompiled_run_is_reported(script: Script, raw: Path, tmp_path: Path) -> None:
    (tmp_path / "draught.py").write_text(USER_EFFECT)
    done = script(
        "train",
        "data=demo_crowd",
        "model=sf",
        "solver=fused",
        "model.effects=[draught]",
        "trainer.max_epochs=0",
        f"data.source={raw}",
        folder=tmp_path,
        NNODE_EFFECTS=str(tmp_path / "draught.py"),
    )
    solver = read_json(tmp_path / "result.json")["solver"]
    assert solver == {"name": "fused", "uncompiled": "it does not cover draught"}
    assert (done.stdout + done.stderr).count("in PyTorch and not in compiled code") == 1
