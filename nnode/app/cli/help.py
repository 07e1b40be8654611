"""What ``--help`` behind a command prints: purpose, examples, choices, options, where results go.

Nothing is written twice: the words are the command's docstring, the first comments of the files
in ``conf/``, and the comments beside the fields of the options' dataclasses.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.saved import plain
from nnode.app.cli.typed import literal
from nnode.model.laws import LAW_MODELS, entries
from nnode.program import words

#: A dataclass's field with the comments above it and beside it.
_FIELD = re.compile(r"((?:^    # .*\n)*)^    (\w+): [^#\n]*(?:  # (.*))?$", re.MULTILINE)

#: Characters of a line, and those before what explains an option.
WIDTH, LEFT = 100, 34

_FLAGS = {
    "-h, --help": "this text; with choices, such as --help model=n4, the options of those",
    "-m, --multirun": "a run for every combination of values given as NAME=A,B",
    "--cfg job": "print the whole configuration and do nothing",
    "--config-dir FOLDER": "take further choices from FOLDER/GROUP/NAME.yaml",
    "--version": "print the version",
}


def help_text(name: str, *, _root_: DictConfig) -> str:
    """The help of a command, as a template of Hydra's.

    Args:
        _root_: the composed configuration, Hydra's part with it.
    """
    hydra = _root_.hydra
    folders = [Path(s.path) for s in hydra.runtime.config_sources if s.schema == "file"]
    choices = []
    for group, chosen in hydra.runtime.choices.items():
        if not group.startswith("hydra/"):
            about = {name: entries()[name]["about"] for name in LAW_MODELS if group == "model"}
            files = [path for folder in folders for path in (folder / group).glob("*.yaml")]
            about |= {path.stem: said_of(path) for path in files}
            rows = [_row(f"{' *'[n == chosen]} {n}", said, 18) for n, said in sorted(about.items())]
            choices.append("\n".join([f"{group}=", *rows]))
    if choices:
        choices.insert(0, "Choices, GROUP=NAME; those with * are taken now")
    config = OmegaConf.masked_copy(_root_, [str(key) for key in _root_ if key != "hydra"])
    head = "Options, NAME=VALUE, with their values now; null means none"
    parts = [words(name), *choices, head, "\n".join(_options(_root_, plain(config)))]
    place = re.sub(r"\d{4}(-\d\d){2}_\d\d(-\d\d){2}", "TIME", hydra.run.dir)
    flags = {"hydra.run.dir=FOLDER": f"folder of the results; without it {place}", **_FLAGS}
    parts.append("\n".join(["Running", *(_row(*flag) for flag in flags.items())]))
    return "\n\n".join(parts).replace("$", "$$")


def said_of(path: Path) -> str:
    """The first comment of a choice's file."""
    found = re.search(r"^# (?!@)(.*)", path.read_text(encoding="utf-8"), re.MULTILINE)
    return found[1] if found else ""


def _options(node: DictConfig, values: dict[str, Any], prefix: str = "") -> Iterator[str]:
    kind = OmegaConf.get_type(node)
    said = remarks(kind) if is_dataclass(kind) else {}
    for key, value in values.items():
        if OmegaConf.is_missing(node, key):
            yield _row(f"{prefix}{key}=...", f"must be given: {said.get(key, '')}")
        elif is_dataclass(OmegaConf.get_type(node, key)):
            yield from _options(node[key], value, f"{prefix}{key}.")
        else:
            yield _row(f"{prefix}{key}={literal(value)}", said.get(key, ""))


def _row(left: str, right: str, size: int = LEFT) -> str:
    """Name and explanation side by side, or below each other where the name is long."""
    lines = textwrap.wrap(right, WIDTH - size - 2, break_on_hyphens=False) or [""]
    head = f"  {left:<{size - 2}}" if len(left) < size - 2 else f"  {left}\n{'':<{size}}"
    return "\n".join([f"{head}{lines[0]}".rstrip(), *(f"{'':<{size}}{line}" for line in lines[1:])])


def remarks(schema: type) -> dict[str, str]:
    """What the comments beside, or above, a dataclass's fields say; choices of enums with it."""
    found: dict[str, str] = {}
    for part in filter(is_dataclass, reversed(schema.__mro__)):
        for above, name, beside in _FIELD.findall(inspect.getsource(part)):
            if said := beside or " ".join(re.findall("# (.*)", above)):
                found[name] = said
    for one in fields(schema):
        if isinstance(one.default, Enum):
            kind = type(one.default)
            valid = " | ".join(str(member.value) for member in kind)
            about = (inspect.getdoc(kind) or "").partition("\n")[0]
            found[one.name] = f"{valid}: {found.get(one.name, about)}"
    return found
