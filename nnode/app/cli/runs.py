"""The folders of runs and sweeps: taken before Hydra writes there, and gathered at the end.

Runs of a sweep may be other processes, on other machines: only the files that they write tell.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import pandas as pd
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from nnode.calibrate.distributed import World
from nnode.calibrate.interrupt import Interrupted
from nnode.errors import ConfigError, NNodeError, WriteError, printable
from nnode.files import PARTIAL, csv_text, disk_words, write_text
from nnode.lock import give, take

#: What a run came to, or why it failed; in its folder.
RESULT = "result.json"

#: Bytes that Hydra writes of a configuration, at most.
ROOM = 1 << 15

#: The sweep of this process: its folder, and the results that lay there before.
_sweep: dict[Path, set[tuple[Path, int]]] = {}


class Runs(Callback):
    """Refuses a second run, or a second sweep, where one is at work; gathers a sweep's results."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        # a folder named after an option that is missing: Hydra raises the error itself
        with suppress(OmegaConfBaseException):
            _take(Path(config.hydra.run.dir))

    def on_run_end(self, config: DictConfig, **kwargs: Any) -> None:
        give(Path(config.hydra.run.dir))

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        _take(folder, "sweep")
        _sweep[folder] = _results(folder)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        if World().first:
            _table(folder)
        give(folder)


class LogFormatter(logging.Formatter):
    """Lines of the log: they may quote names from files."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))


def end(error: NNodeError) -> NoReturn:
    """Say what happened and leave with the exit status that belongs to it.

    What all processes know is said by the first one, and they leave together.
    """
    world, stopped = World(), isinstance(error, Interrupted)
    if world.first or not world.agreed:
        say(str(error) if stopped else f"error: {error}")
    if world.agreed:
        world.leave()
    if isinstance(error, Interrupted):
        sys.exit(128 + error.signal)
    sys.exit(2 if isinstance(error, ConfigError) else 1)


def say(text: str) -> None:
    """Tell the user at once."""
    print(text, file=sys.stderr, flush=True)


def failures() -> list[Path]:
    """Folders of the runs of this process's sweep that failed, wherever they ran."""
    new = [path for folder, old in _sweep.items() for path, _ in _results(folder) - old]
    return sorted(path.parent for path in new if "error" in json.loads(path.read_text()))


def _take(folder: Path, what: str = "run") -> None:
    path = folder / f".room.{os.getpid()}{PARTIAL}"
    try:
        take(folder)
        # fail here, where there are words for it, and not where Hydra writes its configuration
        with disk_words(folder):
            try:
                path.write_bytes(bytes(ROOM))
            finally:
                path.unlink(missing_ok=True)
    except NNodeError as error:
        end(error)
    except (OSError, ValueError) as error:  # a path that the system does not know how to make
        said = getattr(error, "strerror", None) or error
        end(
            WriteError(
                f"the folder {folder} cannot be made: {said}; choose another one with "
                f"hydra.{what}.dir="
            )
        )


def _results(folder: Path) -> set[tuple[Path, int]]:
    """Result files of the runs in a folder, with the time of their last change."""
    return {(path, path.stat().st_mtime_ns) for path in folder.rglob(RESULT)}


def _table(folder: Path) -> None:
    """Write the results of trainings into ``sweep.csv`` and print them; nothing for other jobs."""
    results = {
        path.parent.name: json.loads(path.read_text())
        for path in sorted(folder.glob(f"*/{RESULT}"), key=lambda p: (len(str(p)), p))
    }
    if not any("summary" in result for result in results.values()):
        return
    rows = [{"run": run, **result.pop("summary", result)} for run, result in results.items()]
    table = pd.DataFrame(rows)
    write_text(folder / "sweep.csv", csv_text(table))
    print(f"{len(rows)} runs", table.to_string(index=False, float_format="{:.5g}".format), sep="\n")
    print(f"table: {folder / 'sweep.csv'}")
