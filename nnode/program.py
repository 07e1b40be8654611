"""The program ``nnode``: its commands, their configuration, and the command that runs."""

from __future__ import annotations

import ast
import shlex
import sys
from itertools import pairwise
from pathlib import Path

#: The commands: their files are read before they are imported, because an import takes seconds.
COMMANDS = Path(__file__).parent / "app" / "commands"

#: Hydra's option for a folder of the user's own choices.
_CONFIG_DIR = ("--config-dir", "-cd")

#: The command that this process runs; empty: a program of somebody else.
_running = ""


def running(name: str) -> None:
    """Note which command this process runs."""
    global _running
    _running = name


def command_line() -> str:
    """The command that started this process, as it can be typed."""
    command = (COMMANDS / f"{_running}.py").is_file()
    program = ["nnode", _running] if command else ["python", sys.argv[0]]
    return shlex.join([*program, *sys.argv[1:]])


def configuration() -> Path:
    """The folder ``conf/``: in the installed package, or beside the package of a checkout."""
    package = Path(__file__).parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def own_choices(group: str) -> list[str]:
    """Names that a group has in the user's own folder, which ``--config-dir`` names."""
    found = [after for word, after in pairwise(sys.argv) if word in _CONFIG_DIR]
    found += [w.partition("=")[2] for w in sys.argv if w.startswith(f"{_CONFIG_DIR[0]}=")]
    return sorted(path.stem for name in found for path in (Path(name) / group).glob("*.yaml"))


def words(name: str) -> str:
    """What a command, or a script of the benchmarks, does, with examples: its docstring."""
    path = COMMANDS / f"{name}.py"
    if not path.is_file():
        path = configuration().parent / "scripts" / path.name
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
