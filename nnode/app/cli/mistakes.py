"""Mistakes on a command line in the package's own words: what is unknown, and what there is.

Hydra's messages name its schemas and its search path, which no user has chosen.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import is_dataclass
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import (
    HydraException,
    MissingConfigException,
    OverrideParseException,
    SearchPathException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    InterpolationToMissingValueError,
    MissingMandatoryValue,
    OmegaConfBaseException,
    ValidationError,
)

from nnode.app.cli.saved import composed
from nnode.errors import ConfigError
from nnode.program import configuration

#: What an option's value must be, by OmegaConf's name of the type.
_KINDS = {"Integer": "a whole number", "Float": "a number", "Boolean": "true or false"}


def in_words(error: Exception, name: str, overrides: list[str], flags: list[str]) -> ConfigError:
    """An error of Hydra or OmegaConf, met while a command line was composed, as the package's.

    Args:
        name: of the command.
        overrides, flags: as they were typed.
    """
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    said = _first_line(cause)
    if isinstance(error, OverrideParseException):
        return ConfigError(
            f"{error.override} cannot be read: expected NAME=VALUE, a list [A, B] or a mapping "
            "{A: B}; a value with spaces, commas, brackets or quotes stands in quotes of its own "
            "within those of the shell, as in 'data.path=\"a (1).csv\"'"
        )
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, chosen = str(error.missing_cfg_file).removesuffix(".yaml").rpartition("/")
        there = [str(one) for one in error.options or () if not str(one).endswith("_schema")]
        return unknown_choice(group, chosen, there)
    if isinstance(error, SearchPathException):
        return ConfigError(f"{said}; name a folder that is there with --config-dir")
    if several := re.match(r"Ambiguous value for argument '(.*)'$", said):
        key, _, values = several[1].partition("=")
        return ConfigError(
            f"{several[1]} has several values: add -m for a run with each, or type "
            f"'{key}=[{values}]' for a list, '{key}=\"{values}\"' for one text with commas"
        )
    gone = re.match(r"Could not delete from config. '(.*)' does not exist", str(error))
    twice = re.match(r"Multiple values for (\S+?)\.", str(error))
    if twice:
        return ConfigError(f"{twice[1]} is chosen twice; type {twice[1]}=NAME once, without a +")
    key = gone[1] if gone else str(getattr(cause, "full_key", None) or "")
    if isinstance(cause, ValidationError):
        whole = _typed_for(key, overrides)
        return wrong_value(key, whole, said, _composed(name, overrides, flags))
    lost = re.match(r"(?:Could not override|Key) '([^']*)'", str(error))
    if (gone or lost) and (key or lost):
        whole = _typed_for(key or str(lost and lost[1]), overrides)
        return unknown_option(whole, _composed(name, overrides, flags), name)
    return without_value(cause)


def without_value(error: Exception) -> ConfigError:
    """The error of an option that must be given, or refers to what there is not."""
    said = _first_line(error)
    if isinstance(error, MissingMandatoryValue | InterpolationToMissingValueError):
        key = said.rpartition(" ")[2]
        return ConfigError(f"{key} is missing; type {key}=VALUE, --help shows examples")
    said = re.sub(r"^\w+ raised while resolving interpolation: |, possible .* keys: .*", "", said)
    return ConfigError(f"{said}; --help shows examples and all options")


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


def unknown_choice(group: str, chosen: str, there: Iterable[str]) -> ConfigError:
    """The error of a choice that its group does not have."""
    known = sorted(there)
    near = _near(chosen, {one: f"{group}={one}" for one in known})
    text = f"there is no {group}={chosen}{near or ';'} {group} is one of {', '.join(known)}"
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
    more: str = ", --help explains them",
) -> ConfigError:
    """The error of an option that a command does not have.

    Args:
        override: as it was typed.
        config: what the command's choices have; None: unknown.
        name: of the command.
        more: stands behind what there is.
    """
    key, _, value = override.lstrip("+~").partition("=")
    text = f"{name} has no option {key}"
    if config is None:
        return ConfigError(f"{text}; --help shows all options")
    node, at, rest = config, "", key
    while OmegaConf.is_dict(node) and rest.partition(".")[0] in node and "." in rest:
        word, _, rest = rest.partition(".")
        at, node = f"{at}{word}.", node[word]
    if not OmegaConf.is_dict(node):
        return ConfigError(f"{text}: {at.rstrip('.')} is a value, without options of its own")
    if at == "model." and (how := _start_value(node, rest, value)):
        return ConfigError(f"{text}: {how}")
    own = [str(one) for one in node if one != "hydra"]
    near = _near(rest.partition(".")[0], {one: f"{at}{one}" for one in own})
    if not near:
        # the right name in the wrong place; the first one of each name counts
        every = {one.rpartition(".")[2]: one for one in reversed([*_keys(config)])}
        near = _near(rest.rpartition(".")[2], every, cutoff=0.75)
    whose = at.rstrip(".") or name
    return ConfigError(f"{text}{near or ';'} {whose} has {', '.join(own)}{more}")


def wrong_value(key: str, override: str, said: str, config: DictConfig | None) -> ConfigError:
    """The error of a value that the option ``key`` cannot have; ``said``: OmegaConf's words."""
    typed, _, value = override.lstrip("+").partition("=")
    if typed != key:
        return ConfigError(f"{override}: {key} is a value, without options of its own")
    if match := re.search(r"could not be converted to (\w+)", said):
        return ConfigError(f"{override}: expected {_KINDS.get(match[1], match[1].lower())}")
    if match := re.search(r"expected one of \[(.*)\]", said):
        known = [one.strip() for one in match[1].split(",")]
        near = _near(value, {one: one for one in known})
        return ConfigError(f"{override}: expected one of {', '.join(known)}{near}")
    if "not a valid bool" in said:
        return ConfigError(f"{override}: expected {_KINDS['Boolean']}")
    if "is not a subclass of" in said or "Invalid type assigned" in said:
        node = None if config is None else OmegaConf.select(config, key)
        own = [str(one) for one in node] if isinstance(node, DictConfig) else []
        has = f": {', '.join(own)}" if own else ""
        return ConfigError(
            f"{override}: {key} has options of its own{has}; type {key}.NAME=VALUE, --help shows "
            "them"
        )
    if "None" in said or "not Optional" in said:
        return ConfigError(f"{override}: null is no value of this option; leave it out")
    if "is not a ListConfig" in said:
        return ConfigError(f"{override}: expected a list, such as [{value}]")
    if "convert 'dict'" in said:
        return ConfigError(f"{override}: {key} is a value, without options of its own")
    return ConfigError(f"{override}: {said}")


