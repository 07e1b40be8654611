"""Locks of folders, so that a folder is used by one run at a time.

A lock is released when its process ends, also when the process is killed.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from nnode.errors import FolderInUseError
from nnode.files import PARTIAL, disk_words

log = logging.getLogger(__name__)

#: Name of the lock file, which names its holder.
LOCK = ".lock"

#: Errors of file systems without locks.
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}

_LEFTOVER = re.compile(rf"\..+\.\d+\{PARTIAL}")

#: Locks by process and folder; a forked process has none.
_held: dict[tuple[int, Path], FileLock] = {}


def take(folder: Path) -> None:
    """Lock a folder, which is created if it is missing. A process may lock it several times.

    Partly written files of killed runs are removed, except in folders of other runs.

    Raises:
        FolderInUseError: another process, which the message names, has the lock.
        WriteError: the folder cannot be written to.
    """
    key = os.getpid(), folder.resolve()
    if key in _held:
        _held[key].acquire()
        return
    with disk_words(folder):
        folder.mkdir(parents=True, exist_ok=True)
        # a short wait, because its holder may be removing the file
        lock = FileLock(key[1] / LOCK, timeout=0.1, thread_local=False, fallback_to_soft=False)
        try:
            lock.acquire()
        except Timeout:
            holder = ""
            with suppress(OSError):
                holder = (folder / LOCK).read_text(errors="replace")
            raise FolderInUseError(
                f"another run works in {folder} ({holder or 'unknown process'}); wait for its "
                "end, or choose another folder with hydra.run.dir="
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            log.warning(
                "%s cannot be locked (%s); do not use it for several runs at the same time",
                folder,
                error,
            )
        else:
            _held[key] = lock
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            words = f"process {os.getpid()} on {socket.gethostname()}, since {since}"
            (folder / LOCK).write_text(words)
        _remove_leftovers(folder)


def _remove_leftovers(folder: Path) -> None:
    """Remove partly written files of killed runs, except in folders of other runs.

    A folder with its own lock file belongs to another run, which may be active. The next run in
    that folder removes its partly written files.
    """
    for place, folders, files in os.walk(folder):
        if LOCK in files and Path(place) != folder:
            folders.clear()
            continue
        for name in [name for name in (*folders, *files) if _LEFTOVER.fullmatch(name)]:
            path = Path(place, name)
            if name in folders and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
            if name in folders:
                folders.remove(name)


def give(folder: Path) -> None:
    """Release a folder after as many calls as :func:`take`; without a lock, do nothing."""
    key = os.getpid(), folder.resolve()
    if key not in _held:
        return
    lock = _held[key]
    if lock.lock_counter == 1:
        del _held[key]
        with suppress(OSError):  # before the release, because the next holder creates a new file
            (folder / LOCK).unlink()
    lock.release()


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Lock a folder within the context.

    Raises:
        FolderInUseError, WriteError: see :func:`take`.
    """
    take(folder)
    try:
        yield
    finally:
        give(folder)
