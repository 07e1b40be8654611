"""A run's folder belongs to it: before Hydra writes anything there, the folder is taken."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from nnode.app.cli.run import Escape
from nnode.errors import NNodeError
from nnode.files import PARTIAL, disk_words
from nnode.lock import give, take

#: Bytes that Hydra writes of a configuration, at most.
ROOM = 1 << 15


class OneRunPerFolder(Callback):
    """Refuses a second run, or a second sweep, in a folder where one is at work."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        _take(config.hydra.run.dir)

    def on_run_end(self, config: DictConfig, **kwargs: Any) -> None:
        give(Path(config.hydra.run.dir))

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        _take(config.hydra.sweep.dir)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        give(Path(config.hydra.sweep.dir))


def _take(folder: str) -> None:
    try:
        take(Path(folder))
        with disk_words(Path(folder)):
            _try_room(Path(folder))
    except NNodeError as error:
        # Hydra makes warnings of a callback's exceptions, but not of this one
        raise Escape(error) from None


def _try_room(folder: Path) -> None:
    """Fail here, where there are words for it, and not where Hydra writes its configuration."""
    path = folder / f".room.{os.getpid()}{PARTIAL}"
    try:
        path.write_bytes(bytes(ROOM))
    finally:
        path.unlink(missing_ok=True)
