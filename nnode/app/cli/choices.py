"""Configuration groups and their choices, as the files in ``conf/`` describe themselves."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nnode.config import SCHEMAS


@dataclass(frozen=True)
class Choice:
    """One choice of a group.

    Attributes:
        name: ``group=name`` takes it.
        words: the first comment of its file.
        options: names of its options; empty where it has no schema.
    """

    name: str
    words: str
    options: tuple[str, ...] = ()


def own_groups(folder: Path, script: str) -> list[str]:
    """Groups that a script's configuration has, in its order.

    Args:
        folder: ``conf/``.
    """
    config = OmegaConf.load(folder / f"{script}.yaml")
    assert isinstance(config, DictConfig)
    entries = [entry for entry in config.defaults if not isinstance(entry, str)]
    return [str(key).removeprefix("optional ") for entry in entries for key in entry]


def choices(folder: Path, group: str) -> list[Choice]:
    """The choices of a group, numbers in their names in their order.

    Args:
        folder: ``conf/``, or another one with groups.
    """
    found = [_choice(path, group) for path in (folder / group).glob("*.yaml")]
    return sorted(found, key=lambda choice: natural(choice.name))


def natural(name: str) -> list[int | str]:
    """A key that sorts n10 behind n4."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


def _choice(path: Path, group: str) -> Choice:
    lines = path.read_text(encoding="utf-8").splitlines()
    comments = [line[1:].strip() for line in lines if line.startswith("#")]
    words = next((c for c in comments if not c.startswith("@")), "")
    config: Any = OmegaConf.load(path)
    defaults = config.get("defaults", []) if OmegaConf.is_dict(config) else []
    schema = SCHEMAS.get((group, str(defaults[0]))) if defaults else None
    names = () if schema is None else tuple(f.name for f in fields(schema))
    return Choice(path.stem, words, names)
