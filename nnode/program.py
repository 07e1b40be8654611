"""How a command is typed: a script of a checkout, or the installed program ``nnode``."""

from __future__ import annotations

import ast
import os
import re
import shlex
import sys
from itertools import pairwise
from pathlib import Path

#: The installed program.
PROGRAM = "nnode"

#: The installed commands: their files are read before they are imported, as that takes seconds.
COMMANDS = Path(__file__).parent / "app" / "commands"

#: Hydra's option for a folder of the user's own choices.
_CONFIG_DIR = ("--config-dir", "-cd")

#: Variable of the environment: the root of the checkout whose script runs.
_ROOT = "NNODE_SCRIPTS"

#: The command of the installed program that this process runs; None: a script, or neither.
_running: str | None = None


def running(name: str) -> None:
    """Note which command of the installed program this process runs."""
    global _running
    _running = name


def begin() -> None:
    """Note how this process was started, for itself and for the processes that it starts."""
    if _running is None:
        os.environ[_ROOT] = str(Path(sys.argv[0]).resolve().parent.parent)
    else:
        os.environ.pop(_ROOT, None)


def scripts() -> Path | None:
    """The root of the checkout whose script this process runs; None where it runs none."""
    root = os.environ.get(_ROOT)
    return None if root is None else Path(root)


def typed(text: str) -> str:
    """Words in which commands are written as scripts, with commands as this user types them."""
    if scripts() is not None:
        return text
    text = re.sub(r"(torchrun\s+\S+) scripts/(\w+)\.py", rf"\1 -m {PROGRAM} \2", text)
    return re.sub(r"python scripts/(\w+)\.py", rf"{PROGRAM} \1", text)


def command_line() -> str:
    """The command that started this process."""
    program = ["python", sys.argv[0]] if _running is None else [PROGRAM, _running]
    return shlex.join([*program, *sys.argv[1:]])


def configuration() -> Path:
    """The folder ``conf/``: beside the scripts, or as it was installed with the package."""
    root, package = scripts(), Path(__file__).parent
    installed = package / "conf"
    if root is not None:
        return root / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def own_choices(group: str) -> list[str]:
    """The same of the user's own folder, which the command line names with ``--config-dir``."""
    found = [after for word, after in pairwise(sys.argv) if word in _CONFIG_DIR]
    found += [w.partition("=")[2] for w in sys.argv if w.startswith(f"{_CONFIG_DIR[0]}=")]
    return sorted(path.stem for name in found for path in (Path(name) / group).glob("*.yaml"))


def words(name: str, conf: Path) -> str:
    """What a command does, with examples: its docstring, commands as this user types them.

    Args:
        conf: the folder ``conf/``; scripts that are not installed are beside it.
    """
    own = COMMANDS / f"{name}.py"
    path = own if own.is_file() else conf.parent / "scripts" / f"{name}.py"
    return typed(ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "")
