"""Command lines compose, wrong ones are refused before work starts, and errors have a status."""

from __future__ import annotations

import os
import re
import shlex
import sys
from pathlib import Path

import pytest

from nnode.app.cli.typed import shell_override
from nnode.app.training import build_solver
from nnode.calibrate.options import FusedOptions
from nnode.errors import ConfigError
from nnode.solvers import FusedSolver
from tests.app.conftest import CONF, Script, composed


@pytest.mark.parametrize(
    "overrides",
    [
        ["model=n4", "model.hidden=7", "model.box=1.0", "model.leader=measured"],
        ["data.recording=[1-1_1,1-1_2]", "hydra.run.dir=/tmp/x"],
        ["model=lin,log,n2", "seed=range(3)"],
        ["model=sf", "data=hermes", "optimizer=adam", "optimizer.lr=0.1"],
        ["data=vehicles", "data.path='a, b.csv'", "data.columns={vehicle: id, x: pos}"],
        ["data=sumo", "data.path=fcd.xml.gz", "data.lane=e_0", "data.kinds={car: car}"],
        ["data=highd", "data.path=01_tracks.csv", "data.window=null"],
        ["model=sf", "data=jupedsim", "data.path=a.sqlite", "data.view=[1,9]"],
        ["model=sf", "data=pedpy", "data.path=a.txt", "data.geometry=a.wkt"],
        ["experiment=paper_traffic", "solver.dt=null"],
        ["solver=fused", "solver.cutoff=2.5", "solver.cutoff_error=1e-6"],
        ["hydra/launcher=cores", "hydra.launcher.n_jobs=2"],
        ["hydra/launcher=slurm", "hydra.launcher.partition=all"],
    ],
)
def test_right_options_compose(overrides: list[str]) -> None:
    composed("train", *overrides)


def test_a_mapping_takes_any_name() -> None:
    overrides = ["data=vehicles", "data.path=a.csv", "data.columns.time=t"]
    assert composed("train", *overrides).data.columns == {"time": "t"}


def test_every_choice_composes() -> None:
    # other commands have no group that this one does not have
    for group in composed("train").hydra.runtime.choices:
        for file in sorted((CONF / group).glob("*.yaml")):
            composed("train", f"{group}={file.stem}")


#: What is typed, what the answer has to contain, and the exit status.
WRONG = [
    # Hydra's own words
    ("train modle=lin", r"Could not override 'modle'", 1),
    ("train model=linn", r"Could not find 'model/linn'\s+Available options in 'model'", 1),
    ("train trainer.max_epoch=3", "Key 'max_epoch' not in 'TrainerOptions'", 1),
    ("train solver=fused solver.gradient=adjoint", "Key 'gradient' not in 'FusedOptions'", 1),
    ("train trainer.max_epochs=three", "'three' .* could not be converted to Integer", 1),
    ("train data.faults=kep", r"expected one of \[drop, keep, error\]", 1),
    ("train model=lin,log", "To sweep over it, add --multirun", 1),
    ("train --max_epochs=3", "unrecognized arguments: --max_epochs=3", 2),
    ("train --config-dir /nowhere", "'/nowhere' not found", 1),
    # the package's, each in one line
    ("export", "error: Missing mandatory value: run; type run=VALUE, --help shows examples\n$", 2),
    ("train data=table", "error: Missing mandatory value: data.domain; type data.domain=", 2),
    ("train mine.csv", "error: mine.csv is no option: expected NAME=VALUE, --help shows", 2),
    ("check a.csv b.csv", "error: b.csv is no option", 2),
    ("check none.csv", r"error: there is no file none.csv", 2),
    ("discover discover.alpha=2", "error: .*must lie between 0 and 1", 2),
    ("discover 'discover.effects=[inerta]'", r"did you mean inertia\?", 2),
    ("torture 'campaigns=[kill]'", "expected some of kills, disk, folder, fuzz", 2),
    ("benchmark_discovery 'benchmark_discovery.arms=[foo]'", "expected one of single, pair", 2),
    ("train data=table data.domain=traffic data.path=none.csv", "error: .*csv is not there", 1),
    ("train data=table data.domain=traffic data.path=$T/empty.csv", "is empty", 1),
    ("train data=table data.domain=traffic data.path=$T/odd.csv", "Expected 2 fields in line 3", 1),
    ("prepare_data data=sumo data.path=$T/junk.pt", "no whole XML document", 1),
    ("train resume=$T", "error: no checkpoint .*; it is a folder", 1),
    ("train resume=$T/junk.pt", "error: .*cannot be opened as a checkpoint", 1),
    ("plot_forces checkpoint=[]", "give one or more paths", 2),
    ("drive run=none sumo=a.sumocfg vehicles=car", "no checkpoint none/checkpoints/best.pt", 1),
    ("train hydra.run.dir=$T/head.csv", "error: .*cannot be used as a folder", 1),
    ("train -m seed=1,2 hydra.sweep.dir=$T/head.csv", "error: .*cannot be used as a folder", 1),
]  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "empty.csv").write_text("")
    (folder / "head.csv").write_text("sequence,time,agent,x\n")
    (folder / "odd.csv").write_text("sequence,time\n1,2\n3,4,5,6\n")
    (folder / "junk.pt").write_bytes(b"junk")
    return folder


