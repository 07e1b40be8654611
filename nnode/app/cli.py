"""From a command line to a job: composition, checked options, errors in the toolkit's words."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from copy import deepcopy
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from nnode.app.launchers import check_launcher, has_no_part, out_of_sight
from nnode.app.sweep import failures, record_failure
from nnode.calibrate.distributed import World, join
from nnode.calibrate.interrupt import Interrupted
from nnode.config import register
from nnode.errors import ConfigError, NNodeError
from nnode.files import disk_words

Job = Callable[[DictConfig, Path], None]

#: Hydra's own flags that take a value as the next argument.
_FLAGS_WITH_VALUE = {"--package", "-p", "--config-path", "-cp", "--config-name", "-cn"} | {
    "--config-dir",
    "-cd",
    "--experimental-rerun",
    "--info",
    "-i",
}


def run(
    name: str,
    job: Job,
    inject: Callable[[list[str]], list[str]] | None = None,
    *,
    parallel: bool = False,
) -> None:
    """Run ``job(config, folder)`` as ``scripts/<name>.py``; ends the process on errors.

    Args:
        name: the script, and its configuration ``conf/<name>.yaml``.
        job: does the work; writes only into ``folder``.
        inject: looks at the overrides given by the user and returns further ones that go
            before them.
        parallel: whether the job is for all processes that were started together; otherwise
            the first one does it alone.
    """
    if has_no_part(parallel):
        return
    register()
    # on a full disk the log cannot be written either, which shall not bury the run's own words
    logging.raiseExceptions = False
    folder = Path(sys.argv[0]).resolve().parent.parent / "conf"
    try:
        if parallel:
            join()
        with World().together():
            given = _arguments(name, folder, inject)
        with out_of_sight(given):
            hydra.main(version_base="1.3", config_path=str(folder), config_name=name)(
                _guarded(job)
            )()
            failed = failures()
    except NNodeError as error:
        _end(error)
    except Escape as escape:
        _end(escape.error)
    World().part()
    if failed:
        sys.exit(1)


def _arguments(
    name: str, folder: Path, inject: Callable[[list[str]], list[str]] | None
) -> list[str]:
    """Check the command line and complete it in place; returns its overrides."""
    if not folder.is_dir():
        raise ConfigError(f"no configuration folder {folder}; run scripts/{name}.py in place")
    given = user_overrides(sys.argv[1:])
    if inject is not None:
        extra = inject(given)
        first = sys.argv.index(given[0], 1) if given else len(sys.argv)
        sys.argv[first:first] = extra
        given = extra + given
    check_launcher(given)
    if "--help" not in sys.argv and "-h" not in sys.argv:
        free = check_overrides(given, folder, name)
        # what goes into a mapping that takes any name is added, not only replaced
        sys.argv[1:] = [f"++{a}" if a in free else a for a in sys.argv[1:]]
    return user_overrides(sys.argv[1:])


def _end(error: NNodeError) -> NoReturn:
    """Say what happened and leave with the exit status that belongs to it.

    What all processes know is said by the first one, and they leave together.
    """
    stopped = isinstance(error, Interrupted)
    world = World()
    if world.first or not world.agreed:
        _say(str(error) if stopped else f"error: {error}")
    if world.agreed:
        world.part()
    if isinstance(error, Interrupted):
        sys.exit(128 + error.signal)
    sys.exit(2 if isinstance(error, ConfigError) else 1)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Escape(BaseException):
    """Carries the package's errors through Hydra, which would print its own words for them."""

    def __init__(self, error: NNodeError) -> None:
        self.error = error


def _guarded(job: Job) -> Callable[[DictConfig], None]:
    here = os.getpid()

    def task(config: DictConfig) -> None:
        settings = HydraConfig.get()
        folder = Path(settings.runtime.output_dir)
        try:
            try:
                with disk_words(folder):
                    job(config, folder)
            except OmegaConfBaseException as error:
                raise ConfigError(_missing(error)) from None
        except NNodeError as error:
            # a launcher may run the job elsewhere, where only this job can be stopped
            stopped = isinstance(error, Interrupted) and os.getpid() == here
            alone = World().size > 1 and not World().agreed
            if stopped or alone or settings.mode != RunMode.MULTIRUN:
                if isinstance(error, Interrupted) and settings.mode == RunMode.MULTIRUN:
                    text = f"{error}\nthe sweep ends here: its later runs were not started"
                    error = Interrupted(text, error.signal)
                raise Escape(error) from None
            # the other jobs of a sweep go on
            if World().first:
                _say(f"error in {folder}: {error}")
            record_failure(folder, str(error))

    return task


