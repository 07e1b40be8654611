"""Every option is checked before work starts, and errors name the nearest valid one."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from nnode.app.cli.flags import read_command_line
from nnode.app.cli.run import check_overrides
from nnode.app.cli.typed import shell_override
from nnode.app.training import build_solver
from nnode.calibrate.options import FusedOptions
from nnode.config import register
from nnode.errors import ConfigError
from nnode.solvers import FusedSolver

CONF = Path(__file__).resolve().parents[3] / "conf"


@pytest.fixture(autouse=True, scope="module")
def _schemas() -> None:
    register()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["trainer.max_epoch=3"], "did you mean trainer.max_epochs"),
        (["modle=lin"], "did you mean model"),
        (["trainr.max_epochs=3"], r"did you mean trainer\.max_epochs"),
        (["~trainer.patience"], "cannot be deleted"),
        (["model=n5"], "expected one of a2, a4, a10, cfsm, esf, formula, fvdm"),
        (["model=lin_schema"], "model=lin_schema is unknown"),
        (["model.hidden=3"], "option model.hidden is unknown"),
        (["model=n4", "model.hiden=3"], "did you mean model.hidden"),
        (["trainer.max_epochs=three"], "expected a whole number"),
        (["data.faults=kep"], "expected one of drop, keep, error; did you mean keep"),
        (["data.split.heldout=abc"], "expected a number"),
        (["+trainer.extra=1"], "option trainer.extra is unknown"),
        (["solver=fused", "solver.gradient=adjoint"], "option solver.gradient is unknown"),
        (["solver=fused", "solver.cutoff=far"], "expected a number"),
        (["solver.gradient=exact"], "expected one of adjoint, discrete"),
        (["model=lin,n5"], "model=n5 is unknown"),
        (["seed=1,two"], "seed=two is refused"),
        (["data.recording=[1-1_1"], r"a \[ or \] is missing"),
    ],
)
def test_a_wrong_option_is_refused_in_words(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_overrides(overrides, CONF, "train")


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["model=n4", "model.hidden=7", "model.box=1.0", "model.leader=measured"],
        ["data.recording=1-1_1"],
        ["data.recording=[1-1_1,1-1_2]", "hydra.run.dir=/tmp/x"],
        ["model=lin,log,n2", "seed=1,2,3"],
        ["model=sf", "data=hermes", "optimizer=adam", "optimizer.lr=0.1", "seed=range(3)"],
        ["data=vehicles", "data.path='a, b.csv'", "data.columns={vehicle: id, x: pos}"],
        ["data=sumo", "data.path=fcd.xml.gz", "data.lane=e_0", "data.kinds={car: car}"],
        ["data=highd", "data.path=01_tracks.csv", "data.window=null"],
        ["model=sf", "data=jupedsim", "data.path=a.sqlite", "data.view=[1,9]"],
        ["model=sf", "data=pedpy", "data.path=a.txt", "data.geometry=a.wkt"],
        ["experiment=paper_traffic", "solver.dt=null"],
        ["solver=fused", "solver.cutoff=2.5"],
        ["solver=fused", "solver.cutoff=null", "solver.cutoff_error=1e-6"],
    ],
)
def test_right_options_pass(overrides: list[str]) -> None:
    check_overrides(overrides, CONF, "train")


@pytest.mark.parametrize("name", ["train", "prepare_data", "evaluate", "plot_forces", "export"])
def test_every_group_of_every_script_composes(name: str) -> None:
    for group in ("model", "data", "optimizer", "solver", "experiment"):
        for file in sorted((CONF / group).glob("*.yaml")):
            if name == "train" or group == "data":
                check_overrides([f"{group}={file.stem}"], CONF, name)


def test_the_fused_solver_gets_its_options() -> None:
    solver = build_solver(
        FusedOptions(dt=0.01, threads=2, cutoff=2.5, cutoff_error=1e-6, method="ballistic")
    )
    assert isinstance(solver, FusedSolver)
    given = {"dt": 0.01, "threads": 2, "cutoff": 2.5, "cutoff_error": 1e-6}
    assert vars(solver) == {**given, "method": "ballistic", "uncompiled": ""}
    with pytest.raises(ConfigError, match=r"solver\.cutoff_error=2 must be"):
        build_solver(FusedOptions(cutoff_error=2))


def test_flags_are_told_from_overrides() -> None:
    line = read_command_line(["-m", "model=lin,log", "-c", "job", "seed=1", "--package=model"])
    assert line.overrides == ["model=lin,log", "seed=1"]
    assert line.flags == {"--multirun": "", "--cfg": "job", "--package": "model"}
    assert line.sweeps


@pytest.mark.parametrize("place", ["runs/a/last.pt", "/tmp/a folder/it's/last.pt", "a,b=[c]/x.pt"])
def test_overrides_can_be_pasted_into_a_shell(place: str) -> None:
    typed = shlex.split(shell_override("resume", place))
    (override,) = OverridesParser.create().parse_overrides(typed)
    value = override.value()
    assert getattr(value, "text", value) == place