def refuse_added(config: DictConfig, name: str) -> None:
    """Refuse what stands behind a plus and no option reads, and an experiment there is not.

    Raises:
        ConfigError: names what there is.
    """
    settings = HydraConfig.get()
    for override in settings.overrides.task:
        key = override.partition("=")[0]
        at, _, leaf = key.lstrip("+").rpartition(".")
        if key.startswith("+") and key.lstrip("+") not in settings.runtime.choices:
            node = OmegaConf.select(config, at) if at else config
            kind = OmegaConf.get_type(node) if OmegaConf.is_dict(node) else None
            if is_dataclass(kind) and leaf not in kind.__dataclass_fields__:
                # the option itself is in the configuration by now
                clean = cast(DictConfig, OmegaConf.create(OmegaConf.to_container(config)))
                del (OmegaConf.select(clean, at) if at else clean)[leaf]
                raise unknown_option(override, clean, name)
    chosen = settings.runtime.choices.get("experiment")
    if chosen is not None:
        sources = [Path(s.path) for s in settings.runtime.config_sources if s.schema == "file"]
        files = [path for folder in sources for path in (folder / "experiment").glob("*.yaml")]
        if chosen not in {path.stem for path in files}:
            raise unknown_choice("experiment", chosen, {path.stem for path in files})


def _start_value(model: DictConfig, rest: str, value: str) -> str:
    """How a parameter of the law, or of an effect, gets the value; empty: it is none."""
    leaf = rest.partition(".")[0]
    parameters = OmegaConf.select(model, "law.parameters")
    if not OmegaConf.is_dict(parameters) or not parameters:
        return ""
    known = {str(one).casefold(): str(one) for one in parameters}
    own = leaf if leaf in parameters else known.get(leaf.casefold())
    if own is None:
        if near := get_close_matches(leaf, list(known.values()), n=1):
            return f"did you mean the parameter model.law.parameters.{near[0]}.value?"
        return ""
    about = parameters[own]
    now = str(about.value if OmegaConf.is_dict(about) else about)
    unit = now.partition(" ")[2]
    low, high = (
        str(about.get(e)) if OmegaConf.is_dict(about) and about.get(e) is not None else ""
        for e in ("low", "high")
    )
    asked, least, most = _number(value), _number(low), _number(high)
    within = f"between {low} and {high}" if low and high else ""
    outside = asked is not None and (
        (least is not None and asked < least) or (most is not None and asked > most)
    )
    shown = value if asked is not None and not outside else now.partition(" ")[0]
    quantity = f"{shown} {unit}".strip()
    text = f"{own} is a parameter of the law, calibrated from a start value"
    text += f", which lies {within}" if within else ""
    text += f"; {value} does not" if outside and within else ""
    return f"{text}: type \"model.law.parameters.{own}.value='{quantity}'\" (now {now})"


def _number(text: str) -> float | None:
    try:
        return float(text.strip("'\" ").partition(" ")[0])
    except ValueError:
        return None


def _near(word: str, known: Mapping[str, str], cutoff: float = 0.65) -> str:
    """A question for the nearest of some words, of either case, told as ``known`` says."""
    folded = {one.casefold(): told for one, told in known.items()}
    found = get_close_matches(word.casefold(), list(folded), n=1, cutoff=cutoff)
    return f"; did you mean {folded[found[0]]}?" if found else ""


def _keys(node: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in (str(one) for one in node if one != "hydra"):
        yield f"{prefix}{key}"
        if OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key):
            continue
        if OmegaConf.is_dict(node[key]):
            yield from _keys(node[key], f"{prefix}{key}.")


def _typed_for(key: str, overrides: list[str]) -> str:
    """The override that a key comes from; the key alone where none does."""
    for override in reversed(overrides):
        own = override.lstrip("+~").partition("=")[0]
        if own == key or own.startswith(f"{key}."):
            return override.lstrip("+~")
    return key


def _composed(name: str, overrides: list[str], flags: list[str]) -> DictConfig | None:
    """The configuration that the choices among the overrides give, all others left out."""
    parser = OverridesParser.create()
    kept: list[str] = []
    for text in overrides:
        try:
            parsed = parser.parse_override(text)
        except HydraException:
            continue
        if (configuration() / parsed.key_or_group).is_dir() and parsed.input_line:
            kept.append(f"{parsed.get_key_element()}={_first(parsed)}")
    for before, flag in pairwise(flags):
        if before in ("--config-dir", "-cd"):
            kept.append(f"hydra.searchpath=[file://{Path(flag).absolute()}]")
    try:
        GlobalHydra.instance().clear()
        return composed(name, kept)
    except Exception:  # a second mistake: it is told when the first one is mended
        return None


def _first(override: Override) -> Any:
    """A choice; of several the first one."""
    return next(override.sweep_iterator()) if override.is_sweep_override() else override.value()