@pytest.mark.skipif(not hasattr(os, "fork"), reason="starts many commands")
@pytest.mark.parametrize(("line", "words", "status"), WRONG, ids=[line for line, *_ in WRONG])
def test_a_wrong_command_is_answered_in_words(
    script: Script, files: Path, tmp_path: Path, line: str, words: str, status: int
) -> None:
    name, *arguments = shlex.split(line.replace("$T", str(files)))
    if "hydra." not in line:
        arguments.append(f"hydra.run.dir={tmp_path}")
    done = script(name, *arguments)
    assert re.search(words, done.stderr)
    assert done.returncode == status
    # Hydra hands errors on to a debugger, which a measurement of coverage is to it
    assert sys.gettrace() or "Traceback" not in done.stderr
    if done.stderr.startswith("error: "):
        assert done.stderr.count("\n") == 1


def test_a_file_that_may_not_be_read(script: Script, tmp_path: Path) -> None:
    """The superuser may read all, so the system's refusal is staged."""
    path = tmp_path / "shut.csv"
    path.write_text("sequence,time,agent,x\n0,0,a,0\n")
    code = f"""
import sys
from nnode.app.commands.train import main
from nnode.program import running
def shut(event, arguments):
    if event == "open" and arguments[0] == {str(path)!r}:
        raise PermissionError(13, "Permission denied", {str(path)!r})
sys.addaudithook(shut)
running("train")
main()
"""
    options = ["data=table", "data.domain=traffic", f"data.path={path}"]
    done = script(code, *options, f"hydra.run.dir={tmp_path / 'run'}")
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: {path} cannot be read")
    assert "Permission denied" in done.stderr


def test_what_is_shown_in_place_of_working(script: Script) -> None:
    assert "hidden: 4" in script("train", "--cfg", "job", "model=n4", "-p", "model").stdout
    assert re.fullmatch(r"nnode \d+\.\d+\.\d+\n", script("train", "--version").stdout)


def test_the_fused_solver_gets_its_options() -> None:
    solver = build_solver(
        FusedOptions(dt=0.01, threads=2, cutoff=2.5, cutoff_error=1e-6, method="ballistic")
    )
    assert isinstance(solver, FusedSolver)
    given = {"dt": 0.01, "threads": 2, "cutoff": 2.5, "cutoff_error": 1e-6}
    assert vars(solver) == {**given, "method": "ballistic", "uncompiled": ""}
    with pytest.raises(ConfigError, match=r"solver\.cutoff_error=2 must be"):
        build_solver(FusedOptions(cutoff_error=2))


def test_what_is_printed_can_be_pasted_into_a_shell() -> None:
    for place in ("runs/a/last.pt", "/tmp/a folder/it's/last.pt", "a,b=[c]/x.pt"):
        assert composed("train", *shlex.split(shell_override("resume", place))).resume == place
