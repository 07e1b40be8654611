"""Valid command lines compose; invalid ones give one error line and an exit status."""

from __future__ import annotations

import re
import shlex
from itertools import zip_longest
from pathlib import Path

import pytest

from nnode.__main__ import main as program
from nnode.app.training import build_solver
from nnode.calibrate.options import FusedOptions
from nnode.errors import ConfigError
from nnode.simulation import FusedSolver
from tests.app.conftest import CONF, Script, composed


@pytest.mark.thorough
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
def test_valid_options_compose(overrides: list[str]) -> None:
    composed("train", *overrides)


def test_mapping_option_accepts_any_key() -> None:
    overrides = ["data=vehicles", "data.path=a.csv", "data.columns.time=t"]
    assert composed("train", *overrides).data.columns == {"time": "t"}


def test_every_choice_composes() -> None:
    # Other commands have no further groups. Experiments choose groups themselves.
    groups = composed("train").hydra.runtime.choices
    files = {group: sorted((CONF / group).glob("*.yaml")) for group in groups}
    for experiment in files.pop("experiment"):
        composed("train", f"experiment={experiment.stem}")
    for choices in zip_longest(
        *([f"{g}={path.stem}" for path in paths] for g, paths in files.items())
    ):
        composed("train", *filter(None, choices))


