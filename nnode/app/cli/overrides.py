"""Options of a command line, checked before any work starts; errors in the toolkit's words."""

from __future__ import annotations

import re
from collections.abc import Iterator
from copy import deepcopy
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

from hydra import compose
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nnode.app.cli.choices import choices, natural, own_groups
from nnode.errors import ConfigError

_WRITTEN = "options are written name=value, without blanks around the equals sign"
_QUOTES = (
    "a value with commas, brackets, braces, colons or blanks stands in quotes of its own: "
    "\"name='a, b'\""
)

#: What OmegaConf says of a value, and what is meant.
_REASONS = (
    (r"could not be converted to Integer", "expected a whole number"),
    (r"could not be converted to Float", "expected a number"),
    (r"is not a valid bool", "expected true or false"),
    (r"is not Optional|cannot be None|is not a subclass of", "expected a value"),
    (r"is not a ListConfig, list or tuple", "expected a list, written [a,b]"),
    (r"Cannot convert '(?:list|dict|ListConfig|DictConfig)' to string", "expected one value"),
)


def check_overrides(
    overrides: list[str],
    folder: Path,
    name: str,
    *,
    sweep: bool = True,
    extra: Path | None = None,
) -> list[str]:
    """Refuse unknown groups, options and values of the wrong type, one clear error each.

    Args:
        overrides: as they stand on the command line, without flags.
        folder: ``conf/``.
        name: of the script.
        sweep: whether an option may have several values, a run for each.
        extra: a folder with groups of the user's own.

    Returns:
        Those overrides that address a mapping which takes any name, such as ``data.columns``.

    Raises:
        ConfigError: with the nearest valid name.
    """
    _check_blanks(overrides)
    parsed = [_parsed(text) for text in overrides]
    _check_twice(parsed)
    try:
        loader = _loader(folder, extra)
        # asked once for each: Hydra takes a while to answer
        names = {o.key_or_group for o in parsed if "." not in o.key_or_group}
        known = {name: loader.get_group_options(name) for name in names}
        groups = [o for o in parsed if known.get(o.key_or_group)]
        for override in parsed:
            _check_values(override, sweep, override in groups)
        for override in groups:
            _check_group(override, known[override.key_or_group], own_groups(folder, name))
        config = composed(name, [f"{o.get_key_element()}={_first(o)}" for o in groups])
        free = [
            text
            for text, override in zip(overrides, parsed, strict=True)
            if override not in groups
            and _check_option(override, config, folder)
            and text[0] not in "+~"
        ]
    finally:
        GlobalHydra.instance().clear()
    return free


def show_composed(overrides: list[str], folder: Path, name: str, extra: Path | None) -> DictConfig:
    """The configuration that checked overrides give, Hydra's own part with it."""
    try:
        _loader(folder, extra)
        return composed(name, overrides)
    finally:
        GlobalHydra.instance().clear()


def composed(name: str, overrides: list[str]) -> DictConfig:
    """The composed configuration, with Hydra's own part.

    Raises:
        ConfigError: groups that cannot be put together.
    """
    try:
        return compose(name, overrides, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_unfit(str(error).splitlines())) from None


def _unfit(said: list[str]) -> str:
    """What is said of choices that do not go together."""
    file = re.match(r"In '(.*)': .*raised while composing", said[0])
    if file is None or len(said) < 2:
        return said[0]
    return f"{file[1].replace('/', '=')} does not go with the other choices: {said[1]}"


def _loader(folder: Path, extra: Path | None) -> ConfigLoader:
    """Let Hydra find the groups; its public entry takes one folder only."""
    GlobalHydra.instance().clear()
    path = create_config_search_path(str(folder))
    if extra is not None:
        place = f"file://{extra.absolute()}"
        path.prepend("command-line", place, anchor=SearchPathQuery(provider="schema"))
    Hydra.create_main_hydra2(task_name="check", config_search_path=path)
    return GlobalHydra.instance().config_loader()


