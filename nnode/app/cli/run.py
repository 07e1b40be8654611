"""Execution of a command through Hydra, with the package's errors in one line each."""

from __future__ import annotations

import logging
import os
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import hydra
from hydra._internal.hydra import Hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nnode.app.cli.help import help_text
from nnode.app.cli.mistakes import in_words, refuse_added, without_value
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

#: Supported flags of Hydra, and those with a value, with the allowed values.
_FLAGS = ("-h", "--help", "-m", "--multirun", "--version", "--resolve")
_CFG = ("job", "hydra", "all")
_VALUED: dict[str, tuple[str, ...]] = {
    "-c": _CFG,
    "--cfg": _CFG,
    "-p": (),
    "--package": (),
    "-cd": (),
    "--config-dir": (),
}


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
    if "--version" in sys.argv[1:]:
        print(f"nnode {VERSION}")
        return
    if {"-h", "--help"} & set(sys.argv) and hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # a reader such as head may close the pipe
    register()
    # on a full disk, errors of the log must not hide the run's error
    logging.raiseExceptions = False
    running(name)
    OmegaConf.register_new_resolver("nnode_help", partial(help_text, name), replace=True)
    try:
        if parallel:
            join()
        with World().together():
            given, flags = _parted(bare)
            extra = prepared_group(given)
            given = [*extra, *(inject([*given, *extra]) if inject else []), *given]
    except NNodeError as error:
        end(error)
    GlobalHydra.instance().clear()  # a forked process inherits the state
    # Hydra raises its errors instead of printing them, and makes no list of groups for the help,
    # which takes it 8 s and is not printed
    with (
        patch.dict(os.environ, {"HYDRA_FULL_ERROR": "1"}),
        patch.object(Hydra, "format_config_groups", return_value=""),
        _out_of_sight() as places,
    ):
        sys.argv[1:] = [*given, *places, *flags]
        command = hydra.main(version_base="1.3", config_path=str(configuration()), config_name=name)
        try:
            command(_task(job, name))()
        except (HydraException, OmegaConfBaseException) as error:
            end(in_words(error, name, given, flags))
    World().leave()
    if failures():
        sys.exit(1)


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


def _parted(bare: str | None) -> tuple[list[str], list[str]]:
    """The overrides and the flags of the command line, since Hydra needs contiguous overrides.

    Raises:
        ConfigError: a word is neither an override nor a flag.
    """
    overrides, flags = [], []
    for before, word in pairwise(["", *sys.argv[1:]]):
        if before in _VALUED:
            if _VALUED[before] and word not in _VALUED[before]:
                raise ConfigError(f"{before} {word}: expected one of {', '.join(_VALUED[before])}")
            flags.append(word)
        elif word[:1] == "~" or ("=" in word and word[0] != "-"):
            if not word.lstrip("+~").partition("=")[0].strip():
                raise ConfigError(f"{word} names no option: expected NAME=VALUE")
            overrides.append(word)
        elif word[:1] == "-":
            flags.append(_flag(word))
        elif not word:
            raise ConfigError("an empty word is no option: expected NAME=VALUE")
        elif bare is None:
            raise ConfigError(f"{word} is no option: expected NAME=VALUE, --help shows examples")
        else:
            overrides.append(f"{bare}={literal(word)}")
            bare = None
    if len(sys.argv) > 1 and sys.argv[-1] in _VALUED:
        raise ConfigError(f"{sys.argv[-1]} lacks its value; --help shows examples")
    return overrides, flags


def _flag(word: str) -> str:
    """Check a flag.

    Raises:
        ConfigError: the flag does not exist.
    """
    name, _, value = word.partition("=")
    if word in _FLAGS or name in _VALUED:
        return word
    if value and name not in _FLAGS:
        raise ConfigError(f"{word}: options have no dashes; type {word.lstrip('-')}")
    flags = [flag for flag in (*_FLAGS, *_VALUED) if flag.startswith("--")]
    hint = suggestion(name, flags, cutoff=0.7) or ";"
    raise ConfigError(f"there is no flag {word}{hint} --help shows all options and flags")


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
