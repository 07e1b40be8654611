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

from nnode.errors import FolderInUseError
from nnode.files import PARTIAL, disk_words

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows has no such locks, and goes without
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

#: Name of the lock's file, which tells who holds it.
LOCK = ".lock"

#: What a file system answers that knows no locks.
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}

_REST = re.compile(rf"\..+\.\d+\{PARTIAL}")

#: Locks by process and folder: file descriptor and how often it was taken.
_held: dict[tuple[int, Path], list[int]] = {}


def take(folder: Path) -> None:
    """Take the folder, which is made where it is missing; a process may take it several times.

    What a killed run left half written is removed: nobody is at work on it any more.

    Raises:
        FolderInUseError: another process has it; says which.
        WriteError: the folder cannot be written to.
    """
    key = os.getpid(), folder.resolve()
    if key in _held:
        _held[key][1] += 1
        return
    with disk_words(folder):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = _locked(folder)
        if descriptor is not None:
            _held[key] = [descriptor, 1]
        for path in folder.rglob(f".*{PARTIAL}"):
            if _REST.fullmatch(path.name):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def give(folder: Path) -> None:
    """Give the folder back, when as often as it was taken; nothing happens without it."""
    key = os.getpid(), folder.resolve()
    if key not in _held:
        return
    _held[key][1] -= 1
    if _held[key][1] == 0:
        descriptor = _held.pop(key)[0]
        with suppress(OSError):  # while it is still held: a later one makes a new file
            (folder / LOCK).unlink()
        os.close(descriptor)


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


def _locked(folder: Path) -> int | None:
    """A locked descriptor of the folder's lock file; None where there are no locks."""
    path = folder / LOCK
    while fcntl is not None:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            # not inherited by processes that are forked, so that none of them can outlive it
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.read(descriptor, 200).decode(errors="replace").strip()
            os.close(descriptor)
            if error.errno in _NO_LOCKS:
                log.warning("%s cannot be locked (%s): use it for one run at a time", folder, error)
                return None
            raise FolderInUseError(
                f"another run works in {folder} ({holder or 'it does not say which'}); wait for "
                "its end, or choose another folder with hydra.run.dir="
            ) from None
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                os.ftruncate(descriptor, 0)
                since = time.strftime("%Y-%m-%d %H:%M:%S")
                words = f"process {os.getpid()} on {socket.gethostname()}, since {since}"
                os.write(descriptor, words.encode())
                return descriptor
        os.close(descriptor)  # it was given back, and removed, between opening and locking
    return None  # pragma: no cover
