"""Wrong command lines of every script: one line that says what to do, and a status of its own."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from benchmarks.config import register
from benchmarks.torture.child import Child, script
from nnode.app.cli.run import check_overrides
from tests.app.conftest import ROOT

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that can fork")


def typed(name: str, arguments: list[str]) -> None:
    """What a child does; its streams are the process's, and not those of the test."""
    sys.stdout, sys.stderr = open(1, "w"), open(2, "w")  # noqa: SIM115
    script(ROOT, name, arguments)


Run = Callable[[str], tuple[int, str]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Run a command line in a forked child, which shares the loaded libraries."""
    import nnode.app.discover
    import nnode.app.drive
    import nnode.app.evaluate
    import nnode.app.export
    import nnode.app.forces
    import nnode.app.study  # noqa: F401

    register()
    check_overrides([], ROOT / "conf", "train")  # the children share what Hydra looks up once
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "folder").mkdir()
    (folder / "empty.csv").write_text("")
    (folder / "head.csv").write_text("sequence,time,agent,x\n")
    (folder / "odd.csv").write_text("sequence,time\n1,2\n3,4,5,6\n")
    (folder / "junk.pt").write_bytes(b"junk")

    def run(line: str) -> tuple[int, str]:
        name, *arguments = shlex.split(line.replace("$T", str(folder)))
        if not any("hydra." in a or a.startswith("-") for a in arguments):
            arguments.append(f"hydra.run.dir={folder / 'run'}")
        place = folder / "said"
        child = Child(partial(typed, name, arguments), place)
        status = child.status(60)
        child.kill()
        assert status is not None, f"{line} was not refused:\n{place.read_text()}"
        return status, place.read_text()

    return run


#: What is typed, and what the answer has to contain.
WRONG = [
    # names
    ("train modle=lin", "did you mean model?"),
    ("train model=linn", "did you mean lin?"),
    ("train model=null", "expected one of a2, a4, a10, cfsm, esf, formula, fvdm"),
    ("train optimizer=sgd", "expected one of adadelta, adam, cbo, gauss_newton, lbfgs"),
    ("train experiment=demo", "did you mean demo_crowd?"),
    ("train experiment=[demo_traffic,paper_traffic]", "expected one of demo_crowd"),
    (
        "train experiment=demo_crowd solver=fused",
        "experiment=demo_crowd does not go with the other choices: Key 'gradient'",
    ),
    ("train study=traffic", "this script has no study= to choose"),
    ("evaluate model=lin", "this script has no model= to choose, it has data=, solver="),
    ("train trainer.foo=1", "option trainer.foo is unknown (trainer has: max_epochs"),
    ("train model=lin model.hidden=3", "hidden belongs to model=n2, n4, n10, nn"),
    ("train model.v0.x=3", "model.v0 is one value, set it with model.v0=VALUE"),
    ("prepare_data dta=esimas", "did you mean data?"),
    ("evaluate chekpoint=x.pt", "did you mean checkpoint?"),
    ("study study.worker=3", "did you mean study.workers?"),
    ("discover discover.alhpa=0.1", "did you mean discover.alpha?"),
    ("train hydra.run.dri=x", "did you mean hydra.run.dir?"),
    ("train hydra/launcher=foo", "expected one of basic, cores"),
    # values
    ("train seed=1.5", "seed=1.5 is refused: expected a whole number"),
    ("train seed=null", "seed=null is refused: expected a value"),
    ("train trainer.max_epochs=three", "expected a whole number"),
    ("train trainer=5", "trainer is a group of options; set one of them: trainer.max_epochs="),
    ("train data.loader.shuffle=perhaps", "expected true or false"),
    ("train data.faults=kep", "expected one of drop, keep, error; did you mean keep?"),
    ("plot_forces checkpoint=a.pt extent=big", "no checkpoint a.pt"),
    ("plot_forces extent=big", "extent=big is refused: expected a number"),
    ("evaluate 'checkpoint=[$T/junk.pt]'", "junk.pt cannot be opened as a checkpoint"),
    ("discover discover.effects=inertia", "expected a list, written [a,b]"),
    ("discover discover.effects=[inerta]", "did you mean inertia?"),
    ("discover discover.alpha=2", "must lie between 0 and 1"),
    ("discover model=sf", "model=sf is a crowd model, data=esimas are traffic data"),
    ("torture campaigns=kills", "expected a list, written [a,b]"),
    ("torture campaigns=[kill]", "expected some of kills, disk, folder, fuzz"),
    ("benchmark benchmark.shapes=[foo]", "expected some of paper, stress"),
    ("benchmark_discovery benchmark_discovery.arms=[foo]", "expected one of single, pair"),
    ("train solver.method=rk5", "expected one of adaptive_heun"),
    # how it is written
    ("train model", "model has no value; options are written name=value"),
    ("train model = lin", "without blanks around the equals sign, as model="),
    ("train model =lin", "without blanks around the equals sign, as model=lin"),
    ("train model= lin", "without blanks around the equals sign, as model=lin"),
    ("train =lin", "cannot read '=lin'"),
    ("train seed=", "seed= has no value"),
    ("evaluate checkpoint=", "checkpoint= has no value"),
    ("train hydra.run.dir=", "hydra.run.dir= has no value"),
    ("evaluate $T/junk.pt", "such as checkpoint=FILE"),
    ("train +x=1", "option x is unknown"),
    ("train ++trainer.x=1", "option trainer.x is unknown"),
    ("train ~seed", "~seed: an option cannot be deleted"),
    ("train ~model", "choices are neither added nor deleted"),
    ("train +experiment=demo_traffic", "write experiment=NAME"),
    ("train data.recording=[1-1_1", "a [ or ] is missing"),
    ("train data.recording={a:1", "a { or } is missing"),
    ('train "data.recording=\'1-1_1"', "a quotation mark is missing"),
    ("train seed=1 ++seed=2", "seed is given twice: seed=1 and ++seed=2"),
    ("train model=lin model=log", "model is given twice"),
    # sweeps and flags
    ("train model=lin,log", "names several values; add -m for a run with each"),
    ("train data=table data.path=a,b.csv", "or quote the comma: \"data.path='a,b.csv'\""),
    ("train -m model=lin,foo", "model=foo is unknown"),
    ("train -m 'seed=range(0)'", "names no value at all"),
    ("train --max_epochs=3", "options are written without dashes, as max_epochs=3"),
    ("train --mutlirun seed=1,2", "did you mean --multirun?"),
    ("train --cfg", "--cfg needs a value behind it: job, hydra, all"),
    ("train --cfg foo", "expected one of job, hydra, all"),
    ("train --cfg job trainer.max_epoch=1", "did you mean trainer.max_epochs?"),
    ("train --resolve", "only goes with --cfg"),
    ("train --config-dir /nowhere", "there is no folder /nowhere"),
    ("train --config-name foo", "--config-name is not taken"),
    ("train --help modle=lin", "did you mean model?"),
    # files
    ("train data=table", "data.domain is not set; give it a value with data.domain=..."),
    ("export", "run is not set"),
    ("drive", "run is not set"),
    ("drive run=$T sumo=a.sumocfg", "vehicles is not set"),
    ("train data=table data.domain=traffic data.path=none.csv", "none.csv is not there"),
    ("train data=table data.domain=traffic data.path=$T/folder", "is a folder, expected a file"),
    ("train data=table data.domain=traffic data.path=$T/empty.csv", "is empty"),
    ("train data=table data.domain=traffic data.path=$T/head.csv", "has no rows"),
    ("train data=table data.domain=traffic data.path=$T/odd.csv", "Expected 2 fields in line 3"),
    ("prepare_data data=sumo data.path=$T/junk.pt", "no whole XML document"),
    ("train resume=$T/folder", "it is a folder, expected a file *.pt"),
    ("train resume=$T/junk.pt", "cannot be opened as a checkpoint"),
    ("export run=none", "no checkpoint none/checkpoints/best.pt"),
    ("drive run=none sumo=a.sumocfg vehicles=car", "no checkpoint none/checkpoints/best.pt"),
    ("plot_forces checkpoint=[]", "give one or more paths"),
    ("train data.source=/nowhere", "there is no folder /nowhere"),
    ("train hydra.run.dir=$T/head.csv", "cannot be used as a folder"),
    ("train -m seed=1,2 hydra.sweep.dir=$T/head.csv", "cannot be used as a folder"),
]


@pytest.mark.parametrize(("line", "words"), WRONG, ids=[line for line, _ in WRONG])
def test_a_wrong_command_is_answered_in_one_line(run: Run, line: str, words: str) -> None:
    status, said = run(line)
    assert status in (1, 2)
    assert said.startswith("error: ")
    assert words in said
    assert said.count("\n") == 1, "more than one line"
    assert not re.search(r"Traceback|HYDRA_FULL_ERROR|Hydra|\w+Error\b", said)


def test_a_file_that_may_not_be_read(run: Run, tmp_path: Path) -> None:
    """Readers give the system's reason; the superuser may read all, so the refusal is staged."""
    path = tmp_path / "shut.csv"
    path.write_text("sequence,time,agent,x\n0,0,a,0\n")

    def shut(event: str, arguments: tuple[object, ...]) -> None:
        if event == "open" and arguments[0] == str(path):
            raise PermissionError(13, "Permission denied", str(path))

    def work() -> None:
        sys.addaudithook(shut)
        options = ["data=table", "data.domain=traffic", f"data.path={path}"]
        typed("train", [*options, f"hydra.run.dir={tmp_path / 'run'}"])

    child = Child(work, tmp_path / "said")
    assert child.status(60) == 1
    said = (tmp_path / "said").read_text()
    assert said.startswith(f"error: {path} cannot be read")
    assert "Permission denied" in said
    assert said.count("\n") == 1


def test_what_is_shown_in_place_of_working(run: Run) -> None:
    status, said = run("train --cfg job model=n4 -p model")
    assert status == 0, said
    assert "hidden: 4" in said
    status, said = run("train --version")
    assert status == 0, said
    assert re.fullmatch(r"nnode \d+\.\d+\.\d+\n", said)
