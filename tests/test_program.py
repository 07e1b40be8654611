"""Command lines and the list of commands of the program."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from nnode import program
from nnode.__main__ import main

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("train", "nnode train model=lin 'data.path=my file.csv'"),
        ("fault_injection", "python scripts/fault_injection.py model=lin 'data.path=my file.csv'"),
        ("", "python scripts/fault_injection.py model=lin 'data.path=my file.csv'"),
    ],
)
def test_command_line(monkeypatch: pytest.MonkeyPatch, name: str, expected: str) -> None:
    monkeypatch.setattr(program, "_running", name)
    monkeypatch.setattr(
        sys, "argv", ["scripts/fault_injection.py", "model=lin", "data.path=my file.csv"]
    )
    assert program.command_line() == expected


def test_configuration_of_a_checkout() -> None:
    assert program.configuration() == ROOT / "conf"


def test_help_lists_commands(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scripts = {path.stem for path in (ROOT / "scripts").glob("*.py")}
    monkeypatch.setattr(sys, "argv", ["nnode", "--help"])
    main()
    lines = capsys.readouterr().out.splitlines()
    commands = {line.split()[0] for line in lines if line.startswith("  ")} & scripts
    assert commands == {path.stem for path in program.COMMANDS.glob("[a-z]*.py")}
    assert scripts - commands == {"benchmark", "benchmark_discovery", "fault_injection"}
    assert max(map(len, lines)) <= 100
