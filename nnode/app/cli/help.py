"""What ``--help`` behind a command prints: purpose, examples, choices, options, where results go.

Nothing is written twice: the words are the command's docstring, the first comments of the files
in ``conf/``, and the comments beside the fields of the options' dataclasses.
"""

from __future__ import annotations

import inspect
import re
import shutil
import textwrap
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.choices import choices, own_groups
from nnode.app.cli.overrides import show_composed
from nnode.program import words

#: Characters of a line, and those before what explains an option.
WIDTH, LEFT = 100, 34

_FLAGS = {
    "-h, --help": "this text; with choices, such as --help model=n4, the options of those",
    "-m, --multirun": "a run for every combination of values given as NAME=A,B",
    "--cfg job": "print the whole configuration and do nothing",
    "--config-dir FOLDER": "take further choices from FOLDER/GROUP/NAME.yaml",
    "--version": "print the version",
}


def help_text(overrides: list[str], folder: Path, name: str, extra: Path | None = None) -> str:
    """The help of a script, with the values that checked overrides give.

    Args:
        folder: ``conf/``.
        extra: a folder with groups of the user's own.
    """
    config = show_composed(overrides, folder, name, extra)
    chosen = dict(config.hydra.runtime.choices)
    groups = [g for g in own_groups(folder, name) if chosen.get(g) or g == "experiment"]
    parts = [words(name, folder)]
    for group in groups:
        found = choices(folder, group) + (choices(extra, group) if extra else [])
        lines = [
            _row(f"{'*' if c.name == chosen.get(group) else ' '} {c.name}", c.words, 18)
            for c in found
        ]
        parts.append("\n".join([f"{group}=   ({_GROUPS.get(group, 'what is chosen')})", *lines]))
    if groups:
        parts.insert(1, "Choices, GROUP=NAME; those with * are taken now")
    parts.append("Options, NAME=VALUE, with their values now; null means none")
    parts += _sections(config)
    flags = [_row(flag, said) for flag, said in _FLAGS.items()]
    parts.append("\n".join(["Running", _row(*_run_folder(folder, name)), *flags]))
    return "\n\n".join(parts)


#: What is chosen by each group.
_GROUPS = {
    "model": "the right-hand side",
    "data": "what it is compared with",
    "solver": "how it is integrated, and which gradient that gives",
    "optimizer": "how parameters are changed",
    "experiment": "several choices and options at once",
    "study": "which part of the paper",
}


def _run_folder(folder: Path, name: str) -> tuple[str, str]:
    """Where a script writes, in words."""
    config = OmegaConf.load(folder / f"{name}.yaml")
    place = str(OmegaConf.to_container(config, resolve=False)["hydra"]["run"]["dir"])  # type: ignore[call-overload,index]
    place = re.sub(r"\$\{now:[^}]*\}", "TIME", place)
    place = re.sub(r"\$\{(\w+)\.name\}", lambda m: m[1].upper(), place)
    return "hydra.run.dir=FOLDER", f"folder of the results; without it {place}"


def _sections(config: DictConfig) -> list[str]:
    """Options by the group they belong to, those of the script itself last."""
    typed = [str(k) for k in config if k != "hydra" and OmegaConf.is_dict(config._get_node(k))]
    found = ["\n".join(_options(config[key], f"{key}.")) for key in typed]
    own = [str(k) for k in config if k != "hydra" and k not in typed]
    if own:
        said = _said(config)
        found.append("\n".join(_line(config, key, "", said) for key in own))
    return [text for text in found if text]


def _options(node: DictConfig, prefix: str) -> list[str]:
    said, lines = _said(node), []
    for key in map(str, node):
        child = node._get_node(key)
        if OmegaConf.is_dict(child) and is_dataclass(OmegaConf.get_type(child)):
            lines += _options(node[key], f"{prefix}{key}.")
        else:
            lines.append(_line(node, key, prefix, said))
    return lines


def _said(node: DictConfig) -> dict[str, str]:
    kind = OmegaConf.get_type(node)
    return remarks(kind) if kind is not None and is_dataclass(kind) else {}


def _line(node: DictConfig, key: str, prefix: str, said: dict[str, str]) -> str:
    words = said.get(key, "")
    if OmegaConf.is_missing(node, key):
        return _row(f"{prefix}{key}=...", f"must be given: {words}")
    return _row(f"{prefix}{key}={_shown(node[key])}", words)


def _shown(value: Any) -> str:
    if OmegaConf.is_config(value):
        return re.sub(r"[\"']", "", str(OmegaConf.to_container(value))).replace("None", "null")
    if isinstance(value, Enum):
        return str(value.value)
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)


def _row(left: str, right: str, size: int = LEFT) -> str:
    """Name and explanation side by side, or below each other where the name is long."""
    width = min(shutil.get_terminal_size((WIDTH, 24)).columns, WIDTH)
    lines = textwrap.wrap(right, max(width - size - 2, 20), break_on_hyphens=False) or [""]
    head = f"  {left:<{size - 2}}" if len(left) < size - 2 else f"  {left}\n{'':<{size}}"
    return "\n".join([f"{head}{lines[0]}".rstrip(), *(f"{'':<{size}}{line}" for line in lines[1:])])


def remarks(schema: type) -> dict[str, str]:
    """What the comments beside, or above, a dataclass's fields say; choices of enums with it."""
    found: dict[str, str] = {}
    for kind in reversed(schema.__mro__):
        if is_dataclass(kind):
            found.update(_comments(inspect.getsource(kind)))
    for one in fields(schema):
        default = one.default if isinstance(one.default, Enum) else None
        if default is not None:
            valid = " | ".join(str(member.value) for member in type(default))
            said = found.get(one.name) or _brief(type(default))
            found[one.name] = f"{valid}: {said}"
    return found


def _brief(kind: type) -> str:
    """The first sentence of a docstring, without its end."""
    first = inspect.cleandoc(kind.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    words = re.split(r"[.:;] |\.$", first)[0].replace("``", "")
    return words[:1].lower() + words[1:]


def _comments(source: str) -> dict[str, str]:
    found, above = {}, ""
    for line in source.splitlines():
        comment = re.match(r"    # (.*)", line)
        field = re.match(r"    (\w+): [^#]*(?:  # (.*))?$", line)
        if comment:
            above = f"{above} {comment[1]}".strip()
        elif field:
            found[field[1]] = field[2] or above
            above = ""
    return {name: words for name, words in found.items() if words}
