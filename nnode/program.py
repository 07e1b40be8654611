"""The program ``nnode``: its commands, their configuration, and the command that runs."""

from __future__ import annotations

import ast
import shlex
import sys
from itertools import pairwise
from pathlib import Path

#: Folder of the commands. Their files are read without an import, which would take seconds.
COMMANDS = Path(__file__).parent / "app" / "commands"

#: Hydra's flag for a folder with further choices of the user.
_CONFIG_DIR = ("--config-dir", "-cd")

#: The command of this process; empty in other programs.
_running = ""


def running(name: str) -> None:
    """Set the command of this process."""
    global _running
    _running = name


def command_line() -> str:
    """The command that started this process, as it can be typed."""
    command = (COMMANDS / f"{_running}.py").is_file()
    program = ["nnode", _running] if command else ["python", sys.argv[0]]
    return shlex.join([*program, *sys.argv[1:]])


def configuration() -> Path:
    """The folder ``conf/`` in the installed package, or next to the package in a checkout."""
    package = Path(__file__).parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def own_choices(group: str) -> list[str]:
    """Names of a group in the folder of the user that ``--config-dir`` states."""
    folders = [after for word, after in pairwise(sys.argv) if word in _CONFIG_DIR]
    folders += [w.partition("=")[2] for w in sys.argv if w.startswith(f"{_CONFIG_DIR[0]}=")]
    return sorted(path.stem for folder in folders for path in (Path(folder) / group).glob("*.yaml"))


def words(name: str) -> str:
    """The purpose and examples of a command or of a benchmark's script: its docstring."""
    path = COMMANDS / f"{name}.py"
    if not path.is_file():
        path = configuration().parent / "scripts" / path.name
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
