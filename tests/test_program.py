"""Commands are told as this user types them."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from nnode import program
from nnode.__main__ import main
from nnode.discover.report.files import model_yaml

ROOT = Path(__file__).parents[1]
TEXT = "python scripts/train.py x=1; torchrun --nproc-per-node=2 scripts/train.py y=2"


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "_running", "train")
    monkeypatch.setattr(sys, "argv", ["/usr/bin/nnode", "model=lin", "data.path=my file.csv"])
    monkeypatch.setenv("NNODE_SCRIPTS", "/of/an/earlier/script")
    program.begin()


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "conf", tmp_path / "conf")
    monkeypatch.setattr(sys, "argv", [str(tmp_path / "scripts" / "train.py"), "model=lin"])
    monkeypatch.setenv("NNODE_SCRIPTS", "")  # taken back at the end
    program.begin()
    return tmp_path


@pytest.mark.usefixtures("installed")
def test_the_installed_program() -> None:
    told = "nnode train x=1; torchrun --nproc-per-node=2 -m nnode train y=2"
    assert program.typed(TEXT) == told
    assert program.command_line() == "nnode train model=lin 'data.path=my file.csv'"
    assert program.configuration() == ROOT / "conf"
    assert "then: --config-dir conf model=m\n" in model_yaml({"name": "m", "term": "lin"}, False)


def test_a_script_takes_the_configuration_beside_it(script: Path) -> None:
    assert program.typed(TEXT) == TEXT
    assert program.command_line() == f"python {script}/scripts/train.py model=lin"
    assert program.configuration() == script / "conf"
    assert "then: model=m\n" in model_yaml({"name": "m", "term": "lin"}, False)


def test_a_program_of_somebody_else_is_no_script_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NNODE_SCRIPTS", raising=False)
    monkeypatch.setattr(sys, "argv", ["/home/me/scripts/train.py"])
    assert program.typed(TEXT).startswith("nnode train x=1")
    assert program.configuration() == ROOT / "conf"


def test_the_program_lists_its_commands(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scripts = {path.stem for path in (ROOT / "scripts").glob("*.py")}
    monkeypatch.setattr(sys, "argv", ["nnode", "--help"])
    main()
    said = capsys.readouterr().out
    commands = {line.split()[0] for line in said.splitlines() if line.startswith("  ")} & scripts
    assert commands == {path.stem for path in program.COMMANDS.glob("[a-z]*.py")}
    assert scripts - commands == {"benchmark", "benchmark_discovery", "torture"}
    assert max(len(line) for line in said.splitlines()) <= 100
    monkeypatch.setattr(sys, "argv", ["nnode", "discovr"])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert "did you mean discover?" in capsys.readouterr().err
