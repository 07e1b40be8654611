"""One run at a time in a folder.

The lock belongs to the process, not to the file: one that was killed blocks nobody.
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

#: Name of the lock's file, which tells who holds it.
LOCK = ".lock"

#: What a file system answers that knows no locks.
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}

_REST = re.compile(rf"\..+\.\d+\{PARTIAL}")

#: Locks of this process by folder; one that was forked holds none.
_held: dict[tuple[int, Path], FileLock] = {}


def take(folder: Path) -> None:
    """Take the folder, which is made where it is missing; a process may take it several times.

    What a killed run left half written is removed, except below folders that other runs have taken.

    Raises:
        FolderInUseError: another process has it; says which.
        WriteError: the folder cannot be written to.
    """
    key = os.getpid(), folder.resolve()
    if key in _held:
        _held[key].acquire()
        return
    with disk_words(folder):
        folder.mkdir(parents=True, exist_ok=True)
        # a moment, for a file that its holder removes just now
        lock = FileLock(key[1] / LOCK, timeout=0.1, thread_local=False, fallback_to_soft=False)
        try:
            lock.acquire()
        except Timeout:
            holder = ""
            with suppress(OSError):
                holder = (folder / LOCK).read_text(errors="replace")
            raise FolderInUseError(
                f"another run works in {folder} ({holder or 'it does not say which'}); wait for "
                "its end, or choose another folder with hydra.run.dir="
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            log.warning("%s cannot be locked (%s): use it for one run at a time", folder, error)
        else:
            _held[key] = lock
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            words = f"process {os.getpid()} on {socket.gethostname()}, since {since}"
            (folder / LOCK).write_text(words)
        _remove_rests(folder)


def _remove_rests(folder: Path) -> None:
    """Remove what killed runs left half written, but not below folders of other runs.

    A folder with a lock file of its own belongs to another run. That run may be at work, and if it
    was killed, the next run in its folder removes what it left.
    """
    for place, folders, files in os.walk(folder):
        if LOCK in files and Path(place) != folder:
            folders.clear()
            continue
        for name in [name for name in (*folders, *files) if _REST.fullmatch(name)]:
            path = Path(place, name)
            if name in folders and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
            if name in folders:
                folders.remove(name)


def give(folder: Path) -> None:
    """Give the folder back, when as often as it was taken; nothing happens without it."""
    key = os.getpid(), folder.resolve()
    if key not in _held:
        return
    lock = _held[key]
    if lock.lock_counter == 1:
        del _held[key]
        with suppress(OSError):  # while it is still held: a later one makes a new file
            (folder / LOCK).unlink()
    lock.release()


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Nobody else works in ``folder`` inside the context.

    Raises:
        FolderInUseError, WriteError: see :func:`take`.
    """
    take(folder)
    try:
        yield
    finally:
        give(folder)