def _check_blanks(overrides: list[str]) -> None:
    """Refuse ``name = value``, which the shell hands over as several arguments."""
    for text, after in pairwise(overrides):
        if (after.startswith("=") and "=" not in text) or (text.endswith("=") and "=" not in after):
            said = f"{text} {after}".strip()
            meant = f"{text.rstrip('=')}={after.lstrip('=') or 'VALUE'}"
            raise ConfigError(f"cannot read '{said}': {_WRITTEN}, as {meant}")


def _parsed(text: str) -> Override:
    """One argument as an override; what is none is refused in words."""
    key, equals, value = text.partition("=")
    bare = key.lstrip("+~")
    if not equals and not text.startswith("~"):
        what = f"{text} has no value" if re.fullmatch(r"[\w./]+", text) else f"cannot read {text!r}"
        raise ConfigError(f"{what}; {_WRITTEN}, such as {_example(text)}")
    if not bare or bare != bare.strip() or value != value.strip():
        raise ConfigError(f"cannot read {text!r}; {_WRITTEN}")
    if equals and not value and not text.startswith("~"):
        raise ConfigError(f"{text} has no value; write {text}VALUE, with null for none")
    try:
        override: Override = OverridesParser.create().parse_override(text)
    except HydraException:
        raise ConfigError(f"cannot read {text}: {_unreadable(value)}") from None
    return override


def _example(text: str) -> str:
    """What may have been meant by an argument without a value."""
    name = Path(text).name
    if ("." in name and "/" in text) or name.endswith((".pt", ".csv", ".parquet")):
        return "checkpoint=FILE" if name.endswith(".pt") else "data.path=FILE"
    return f"{text}=VALUE" if re.fullmatch(r"\w+(\.\w+)*", text) else "model=lin"


def _unreadable(value: str) -> str:
    for opening, closing in ("[]", "{}", "()"):
        if value.count(opening) != value.count(closing):
            return f"a {opening} or {closing} is missing"
    if value.count("'") % 2 or value.count('"') % 2:
        return "a quotation mark is missing; within a shell, quote the whole argument as well"
    return _QUOTES


def _check_twice(parsed: list[Override]) -> None:
    seen: dict[str, str] = {}
    for override in parsed:
        key, text = override.get_key_element().lstrip("+~"), str(override.input_line)
        if key in seen:
            raise ConfigError(f"{key} is given twice: {seen[key]} and {text}; leave one out")
        seen[key] = text


def _values(override: Override) -> Iterator[Any]:
    if override.is_sweep_override():
        yield from override.sweep_iterator()
    else:
        yield override.get_value_element_as_str()


def _first(override: Override) -> str:
    return str(next(_values(override)))


def _check_values(override: Override, sweep: bool, group: bool) -> None:
    """Refuse several values outside of sweeps, and sweeps over none."""
    if not override.is_sweep_override():
        return
    text = str(override.input_line)
    if not sweep:
        key, value = override.get_key_element(), text.partition("=")[2]
        lists = "" if group else f", write '{key}=[{value}]' for a list, or quote the comma: "
        quoted = "" if group else f"\"{key}='{value}'\""
        raise ConfigError(f"{text} names several values; add -m for a run with each{lists}{quoted}")
    if next(_values(override), None) is None:
        raise ConfigError(f"{text} names no value at all; there is nothing to run")


