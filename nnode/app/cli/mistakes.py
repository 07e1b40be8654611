"""The package's messages for mistakes on a command line.

They replace Hydra's messages, which refer to its schemas and search path.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, cast

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import (
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    InterpolationToMissingValueError,
    MissingMandatoryValue,
    OmegaConfBaseException,
    ValidationError,
)

from nnode.app.cli.typed import group_defaults
from nnode.errors import ConfigError, suggestion
from nnode.program import configuration

#: Hydra's option for folders with further choices.
SEARCH_PATH = "hydra.searchpath"
#: OmegaConf's name of a type to the description of the expected value.
_KINDS = {"Integer": "a whole number", "Float": "a number", "Boolean": "true or false"}
_BOUNDS = {"low": "at least", "high": "at most"}


def in_words(error: Exception, name: str, overrides: list[str]) -> ConfigError:
    """The package's error for an error of Hydra or OmegaConf in the composition of a command line.

    Args:
        name: name of the command.
        overrides: the typed overrides.
    """
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    message = _first_line(cause)
    if isinstance(error, OverrideParseException):
        return ConfigError(
            f"{error.override} cannot be read: expected NAME=VALUE, a list [A, B] or a mapping "
            "{A: B}; a value with spaces, commas, brackets or quotes stands in quotes of its own "
            "within those of the shell, as in 'data.path=\"a (1).csv\"'"
        )
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, chosen = str(error.missing_cfg_file).removesuffix(".yaml").rpartition("/")
        names = (str(choice) for choice in error.options or ())
        return unknown_choice(group, chosen, [n for n in names if not n.endswith("_schema")])
    if ambiguous := re.match(r"Ambiguous value for argument '(.*)'$", message):
        key, _, values = ambiguous[1].partition("=")
        return ConfigError(
            f"{ambiguous[1]} has several values: add -m for a run with each, or type "
            f"'{key}=[{values}]' for a list, '{key}=\"{values}\"' for one text with commas"
        )
    undeletable = re.match(r"Could not delete from config. '(.*)' does not exist", str(error))
    repeated = re.match(r"Multiple values for (\S+?)\.", str(error))
    if repeated:
        return ConfigError(
            f"{repeated[1]} is chosen twice; type {repeated[1]}=NAME once, without a +"
        )
    key = undeletable[1] if undeletable else str(getattr(cause, "full_key", None) or "")
    if isinstance(cause, ValidationError):
        override = _typed_for(key, overrides)
        return wrong_value(key, override, message, _composed(name, overrides))
    missing = re.match(r"(?:Could not override|Key) '([^']*)'", str(error))
    if (undeletable or missing) and (key or missing):
        override = _typed_for(key or str(missing and missing[1]), overrides)
        return unknown_option(override, _composed(name, overrides), name)
    return without_value(cause)


def without_value(error: Exception) -> ConfigError:
    """The error for a mandatory option without a value, or an invalid interpolation."""
    message = _first_line(error)
    if isinstance(error, MissingMandatoryValue | InterpolationToMissingValueError):
        key = message.rpartition(" ")[2]
        return ConfigError(f"{key} is missing; type {key}=VALUE, --help shows examples")
    message = re.sub(
        r"^\w+ raised while resolving interpolation: |, possible .* keys: .*", "", message
    )
    return ConfigError(f"{message}; --help shows examples and all options")


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


def unknown_choice(group: str, chosen: str, available: Iterable[str]) -> ConfigError:
    """The error for a choice that its group does not have."""
    names = sorted(available)
    near = suggestion(chosen, {name: f"{group}={name}" for name in names})
    text = f"there is no {group}={chosen}{near or ';'} {group} is one of {', '.join(names)}"
    if group == "data" and (Path(chosen).suffix or Path(chosen).exists()):
        text += (
            f". For a file of your own, nnode check {chosen} prints the options that "
            "read it; a tidy table is data=table data.path=FILE data.domain=traffic"
        )
    return ConfigError(text)


def unknown_option(
    override: str,
    config: DictConfig | None,
    name: str,
    hint: str = ", --help explains them",
) -> ConfigError:
    """The error for an option that a command does not have.

    Args:
        override: the typed override.
        config: configuration of the command's choices; None if it is unknown.
        name: name of the command.
        hint: text after the list of options.
    """
    key, _, value = override.lstrip("+~").partition("=")
    text = f"{name} has no option {key}"
    if config is None:
        return ConfigError(f"{text}; --help shows all options")
    node, at, remainder = config, "", key
    while OmegaConf.is_dict(node) and remainder.partition(".")[0] in node and "." in remainder:
        word, _, remainder = remainder.partition(".")
        at, node = f"{at}{word}.", node[word]
    if not OmegaConf.is_dict(node):
        return ConfigError(f"{text}: {at.rstrip('.')} is a value, without options of its own")
    if at == "model." and (how := _start_value(node, remainder, value)):
        return ConfigError(f"{text}: {how}")
    options = [str(option) for option in node if option != "hydra"]
    near = suggestion(remainder.partition(".")[0], {option: f"{at}{option}" for option in options})
    if not near:
        # suggests the same name in another section, the first one of each name
        every = {option.rpartition(".")[2]: option for option in reversed([*_keys(config)])}
        near = suggestion(remainder.rpartition(".")[2], every, cutoff=0.75)
    owner = at.rstrip(".") or name
    return ConfigError(f"{text}{near or ';'} {owner} has {', '.join(options)}{hint}")


def wrong_value(key: str, override: str, message: str, config: DictConfig | None) -> ConfigError:
    """The error for a value that the option ``key`` cannot have.

    Args:
        override: the typed override.
        message: OmegaConf's message.
        config: configuration of the command's choices; None if it is unknown.
    """
    typed, _, value = override.lstrip("+").partition("=")
    if typed != key or "convert 'dict'" in message:
        expected = f"{key} is a value, without options of its own"
    elif match := re.search(r"could not be converted to (\w+)", message):
        expected = f"expected {_KINDS.get(match[1], match[1].lower())}"
    elif match := re.search(r"expected one of \[(.*)\]", message):
        valid = match[1].replace(" ", "").split(",")
        expected = f"expected one of {', '.join(valid)}{suggestion(value, valid)}"
    elif "not a valid bool" in message:
        expected = f"expected {_KINDS['Boolean']}"
    elif "is not a subclass of" in message or "Invalid type assigned" in message:
        node = None if config is None else OmegaConf.select(config, key)
        has = f": {', '.join(map(str, node))}" if isinstance(node, DictConfig) and node else ""
        expected = f"{key} has options of its own{has}; type {key}.NAME=VALUE, --help shows them"
    elif "None" in message or "not Optional" in message:
        expected = "null is no value of this option; leave it out"
    elif "ListConfig" in message:
        expected = f"expected a list, such as [{value}]"
    else:
        expected = message
    return ConfigError(f"{override}: {expected}")


def refuse_added(config: DictConfig, name: str) -> None:
    """Refuse added options that do not exist, and an unknown experiment.

    Raises:
        ConfigError: the option or the experiment does not exist.
    """
    settings = HydraConfig.get()
    for override in settings.overrides.task:
        key, _, value = override.partition("=")
        at, _, leaf = key.lstrip("+").rpartition(".")
        if at == "model.law.parameters" and isinstance(
            OmegaConf.select(config, key.lstrip("+")), int | float
        ):
            model = OmegaConf.create(group_defaults("model", settings.runtime.choices["model"]))
            entry = OmegaConf.select(model, f"law.parameters.{leaf}")
            quantity = entry.get("value") if OmegaConf.is_dict(entry) else entry
            # a number would replace the quantity, its unit and its bounds
            if " " in str(quantity):
                raise ConfigError(f"{override}: {_start_value(model, leaf, value)}")
        if key.startswith("+") and key.lstrip("+") not in settings.runtime.choices:
            node = OmegaConf.select(config, at) if at else config
            kind = OmegaConf.get_type(node) if OmegaConf.is_dict(node) else None
            if is_dataclass(kind) and leaf not in kind.__dataclass_fields__:
                # the configuration already contains the added option
                clean = cast(DictConfig, OmegaConf.create(OmegaConf.to_container(config)))
                del (OmegaConf.select(clean, at) if at else clean)[leaf]
                raise unknown_option(override, clean, name)
    chosen = settings.runtime.choices.get("experiment")
    if chosen is not None:
        sources = [Path(s.path) for s in settings.runtime.config_sources if s.schema == "file"]
        files = [path for folder in sources for path in (folder / "experiment").glob("*.yaml")]
        if chosen not in {path.stem for path in files}:
            raise unknown_choice("experiment", chosen, {path.stem for path in files})


def _start_value(model: DictConfig, path: str, value: str) -> str:
    """How to set the start value of a law's parameter; empty if the name is not a parameter."""
    leaf = path.partition(".")[0]
    parameters = OmegaConf.select(model, "law.parameters")
    if not OmegaConf.is_dict(parameters):
        return ""
    names = {str(name).casefold(): str(name) for name in parameters}
    name = leaf if leaf in parameters else names.get(leaf.casefold())
    if name is None:
        options = {n: f"the parameter model.law.parameters.{n}.value" for n in names.values()}
        return suggestion(leaf, options).lstrip("; ")
    entry, key = parameters[name], f"model.law.parameters.{name}"
    if OmegaConf.is_dict(entry):
        key += ".value"
    else:
        entry = {"value": entry}
    unit = str(entry["value"]).partition(" ")[2]
    asked = _number(value, math.nan)
    low, high = _number(entry.get("low"), -math.inf), _number(entry.get("high"), math.inf)
    inside = low <= asked <= high
    bounds = [f"{word} {entry[end]}" for end, word in _BOUNDS.items() if entry.get(end) is not None]
    text = f"{name} is a parameter of the law, calibrated from a start value"
    text += f", which must be {' and '.join(bounds)}" if bounds else ""
    text += f"; {value} is not" if bounds and value and not inside else ""
    quantity = f"{asked:g} {unit}".strip() if inside else entry["value"]
    return f"{text}: type \"{key}='{quantity}'\" (now {entry['value']})"


