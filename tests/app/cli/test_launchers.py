"""Training in several processes, and launchers of sweeps."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from omegaconf import OmegaConf

from nnode.app.cli import runs
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.files import write_json
from tests.app.conftest import Script, background, composed
from tests.app.forked import Forks

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
#: 32 sequences in 5 mini-batches, 4 epochs: 20 steps of the paper's stochastic descent.
PROBLEM = (
    "experiment=demo_traffic",
    "model=n4",
    "optimizer=adadelta",
    "data.loader.batch_size=7",
    "trainer.max_epochs=4",
    "trainer.figure_every=0",
    "solver.dt=0.1",
)


@pytest.fixture(scope="module")
def prepared(script: Script, raw: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The option that selects prepared traffic data."""
    folder = tmp_path_factory.mktemp("prepared")
    script("prepare_data", "data=demo_traffic", f"data.source={raw}", folder=folder)
    return f"data.prepared={folder}"


@pytest.fixture(scope="module")
def alone(script: Script, prepared: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training in a single process."""
    folder = tmp_path_factory.mktemp("alone")
    script("train", *PROBLEM, prepared, folder=folder)
    return folder


def problem(*changes: str) -> list[str]:
    """The options of `PROBLEM` with changes and additions."""
    names = {change.partition("=")[0] for change in changes}
    return [*(option for option in PROBLEM if option.partition("=")[0] not in names), *changes]


def start(*overrides: str, temporary: Path) -> subprocess.Popen[str]:
    """A training in two processes, which put temporary files into ``temporary``."""
    temporary.mkdir(exist_ok=True)
    program = [*TORCHRUN, "-m", "nnode", "train"]
    return background(*overrides, program=program, TMPDIR=str(temporary))


def difference(a: Path, b: Path) -> float:
    """The largest difference between the final parameters of two runs."""
    first, second = (load_checkpoint(p / "checkpoints" / "last.pt") for p in (a, b))
    assert first.progress["step"] == second.progress["step"] == 20
    return max(float((first.model[k] - second.model[k]).abs().max()) for k in first.model)


@pytest.mark.thorough
def test_two_processes_train_as_one(alone: Path, prepared: str, tmp_path: Path) -> None:
    run, temporary = tmp_path / "run", tmp_path / "tmp"
    process = start(*PROBLEM, prepared, f"hydra.run.dir={run}", temporary=temporary)
    out, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    assert difference(alone, run) < 1e-6
    assert out.count("best checkpoint:") == 1
    assert out.count("sequences train") == 1
    assert {p.name for p in run.iterdir()} == {p.name for p in alone.iterdir()}
    assert not list(temporary.glob("nnode-*"))  # the second process removed its files


@pytest.mark.thorough
def test_two_processes_stop_and_one_resumes(script: Script, prepared: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    last = run / "checkpoints" / "last.pt"
    # long enough to be interrupted
    options = problem("trainer.max_epochs=100000", "trainer.save_every=0", prepared)
    process = start(*options, f"hydra.run.dir={run}", temporary=tmp_path / "tmp")
    while not last.exists() and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=200)
    assert process.returncode != 0
    assert errors.count("everything up to here is in") == 1
    saved = load_checkpoint(last)
    end = saved.progress["epoch"] + 1
    script("train", f"resume={last}", f"trainer.max_epochs={end}", folder=run)
    assert load_checkpoint(last).progress["epoch"] == end


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("override", "message", "status"),
    [
        ("resume=none.pt", "error: no checkpoint none.pt", 1),  # before the work starts
        ("solver.dt=0.03", "error: solver.dt=0.03 s does not divide", 2),  # with the data
    ],
)
def test_error_is_printed_once(
    forks: Forks, prepared: str, tmp_path: Path, override: str, message: str, status: int
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    environment = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2"}
    options = (*problem(override), prepared, f"hydra.run.dir={tmp_path / 'run'}")
    processes = [
        forks.start("train", *options, **environment, RANK=rank, LOCAL_RANK=rank) for rank in "01"
    ]
    errors = [process.communicate()[1] for process in processes]
    assert [process.returncode for process in processes] == [status, status]
    assert "".join(errors).count(message) == 1


@pytest.mark.thorough
@pytest.mark.parametrize("launcher", ["basic", "cores", "submitit_local"])
def test_sweep_continues_after_a_failed_run(
    script: Script, prepared: str, tmp_path: Path, launcher: str
) -> None:
    done = script(
        "train",
        "-m",
        f"hydra/launcher={launcher}",
        *PROBLEM[:1],
        prepared,
        "optimizer=adadelta",
        "solver.dt=0.03,0.02",
        "trainer.max_epochs=1",
        f"hydra.sweep.dir={tmp_path}",
        status=1,  # the first run cannot work
    )
    table = pd.read_csv(tmp_path / "sweep.csv")
    assert table["model"].tolist()[1] == "lin"
    assert table["error"].str.contains("does not divide").tolist()[0] is True
    assert "sweep.csv" in done.stdout


def test_failures_of_an_earlier_sweep_are_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "_sweep", {})  # forked commands inherit this state
    config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}})
    failed = {"error": "of an earlier sweep"}
    for job in ("0", "1"):
        write_json(tmp_path / job / "result.json", failed)
    callback = runs.Runs()
    callback.on_multirun_start(config)
    assert runs.failures() == []
    write_json(tmp_path / "0" / "result.json", {"summary": {"model": "lin"}})
    assert runs.failures() == []
    for job in ("1", "a/b"):
        write_json(tmp_path / job / "result.json", {"error": "of this one"})
    assert runs.failures() == [tmp_path / "1", tmp_path / "a" / "b"]
    callback.on_multirun_end(config)
    assert pd.read_csv(tmp_path / "sweep.csv")["model"].tolist()[0] == "lin"


def test_slurm_launcher_settings() -> None:
    settings = composed("train", "hydra/launcher=slurm").hydra.launcher
    assert settings._target_.endswith("submitit_launcher.SlurmLauncher")
    assert settings.cpus_per_task == 1
    assert settings.max_num_timeout == 0
