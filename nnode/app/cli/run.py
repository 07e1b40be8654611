"""Execution of a command through Hydra, with the package's errors in one line each."""

from __future__ import annotations

import logging
import os
import signal
import sys
import tempfile
import warnings
from argparse import ArgumentError, ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hydra import initialize_config_dir
from hydra._internal.hydra import Hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from nnode.app.cli.help import help_text
from nnode.app.cli.mistakes import SEARCH_PATH, in_words, refuse_added, without_value
from nnode.app.cli.prepared import prepared_group
from nnode.app.cli.runs import RESULT, end, failures, say
from nnode.app.cli.typed import literal
from nnode.calibrate.distributed import World, join, started_together
from nnode.calibrate.interrupt import Interrupted
from nnode.config import register
from nnode.errors import ConfigError, NNodeError, suggestion
from nnode.files import disk_words, write_json
from nnode.program import configuration, running
from nnode.version import VERSION

Job = Callable[[DictConfig, Path], None]

#: Supported flags of Hydra. All other words are overrides.
_PARSER = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
for _names in (("-h", "--help"), ("-m", "--multirun"), ("--version",), ("--resolve",)):
    _PARSER.add_argument(*_names, action="store_true")
_PARSER.add_argument("-c", "--cfg", choices=("job", "hydra", "all"))
_PARSER.add_argument("-p", "--package")
_PARSER.add_argument("-cd", "--config-dir", type=Path)


def run(
    name: str,
    job: Job,
    inject: Callable[[list[str]], list[str]] | None = None,
    *,
    parallel: bool = False,
    bare: str | None = None,
) -> None:
    """Run ``job(config, folder)`` as the command ``name``, and end the process on errors.

    Args:
        name: the command, and its configuration ``conf/<name>.yaml``.
        job: the work, which writes only into ``folder``.
        inject: function from the user's overrides to further overrides before them.
        parallel: whether all processes that were started together run the job; otherwise only the
            first one.
        bare: option whose value may be typed without its name.
    """
    if started_together() and not parallel and os.environ["RANK"] != "0":
        return
    register()
    # on a full disk, errors of the log must not hide the run's error
    logging.raiseExceptions = False
    running(name)
    try:
        if parallel:
            join()
        with World().together():
            flags, given = _parsed(bare)
            extra = prepared_group(given)
            given = [*extra, *(inject([*given, *extra]) if inject else []), *given]
    except NNodeError as error:
        end(error)
    if flags.version:
        print(f"nnode {VERSION}")
        return
    GlobalHydra.instance().clear()  # a forked process inherits the state
    folder = str(configuration().absolute())
    with initialize_config_dir(folder, name, "1.3"), _out_of_sight() as places:
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        try:
            _execute(hydra, name, flags, [*given, *places], _task(job, name))
        except (HydraException, OmegaConfBaseException) as error:
            end(in_words(error, name, given))
    World().leave()
    if failures():
        sys.exit(1)


def _execute(
    hydra: Hydra,
    name: str,
    flags: Namespace,
    overrides: list[str],
    task: Callable[[DictConfig], None],
) -> None:
    """Show what the flags request, or run the job, or all jobs of a sweep."""
    if flags.help:
        if hasattr(signal, "SIGPIPE"):  # a reader such as head may close the pipe
            signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        print(help_text(name, hydra.compose_config(name, overrides, RunMode.RUN)))
    elif flags.cfg:
        hydra.show_cfg(name, overrides, flags.cfg, flags.package, flags.resolve)
    elif flags.multirun:
        hydra.multirun(name, task, [*overrides, "hydra.mode=MULTIRUN"])
    else:
        hydra.run(name, task, [*overrides, "hydra.mode=RUN"])


def _task(job: Job, name: str) -> Callable[[DictConfig], None]:
    here = os.getpid()

    def task(config: DictConfig) -> None:
        settings = HydraConfig.get()
        folder = Path(settings.runtime.output_dir)
        try:
            with disk_words(folder):
                refuse_added(config, name)
                job(config, folder)
        except OmegaConfBaseException as error:
            failed: NNodeError = without_value(error)
        except NNodeError as error:
            failed = error
        else:
            return
        sweep, world = settings.mode == RunMode.MULTIRUN, World()
        # a launcher may run the job in another process, where a signal stops only this job
        stopped = isinstance(failed, Interrupted) and os.getpid() == here
        if stopped or not sweep or (world.size > 1 and not world.agreed):
            if stopped and sweep:
                say("the sweep ends here: its later runs were not started")
            end(failed)
        # the other jobs of a sweep continue
        if world.first:
            say(f"error in {folder}: {failed}")
        write_json(folder / RESULT, {"error": str(failed)})

    return task


def _parsed(bare: str | None) -> tuple[Namespace, list[str]]:
    """The flags and the overrides of the command line.

    Raises:
        ConfigError: a word is neither an override nor a flag, or a flag's value is wrong.
    """
    try:
        flags, words = _PARSER.parse_known_args()
    except ArgumentError as error:
        raise ConfigError(f"{error}; --help shows examples") from error
    overrides = []
    for word in words:
        key, equals, value = word.partition("=")
        if word[:1] == "-":
            raise _unknown_flag(key, value, flags)
        if equals or word[:1] == "~":
            if not key.lstrip("+~").strip():
                raise ConfigError(f"{word} names no option: expected NAME=VALUE")
            overrides.append(word)
        elif bare is None or not word:
            shown = word or "an empty word"
            raise ConfigError(f"{shown} is no option: expected NAME=VALUE, --help shows examples")
        else:
            overrides.append(f"{bare}={literal(word)}")
            bare = None
    if (folder := flags.config_dir) is not None:
        if not folder.is_dir():
            raise ConfigError(f"--config-dir {folder}: there is no such folder; give another one")
        overrides.append(f"{SEARCH_PATH}={literal([f'file://{folder.absolute()}'])}")
    return flags, overrides


def _unknown_flag(name: str, value: str, flags: Namespace) -> ConfigError:
    if value:
        option = f"{name.lstrip('-')}={value}"
        return ConfigError(f"{name}={value}: options have no dashes; type {option}")
    available = [f"--{flag.replace('_', '-')}" for flag in vars(flags)]
    hint = suggestion(name, available, cutoff=0.7) or ";"
    return ConfigError(f"there is no flag {name}{hint} --help shows all options and flags")


@contextmanager
def _out_of_sight() -> Iterator[list[str]]:
    """Disable output of all processes except the first; yields overrides for a temporary folder."""
    if World().first:
        yield []
        return
    with tempfile.TemporaryDirectory(prefix="nnode-") as folder:
        logging.disable(logging.CRITICAL)
        warnings.simplefilter("ignore")
        places = [f"hydra.{name}.dir={folder}" for name in ("run", "sweep")]
        yield [*places, "hydra.output_subdir=null"]