def _number(quantity: Any, default: float) -> float:
    """The number of a quantity such as ``3 s``, or else the default."""
    try:
        return float(str(quantity).strip("'\" ").partition(" ")[0])
    except ValueError:
        return default


def _keys(node: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in (str(child) for child in node if child != "hydra"):
        yield f"{prefix}{key}"
        if OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key):
            continue
        if OmegaConf.is_dict(node[key]):
            yield from _keys(node[key], f"{prefix}{key}.")


def _typed_for(key: str, overrides: list[str]) -> str:
    """The override that sets a key, or else the key."""
    for override in reversed(overrides):
        option = override.lstrip("+~").partition("=")[0]
        if option == key or option.startswith(f"{key}."):
            return override.lstrip("+~")
    return key


def _composed(name: str, overrides: list[str]) -> DictConfig | None:
    """The configuration of the choices among the overrides, without other overrides."""
    parser = OverridesParser.create()
    kept: list[str] = []
    for text in overrides:
        try:
            parsed = parser.parse_override(text)
        except HydraException:
            continue
        if parsed.key_or_group == SEARCH_PATH:
            kept.append(text)
        elif (configuration() / parsed.key_or_group).is_dir():
            kept.append(f"{parsed.get_key_element()}={_first(parsed)}")
    try:
        return compose(name, kept, return_hydra_config=True)
    except Exception:  # a second mistake, which is reported after the first one is corrected
        return None


def _first(override: Override) -> Any:
    """The value of an override, or the first one of a sweep."""
    return next(override.sweep_iterator()) if override.is_sweep_override() else override.value()
