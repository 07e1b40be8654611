"""The folders of runs and sweeps: locks at the start, and the table of a sweep at the end.

Runs of a sweep may be other processes, on other machines. Their only output are files.
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
from nnode.files import PARTIAL, disk_words, write_csv
from nnode.lock import give, take

#: File with the result of a run, or its error, in its folder.
RESULT = "result.json"

#: Largest number of bytes of the configuration files that Hydra writes.
ROOM = 1 << 15

#: Folder of this process's sweep to the result files that existed before it.
_sweep: dict[Path, set[tuple[Path, int]]] = {}


class Runs(Callback):
    """Refuses a second run or sweep in a folder in use, and collects a sweep's results."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        # the folder's name may contain a missing option, for which Hydra raises an error later
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
    """Formatter that makes log messages printable, because they may contain names from files."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))


def end(error: NNodeError) -> NoReturn:
    """Print an error, and end the process with its exit status.

    If all processes have the error, the first one prints it, and they end together.
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
    """Print a message to standard error."""
    print(text, file=sys.stderr, flush=True)


def failures() -> list[Path]:
    """Folders of the failed runs of this process's sweep."""
    new = [path for folder, old in _sweep.items() for path, _ in _results(folder) - old]
    return sorted(path.parent for path in new if "error" in json.loads(path.read_text()))


def _take(folder: Path, what: str = "run") -> None:
    path = folder / f".room.{os.getpid()}{PARTIAL}"
    try:
        take(folder)
        # a full disk is detected here, because Hydra's error would be less clear
        with disk_words(folder):
            try:
                path.write_bytes(bytes(ROOM))
            finally:
                path.unlink(missing_ok=True)
    except NNodeError as error:
        end(error)
    except (OSError, ValueError) as error:  # the system cannot create the path
        reason = getattr(error, "strerror", None) or error
        end(
            WriteError(
                f"the folder {folder} cannot be made: {reason}; choose another one with "
                f"hydra.{what}.dir="
            )
        )


def _results(folder: Path) -> set[tuple[Path, int]]:
    """Result files of the runs in a folder, with their modification times."""
    return {(path, path.stat().st_mtime_ns) for path in folder.rglob(RESULT)}


def _table(folder: Path) -> None:
    """Write the results of trainings to ``sweep.csv``, and print them; nothing for other jobs."""
    results = {
        path.parent.name: json.loads(path.read_text())
        for path in sorted(folder.glob(f"*/{RESULT}"), key=lambda p: (len(str(p)), p))
    }
    if not any("summary" in result for result in results.values()):
        return
    rows = [{"run": run, **result.pop("summary", result)} for run, result in results.items()]
    table = pd.DataFrame(rows)
    path = write_csv(folder / "sweep.csv", table)
    print(f"{len(rows)} runs", table.to_string(index=False, float_format="{:.5g}".format), sep="\n")
    print(f"table: {path}")