def _missing(error: OmegaConfBaseException) -> str:
    """What is wrong with a composed configuration, in one line."""
    if isinstance(error, MissingMandatoryValue):
        key = error.full_key or str(error).rpartition(" ")[2]
        return f"{key} is not set; give it a value with {key}=..."
    return str(error).splitlines()[0]


def user_overrides(arguments: list[str]) -> list[str]:
    """The overrides among command-line arguments, without Hydra's flags."""
    found, skip = [], False
    for argument in arguments:
        if skip or argument.startswith("-"):
            skip = not skip and argument in _FLAGS_WITH_VALUE
            continue
        found.append(argument)
    return found


def check_overrides(overrides: list[str], folder: Path, name: str) -> list[str]:
    """Refuse unknown groups, options and values of the wrong type, one clear error each.

    Returns:
        Those overrides that address a mapping which takes any name, such as ``data.columns``.

    Raises:
        ConfigError: with the nearest valid name.
    """
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(folder), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        try:
            parsed = OverridesParser.create().parse_overrides(overrides)
        except HydraException as error:
            first = str(error).splitlines()[0]
            raise ConfigError(
                f"cannot read the command line: {first}; options are written name=value, with "
                "quotes around values that hold commas, brackets or blanks"
            ) from None
        groups = [o for o in parsed if _is_group(o, loader)]
        for override in groups:
            _check_group(override, loader)
        chosen = [f"{o.get_key_element()}={_first(o)}" for o in groups]
        try:
            config = compose(name, chosen)
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigError(str(error).splitlines()[0]) from None
        free = [
            text
            for text, override in zip(overrides, parsed, strict=True)
            if override not in groups
            and not override.get_key_element().startswith("hydra")
            and _check_option(override, config)
            and text[0] not in "+~"
        ]
    GlobalHydra.instance().clear()
    return free


def _is_group(override: Override, loader: ConfigLoader) -> bool:
    return bool(loader.get_group_options(override.key_or_group)) and not override.is_delete()


def _values(override: Override) -> Iterator[Any]:
    if override.is_sweep_override():
        yield from override.sweep_iterator()
    else:
        yield override.get_value_element_as_str()


def _first(override: Override) -> str:
    return str(next(_values(override)))


def _near(word: str, valid: list[str]) -> str:
    near = get_close_matches(word, valid, n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else ""


def _check_group(override: Override, loader: ConfigLoader) -> None:
    group = override.key_or_group
    options = [o for o in loader.get_group_options(group) if not o.endswith("_schema")]
    for value in _values(override):
        if str(value) not in (*options, "null"):
            raise ConfigError(
                f"{group}={value} is unknown, expected one of {', '.join(options)}"
                f"{_near(str(value), options)}"
            )


def _check_option(override: Override, config: DictConfig) -> bool:
    """Whether the option addresses a mapping that takes any name; refuses unknown ones."""
    key = override.key_or_group
    parts = key.split(".")
    node: Any = config
    for depth, part in enumerate(parts):
        if _free(node) or OmegaConf.is_list(node):
            break
        valid = [str(k) for k in node] if OmegaConf.is_dict(node) else []
        if part not in valid:
            if not depth:
                valid += [g for g in ("experiment", "hydra") if g not in valid]
            nearest = get_close_matches(part, valid, n=1, cutoff=0.5)
            meant = ".".join([*parts[:depth], *nearest, *parts[depth + 1 :]])
            hint = f"; did you mean {meant}?" if nearest else ""
            parent = ".".join(parts[:depth]) or "the configuration"
            raise ConfigError(
                f"option {key} is unknown{hint} ({parent} has: {', '.join(valid) or 'no options'})"
            )
        node = node._get_node(part)
    if override.is_delete():
        raise ConfigError(f"~{key}: an option cannot be deleted; set {key}=null or leave it out")
    values = list(override.sweep_iterator()) if override.is_sweep_override() else [override.value()]
    for value in values:
        try:
            OmegaConf.update(deepcopy(config), key, _plain(value), force_add=True)
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(f"{key}={value} is refused: {reason}") from None
    return _free(node)


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
