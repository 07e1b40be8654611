"""From a command line to a job: composition, checked options, errors in the toolkit's words."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from nnode.app.cli.flags import read_command_line
from nnode.app.cli.help import help_text
from nnode.app.cli.launchers import check_launcher, has_no_part, out_of_sight
from nnode.app.cli.overrides import check_overrides
from nnode.app.cli.prepared import prepared_group
from nnode.app.cli.sweep import failures, record_failure
from nnode.calibrate.distributed import World, join
from nnode.calibrate.interrupt import Interrupted
from nnode.config import register
from nnode.errors import ConfigError, NNodeError
from nnode.files import disk_words
from nnode.program import begin, configuration
from nnode.version import VERSION

Job = Callable[[DictConfig, Path], None]


def run(
    name: str,
    job: Job,
    inject: Callable[[list[str]], list[str]] | None = None,
    *,
    parallel: bool = False,
) -> None:
    """Run ``job(config, folder)`` as the command ``name``; ends the process on errors.

    Args:
        name: the command, and its configuration ``conf/<name>.yaml``.
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
    begin()
    folder = configuration()
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
        raise ConfigError(
            f"no configuration folder {folder}; run scripts/{name}.py in place, or install nnode "
            "again"
        )
    line = read_command_line(sys.argv[1:])
    if "--version" in line.flags:
        print(f"nnode {VERSION}")
        sys.exit()
    given = line.overrides
    asked = "--help" in line.flags
    if not asked:
        extra = prepared_group(given, folder, name)
        extra += inject([*given, *extra]) if inject is not None else []
        first = sys.argv.index(given[0], 1) if given else len(sys.argv)
        sys.argv[first:first] = extra
        given = extra + given
    check_launcher(given)
    free = check_overrides(given, folder, name, sweep=line.sweeps or asked, extra=line.folder)
    if asked:
        _show(help_text(given, folder, name, line.folder))
        sys.exit()
    # what goes into a mapping that takes any name is added, not only replaced
    sys.argv[1:] = [f"++{a}" if a in free else a for a in sys.argv[1:]]
    return read_command_line(sys.argv[1:]).overrides


def _show(text: str) -> None:
    """Print a long text; a reader that has seen enough, such as head, is no error."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


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