VEHICLES = "data=vehicles 'data.columns={vehicle: vehicle, time: time, x: x}'"
#: Command line, pattern of the error message, and exit status (2 if absent).
WRONG = [
    # unknown names, with a suggestion
    ("train modle=lin", r"train has no option modle; did you mean model\? train has model, "),
    ("train model=linn", r"no model=linn; did you mean model=lin\? model is one of a10, "),
    ("train -m model=lin,idmm", r"no model=idmm; did you mean model=idm\? model is one of"),
    ("train model=", "no model=; model is one of a10, "),
    ("train ~model", "error: model is missing; type model=VALUE"),
    ("train data=esimass", r"did you mean data=esimas\? data is one of"),
    ("train data=mine.csv", "no data=mine.csv; .*nnode check mine.csv prints the options"),
    ("train data=table data.pth=x", r"did you mean data.path\? data has name, "),
    ("train solver=fusd", r"did you mean solver=fused\? solver is one of fused, torchdiffeq\n"),
    ("train optimizer=lbgfs", r"did you mean optimizer=lbfgs\?"),
    (
        "train experiment=paper",
        r"no experiment=paper; did you mean experiment=paper_.*\? experiment is one of demo_",
    ),
    ("train -m hydra/launcher=core", r"did you mean hydra/launcher=cores\? .* one of basic, co"),
    ("study study=trafic", r"did you mean study=traffic\? study is one of crowd, .*, walking"),
    ("study study.quik=true", r"did you mean study.quick\?"),
    ("train trainer.max_epoch=3", r"did you mean trainer.max_epochs\? trainer has max_epochs, "),
    ("train +trainer.max_epoch=3", r"did you mean trainer.max_epochs\? trainer has max_ep"),
    ("train ~trainer.max_epoch", r"did you mean trainer.max_epochs\? trainer has max_epochs, "),
    ("train max_epoch=3", r"no option max_epoch; did you mean trainer.max_epochs\?"),
    ("train max_epochs=3", r"no option max_epochs; did you mean trainer.max_epochs\?"),
    ("train device=gpu", r"no option device; did you mean trainer.device\?"),
    ("train +x=1", "train has no option x; train has model, "),
    ("train ++x=1", "train has no option x; train has model, "),
    ("train ~x", "train has no option x; train has model, "),
    ("train @model=lin", "train has no option @model"),
    ("train +solver=fused", "solver is chosen twice; type solver=NAME once"),
    ("train solver=fused solver.gradient=adjoint", "solver has name, dt, method"),
    ("train solver.nosuch.deep=1", "solver has name, dt, method"),
    ("train data.split.heldot=0", r"did you mean data.split.heldout\?"),
    ("train hydra.rundir=DIR", r"did you mean hydra.run\?"),
    ("discover discover.alfa=0.1", r"did you mean discover.alpha\?"),
    ("evaluate checkpoints=a.pt", r"did you mean checkpoint\?"),
    ("export runs=a", r"did you mean run\?"),
    ("drive run=a sumo=b vehicle=c", r"did you mean vehicles\?"),
    ("check fil=3", r"did you mean file\?"),
    ("prepare_data data=vehicle", r"did you mean data=vehicles\?"),
    # parameters of a law
    ("train model=idm model.T=3", r"5 s: type \"model.law.parameters.T.value='3 s'"),
    ("train model=idm +model.T=3", r"type \"model.law.parameters.T.value='3 s'"),
    ("train model=idm model.T=-3", r"at least 0.05 s and at most 5 s; -3 is not"),
    ("train model=idm model.law.parameters.T.value=-3", "has value -3, low .*, such as '3 s'"),
    (
        "train model=idm model.law.parameters.T=-3",
        r"parameters.T=-3: T .* at least 0.05 s and at most 5 s; -3 is not: type .*T.value='1.2 s'",
    ),
    ("train model=idm data=esimas solver.method=eulerr", r"did you mean euler\?"),
    # invalid values and syntax
    ("train trainer.max_epochs=three", "trainer.max_epochs=three: expected a whole number"),
    ("train seed=abc", "seed=abc: expected a whole number"),
    ("train seed.x=1", "seed.x=1: seed is a value, without options of its own"),
    ("train data.split.heldout=many", "expected a number"),
    ("discover discover.compare=lin", r"expected a list, such as \[lin\]"),
    ("train solver=fused seed=null", "null is no value of this option"),
    ("study study.quick=maybe", "expected true or false"),
    ("train trainer=3", "trainer has options of its own: max_epochs, "),
    ("train data.faults=kep", r"expected one of drop, keep, error; did you mean keep\?"),
    ("train model=lin,log", "add -m for a run with each"),
    ("train 'model=[lin'", "cannot be read: expected NAME=VALUE"),
    ("train 'seed={a:1'", "cannot be read: expected NAME=VALUE"),
    ("train 'model=${x}'", r"Error resolving interpolation '\$\{x\}'; --help"),
    ("train 'seed=${oc.env:NOPE}'", "Environment variable 'NOPE' not found"),
    ("train =3", "=3 names no option"),
    ("train --max_epochs=3", "options have no dashes; type max_epochs=3"),
    ("train --mulitrun model=lin,log", r"did you mean --multirun\?"),
    ("train --foo", "there is no flag --foo; --help shows all options and flags"),
    ("train --config-name=foo", "options have no dashes"),
    ("train --shell-completion", "there is no flag --shell-completion"),
    ("train --cfg jobs", r"argument -c/--cfg: .* \(choose from 'job', 'hydra', 'all'\)"),
    ("train --config-dir /nowhere", "--config-dir /nowhere: there is no such folder"),
    # missing arguments, unreadable files
    ("export", "error: run is missing; type run=VALUE, --help shows examples\n$"),
    ("train data=table", "error: data.domain is missing; type data.domain=VALUE"),
    ("train mine.csv", "error: mine.csv is no option: expected NAME=VALUE, --help shows"),
    ("check a.csv b.csv", "error: b.csv is no option"),
    ("check none.csv", r"error: there is no file none.csv"),
    ("check", "file is missing; type file=VALUE"),
    ("check $T", "is a folder; name one of its files"),
    ("check $T/junk.pt", "is no text", 1),
    ("check $T/junk.pt domain=sea", "domain=sea: expected traffic, crowd, or null"),
    ("check $T/junk.pt frame_rate=-1", "frame_rate=-1.0: expected a positive number"),
    ("discover discover.alpha=2", "error: .*must lie between 0 and 1"),
    ("discover 'discover.effects=[inerta]'", r"did you mean inertia\?"),
    ("fault_injection 'campaigns=[kill]'", "expected some of kills, disk, folder, fuzz"),
    ("benchmark_discovery 'benchmark_discovery.arms=[foo]'", "expected one of single, pair"),
    (
        "train data=table data.domain=traffic data.path=none.csv trainer.drivers=atuo",
        r"trainer.drivers=atuo is unknown, .* did you mean auto\?",
    ),
    ("train data=table data.domain=traffic data.path=none.csv", "error: .*csv is not there", 1),
    ("train data=table data.domain=traffic data.path=$T/empty.csv", "is empty", 1),
    ("train data=table data.domain=traffic data.path=$T/odd.csv", "Expected 2 fields in line 3", 1),
    ("train data=table data.domain=traffic data.path=$T/nan.csv", "gap_in_time in 1", 1),
    (f"train {VEHICLES} data.path=$T/names.csv", "names.csv has no column 'vehicle'", 1),
    (f"train {VEHICLES} data.path=$T/text.csv", "text.csv, line 26: .* 'far'", 1),
    (f"train {VEHICLES} data.path=$T/one.csv", "vehicle", 1),
    ("train data=demo_traffic data.source=$T/cut", "sequence_datademo.mat", 1),
    ("train data=demo_traffic data.source=$T/raw data.recording=demo2", "demo2", 2),
    ("train data=demo_traffic data.source=$T/raw solver.dt=0.003", r"solver.dt.* 0\.2 s"),
    ("prepare_data data=sumo data.path=$T/junk.pt", "no whole XML document", 1),
    ("train resume=$T", "error: no checkpoint .*; it is a folder", 1),
    ("train resume=$T/junk.pt", "error: .*cannot be opened as a checkpoint", 1),
    ("plot_forces checkpoint=[]", "give one or more paths"),
    ("drive run=none sumo=a.sumocfg vehicles=car", "no checkpoint none/checkpoints/best.pt", 1),
    ("train hydra.run.dir=$T/head.csv", "error: .*cannot be used as a folder", 1),
    ("train -m seed=1,2 hydra.sweep.dir=$T/head.csv", "error: .*cannot be used as a folder", 1),
    ("train hydra.run.dir=/proc/none", "error: the folder /proc/none cannot be made", 1),
    ("train -m seed=1,2 hydra.sweep.dir=/proc/none", "/proc/none cannot be made: .*sweep.dir=", 1),
]

