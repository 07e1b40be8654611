"""Options as text: overrides in Hydra's grammar, quoted for the shell."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from typing import Any, cast

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.saved import in_hydra, make_absolute, plain
from nnode.errors import unknown_value
from nnode.program import configuration


def shell_override(key: str, value: object) -> str:
    """The override ``key=value``, quoted for the shell."""
    return shlex.quote(f"{key}={literal(value)}")


def literal(value: object) -> str:
    """A value in Hydra's grammar: text, number, bool, None, or lists and mappings of these."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_name(k)}: {literal(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(literal(item) for item in value) + "]"
    if isinstance(value, int | float):
        return str(value)
    text = str(value)
    try:
        read = OverridesParser.create().parse_override(f"key={text}").value()
    except HydraException:
        read = None
    return text if read == text else QuotedString(text, Quote.single).with_quotes()


def _name(key: object) -> str:
    """The escaped key of a mapping."""
    return re.sub(r"([\\()\[\]{}:=, \t])", r"\\\1", str(key))


def plain_options(options: object) -> dict[str, Any]:
    """A dataclass of options in plain types."""
    return plain(OmegaConf.structured(options))


def changed_options(options: object) -> dict[str, Any]:
    """The options of a dataclass that differ from its defaults, without the name."""
    defaults = plain_options(type(options)())
    values = plain_options(options)
    return {k: v for k, v in values.items() if v != defaults[k] and k != "name"}


def group_defaults(section: str, group: str, command: str | None = None) -> dict[str, Any]:
    """The defaults of a configuration group; mandatory options have the value ``???``.

    Args:
        command: a command with this section, if the running one has none.
    """
    if in_hydra():
        name = command or HydraConfig.get().job.config_name
        config = OmegaConf.select(compose(name, [f"{section}={group}"]), section)
    else:
        config = cast(DictConfig, OmegaConf.merge(*written(section, group)))
    values = plain(config)
    if section == "data":
        make_absolute(values)
    return values


def written(section: str, group: str) -> tuple[Any, DictConfig]:
    """A group's schema, and the values in its file; a law of the package has no file.

    Raises:
        ConfigError: the group does not exist.
    """
    from nnode.config import SCHEMAS, choices

    if group not in choices(section):
        raise unknown_value(section, group, choices(section))
    if (section, group) in SCHEMAS:
        return SCHEMAS[section, group], OmegaConf.create()
    values = cast(DictConfig, OmegaConf.load(configuration() / section / f"{group}.yaml"))
    return SCHEMAS[section, str(values.pop("defaults")[0])], values


def changes(prefix: str, values: Mapping[str, Any], defaults: Mapping[str, Any]) -> list[str]:
    """The overrides, quoted for the shell, that change ``defaults`` to ``values``.

    Nested options are written one by one, and mappings with free keys as a whole.
    """
    overrides = []
    for key, value in values.items():
        default = defaults.get(key)
        if value == default and key in defaults:
            continue
        if (
            isinstance(value, Mapping)
            and isinstance(default, Mapping)
            and set(value) == set(default)
        ):
            overrides += changes(f"{prefix}.{key}", value, default)
        else:
            overrides.append(shell_override(f"{prefix}.{key}", value))
    return overrides