def _near(word: str, valid: list[str]) -> str:
    near = get_close_matches(word, valid, n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else ""


def _check_group(override: Override, known: list[str], own: list[str]) -> None:
    group = override.key_or_group
    if not group.startswith("hydra/") and group not in own:
        raise ConfigError(
            f"{override.input_line}: this script has no {group}= to choose"
            + (f", it has {', '.join(f'{g}=' for g in own)}" if own else "; leave it out")
        )
    if override.is_delete() or override.is_add():
        raise ConfigError(
            f"{override.input_line}: choices are neither added nor deleted; write {group}=NAME"
        )
    options = sorted((o for o in known if not o.endswith("_schema")), key=natural)
    allowed = [*options, "null"] if group == "experiment" else options
    for value in _values(override):
        if str(value) not in allowed:
            raise ConfigError(
                f"{group}={value} is unknown, expected one of {', '.join(options)}"
                f"{_near(str(value), options)}"
            )


def _check_option(override: Override, config: DictConfig, folder: Path) -> bool:
    """Whether the option addresses a mapping that takes any name; refuses unknown ones."""
    key = override.key_or_group
    parts = key.split(".")
    node: Any = config
    for depth, part in enumerate(parts):
        if _free(node) or OmegaConf.is_list(node):
            break
        valid = [str(k) for k in node] if OmegaConf.is_dict(node) else []
        if part not in valid:
            raise ConfigError(_unknown(parts, depth, valid, config, folder))
        node = node._get_node(part)
    if override.is_delete():
        raise ConfigError(f"~{key}: an option cannot be deleted; set {key}=null or leave it out")
    _check_type(override, config, node)
    return _free(node)


def _check_type(override: Override, config: DictConfig, node: Any) -> None:
    key = override.key_or_group
    swept = override.is_sweep_override()
    values = list(override.sweep_iterator()) if swept else [override.value()]
    for value in values:
        if OmegaConf.is_dict(node) and not _free(node) and not isinstance(value, dict):
            some = next((str(k) for k in node), "NAME")
            raise ConfigError(f"{key} is a group of options; set one of them: {key}.{some}=VALUE")
        try:
            OmegaConf.update(deepcopy(config), key, _plain(value), force_add=True)
        except OmegaConfBaseException as error:
            said = _plain(value) if swept else override.get_value_element_as_str()
            raise ConfigError(f"{key}={said} is refused: {_reason(error, str(said))}") from None


def _unknown(
    parts: list[str], depth: int, valid: list[str], config: DictConfig, folder: Path
) -> str:
    """What is said of an option that there is not."""
    key, parent = ".".join(parts), ".".join(parts[:depth])
    if not depth:
        # an experiment is chosen like the other groups, but leaves nothing under its name
        groups = list(OmegaConf.select(config, "hydra.runtime.choices", default={}))
        valid = [v for v in valid if v != "hydra"]
        valid += [g for g in groups if "/" not in g and g not in valid]
        valid.append("hydra")
    nearest = get_close_matches(parts[depth], valid, n=1, cutoff=0.5)
    meant = ".".join([*parts[:depth], *nearest, *parts[depth + 1 :]])
    hint = f"; did you mean {meant}?" if nearest else ""
    if depth == 1 and not nearest:
        others = [c.name for c in choices(folder, parent) if parts[1] in c.options]
        hint = f"; {parts[1]} belongs to {parent}={', '.join(others)}" if others else ""
    if parent and not valid:
        return f"option {key} is unknown: {parent} is one value, set it with {parent}=VALUE"
    return (
        f"option {key} is unknown{hint} ({parent or 'there'} {'has' if parent else 'are'}: "
        f"{', '.join(valid)})"
    )


def _reason(error: OmegaConfBaseException, value: str) -> str:
    """Why a value is refused, in the toolkit's words."""
    first = str(error).splitlines()[0]
    for pattern, words in _REASONS:
        if re.search(pattern, first):
            return words
    listed = re.search(r"expected one of \[(.*)\]", first)
    if listed:
        valid = listed[1].split(", ")
        return f"expected one of {', '.join(valid)}{_near(value, valid)}"
    return first


def _free(node: Any) -> bool:
    """Whether a node is a mapping that takes any name; the whole configuration is none."""
    typed = not OmegaConf.is_dict(node) or OmegaConf.get_type(node) is not dict
    return not typed and node._get_parent() is not None


def _plain(value: Any) -> Any:
    """Hydra's quoted strings as strings."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return getattr(value, "text", value)