#: Words of Hydra, OmegaConf and Python that no message contains.
INTERNAL = (
    *("Traceback", "_schema", "HYDRA_FULL_ERROR", "search path", "Options'", "hydra.cc"),
    *("possible interpolation", "raised while", "mandatory", "full_key", "ListConfig"),
    "DictConfig",
)


@pytest.fixture(scope="module")
def files(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "raw").symlink_to(raw)
    rows = "".join(f"{v},{0.2 * k:.1f},{30 * v + 5 * k}\n" for v in range(4) for k in range(6))
    (folder / "text.csv").write_text(f"vehicle,time,x\n{rows}3,1.2,far\n")
    (folder / "one.csv").write_text(f"vehicle,time,x\n{rows.partition('1,')[0]}")
    (folder / "names.csv").write_text("car,when,where\n1,0,0\n")
    (folder / "nan.csv").write_text("sequence,time,agent,x\na,0,1,0\na,0,2,9\na,1,1,nan\n")
    (folder / "cut" / "esimas").mkdir(parents=True)
    whole = raw / "esimas" / "sequence_datademo.mat"
    (folder / "cut" / "esimas" / whole.name).write_bytes(whole.read_bytes()[:2000])
    (folder / "empty.csv").write_text("")
    (folder / "head.csv").write_text("sequence,time,agent,x\n")
    (folder / "odd.csv").write_text("sequence,time\n1,2\n3,4,5,6\n")
    (folder / "junk.pt").write_bytes(bytes(range(256)))
    return folder


@pytest.mark.parametrize(
    ("line", "words", "status"),
    [(*row, 2)[:3] for row in WRONG],
    ids=[line for line, *_ in WRONG],
)
def test_invalid_command_gives_one_error_line(
    script: Script, files: Path, tmp_path: Path, line: str, words: str, status: int
) -> None:
    name, *arguments = shlex.split(line.replace("$T", str(files)))
    if "hydra." not in line:
        arguments += [f"hydra.run.dir={tmp_path}", f"hydra.sweep.dir={tmp_path}"]
    done = script(name, *arguments, status=status)
    assert re.search(words, done.stderr)
    for word in INTERNAL:
        assert word not in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert len(done.stderr) < 2000
    assert not (tmp_path / "checkpoints").exists()


def test_file_without_read_permission(script: Script, tmp_path: Path) -> None:
    """The system's refusal is simulated because the superuser may read every file."""
    path = tmp_path / "protected.csv"
    path.write_text("sequence,time,agent,x\n0,0,a,0\n")
    code = f"""
import sys
from nnode.app.commands.train import main
def refuse(event, arguments):
    if event == "open" and arguments[0] == {str(path)!r}:
        raise PermissionError(13, "Permission denied", {str(path)!r})
sys.addaudithook(refuse)
main()
"""
    options = ["data=table", "data.domain=traffic", f"data.path={path}"]
    done = script(code, *options, folder=tmp_path / "run", status=1)
    assert done.stderr.startswith(f"error: {path} cannot be read")
    assert "Permission denied" in done.stderr


def test_configuration_and_version_are_printed(script: Script) -> None:
    assert "hidden: 4" in script("train", "--cfg", "job", "model=n4", "-p", "model").stdout
    assert re.fullmatch(r"nnode \d+\.\d+\.\d+\n", script("train", "--version").stdout)


def test_fused_solver_receives_its_options() -> None:
    options = {"dt": 0.01, "threads": 2, "cutoff": 2.5, "cutoff_error": 1e-6, "method": "ballistic"}
    solver = build_solver(FusedOptions(**options))
    assert isinstance(solver, FusedSolver)
    assert vars(solver) == {**options, "uncompiled": ""}
    with pytest.raises(ConfigError, match=r"solver\.cutoff_error=2 must be"):
        build_solver(FusedOptions(cutoff_error=2))


@pytest.mark.parametrize(
    ("typed", "meant"), [("diagnose", "discover"), ("fit", "train"), ("dicover", "discover")]
)
def test_unknown_command_gets_a_suggestion(
    typed: str, meant: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["nnode", typed])
    with pytest.raises(SystemExit, match="2"):
        program()
    assert capsys.readouterr().err.endswith(f"did you mean {meant}?\n")
