"""Commands are typed in one form, whatever started them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from nnode import program
from nnode.__main__ import main

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("name", "typed"),
    [
        ("train", "nnode train model=lin 'data.path=my file.csv'"),
        ("fault_injection", "python scripts/fault_injection.py model=lin 'data.path=my file.csv'"),
        ("", "python scripts/fault_injection.py model=lin 'data.path=my file.csv'"),
    ],
)
def test_the_command_that_runs(monkeypatch: pytest.MonkeyPatch, name: str, typed: str) -> None:
    monkeypatch.setattr(program, "_running", name)
    monkeypatch.setattr(
        sys, "argv", ["scripts/fault_injection.py", "model=lin", "data.path=my file.csv"]
    )
    assert program.command_line() == typed


def test_a_checkout_has_its_configuration_beside_the_package() -> None:
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
    assert scripts - commands == {"benchmark", "benchmark_discovery", "fault_injection"}
    assert max(len(line) for line in said.splitlines()) <= 100
