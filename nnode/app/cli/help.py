"""The text of ``--help`` for a command: purpose, examples, choices, options and flags.

Its sources are the command's docstring, the first comments of the files in ``conf/``, and the
comments at the fields of the options' dataclasses.
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

#: A dataclass's field with the comments above it and in its line.
_FIELD = re.compile(r"((?:^    # .*\n)*)^    (\w+): [^#\n]*(?:  # (.*))?$", re.MULTILINE)

#: Width of a line, and of the column of options.
WIDTH, LEFT = 100, 34

_FLAGS = {
    "-h, --help": "print this text; --help model=n4, for example, prints the options of a choice",
    "-m, --multirun": "run every combination of values, given as NAME=A,B",
    "--cfg job": "print the whole configuration and do nothing",
    "--config-dir FOLDER": "add the choices in FOLDER/GROUP/NAME.yaml",
    "--version": "print the version",
}


def help_text(name: str, config: DictConfig) -> str:
    """The help of a command.

    Args:
        name: name of the command.
        config: the composed configuration, including Hydra's part.
    """
    hydra = config.hydra
    folders = [Path(s.path) for s in hydra.runtime.config_sources if s.schema == "file"]
    choices = []
    for group, chosen in hydra.runtime.choices.items():
        if not group.startswith("hydra/"):
            about = {name: entries()[name]["about"] for name in LAW_MODELS if group == "model"}
            files = [path for folder in folders for path in (folder / group).glob("*.yaml")]
            about |= {path.stem: first_comment(path) for path in files}
            rows = [_row(f"{' *'[n == chosen]} {n}", text, 18) for n, text in sorted(about.items())]
            choices.append("\n".join([f"{group}=", *rows]))
    if choices:
        choices.insert(0, "Choices, GROUP=NAME; * marks the present choice")
    values = plain(OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"]))
    head = "Options, NAME=VALUE, with their present values; null means none"
    parts = [words(name), *choices, head, "\n".join(_options(config, values))]
    place = re.sub(r"\d{4}(-\d\d){2}_\d\d(-\d\d){2}", "TIME", hydra.run.dir)
    flags = {"hydra.run.dir=FOLDER": f"folder of the results; the default is {place}", **_FLAGS}
    parts.append("\n".join(["Running", *(_row(*flag) for flag in flags.items())]))
    return "\n\n".join(parts)


def first_comment(path: Path) -> str:
    """The first comment of the file of a choice."""
    comment = re.search(r"^# (?!@)(.*)", path.read_text(encoding="utf-8"), re.MULTILINE)
    return comment[1] if comment else ""


def _options(node: DictConfig, values: dict[str, Any], prefix: str = "") -> Iterator[str]:
    kind = OmegaConf.get_type(node)
    texts = remarks(kind) if is_dataclass(kind) else {}
    for key, value in values.items():
        if OmegaConf.is_missing(node, key):
            yield _row(f"{prefix}{key}=...", f"required: {texts.get(key, '')}")
        elif is_dataclass(OmegaConf.get_type(node, key)):
            yield from _options(node[key], value, f"{prefix}{key}.")
        else:
            yield _row(f"{prefix}{key}={literal(value)}", texts.get(key, ""))


def _row(left: str, right: str, size: int = LEFT) -> str:
    """Name and explanation in one line, or in two lines if the name is long."""
    lines = textwrap.wrap(right, WIDTH - size - 2, break_on_hyphens=False) or [""]
    head = f"  {left:<{size - 2}}" if len(left) < size - 2 else f"  {left}\n{'':<{size}}"
    return "\n".join([f"{head}{lines[0]}".rstrip(), *(f"{'':<{size}}{line}" for line in lines[1:])])


def remarks(schema: type) -> dict[str, str]:
    """Field of a dataclass to the comment in its line or above it, with the values of enums."""
    texts: dict[str, str] = {}
    for part in filter(is_dataclass, reversed(schema.__mro__)):
        for above, name, comment in _FIELD.findall(inspect.getsource(part)):
            if text := comment or " ".join(re.findall("# (.*)", above)):
                texts[name] = text
    for option in fields(schema):
        if isinstance(option.default, Enum):
            kind = type(option.default)
            valid = " | ".join(str(member.value) for member in kind)
            about = (inspect.getdoc(kind) or "").partition("\n")[0]
            texts[option.name] = f"{valid}: {texts.get(option.name, about)}"
    return texts
