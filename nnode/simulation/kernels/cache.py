"""Generated modules in a cache folder, where Numba reuses their compiled code.

Numba stores compiled code next to the source file, and compiles again when this file changes. It
does not notice changes of imported modules. The name of a stored file therefore contains a digest
of everything that is compiled into it.

Stored modules and compiled code are executed. Therefore no other user may own the folder or write
to it, and a file with a different text is written again.
"""

from __future__ import annotations

import atexit
import hashlib
import importlib.util
import logging
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import llvmlite
import numba
import numpy as np
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from platformdirs import user_cache_path

from nnode.errors import ConfigError

log = logging.getLogger(__name__)

#: Subfolder in which Python and Numba store compiled code.
_COMPILED = "__pycache__"
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_WAY_OUT = "set the environment variable NNODE_CACHE to a folder of your own that can be written"


def cache_folder() -> Path:
    """The folder of stored modules: NNODE_CACHE, or else the user's cache folder."""
    chosen = os.environ.get("NNODE_CACHE")
    return (Path(chosen) if chosen else user_cache_path("nnode")) / "fused"


def digest(text: bytes, compiled_in: Iterable[ModuleType]) -> str:
    """Digest of a module's text, of the modules that are compiled into it, and of the versions of
    the tools."""
    hash_ = hashlib.sha256(text)
    for module in compiled_in:
        assert module.__file__ is not None
        hash_.update(Path(module.__file__).read_bytes())
    hash_.update(f"{numba.__version__} {llvmlite.__version__} {np.__version__}".encode())
    return hash_.hexdigest()[:16]


def keep(name: str, text: bytes) -> ModuleType:
    """The module ``name`` with the source ``text``, imported from the cache folder.

    If the user's cache folder cannot be used, a temporary folder of this process replaces it with
    a warning. There is no replacement for a folder that NNODE_CACHE names.

    Raises:
        ConfigError: the cache folder cannot be written, or others own it or may write to it.
    """
    try:
        return _kept(cache_folder(), name, text)
    except ConfigError as error:
        if os.environ.get("NNODE_CACHE"):
            raise
        return _kept(_temporary_folder(str(error)), name, text)


@cache
def _temporary_folder(reason: str) -> Path:
    """A folder that is removed at the end of the process.

    Args:
        reason: why the default folder cannot be used, for the warning.
    """
    try:
        folder = Path(tempfile.mkdtemp(prefix="nnode-"))
    except OSError as error:
        raise ConfigError(f"{reason} (a temporary folder cannot be made: {error})") from error
    atexit.register(_remove, folder, os.getpid())
    log.warning("%s. Until then every process compiles anew, in %s", reason, folder)
    return folder


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:  # a fork must not remove it
        shutil.rmtree(folder, ignore_errors=True)


def _kept(folder: Path, name: str, text: bytes) -> ModuleType:
    path = folder / f"{name}.py"
    try:
        _make(folder)
        if not (path.is_file() and path.read_bytes() == text):
            _write(path, text)
        module = _imported(name, path)
    except (OSError, RuntimeError) as error:  # Numba raises RuntimeError if it cannot write
        problem = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(
            f"cannot keep compiled code in {folder}: {problem}; {_WAY_OUT}"
        ) from error
    for function in vars(module).values():
        if isinstance(function, Dispatcher):
            inner = cast(Any, function)
            if isinstance(inner._cache, FunctionCache):
                inner._cache = _Compiled(inner.py_func)
    return module


def _make(folder: Path) -> None:
    """Create the folder with access for its owner only, or check the access to it.

    Raises:
        ConfigError: another user owns it or may write to it.
        OSError: it cannot be created.
    """
    compiled = folder / _COMPILED
    for place in (*reversed(folder.parents), folder, compiled):
        if not place.is_dir():
            # existing files can be used even if the folder is read-only
            with suppress(*[OSError] if place == compiled else []):
                place.mkdir(mode=0o700, exist_ok=True)
    if not hasattr(os, "getuid"):
        return
    for place in (folder.parent, folder, compiled):
        with suppress(FileNotFoundError):
            status = place.stat()
            writes = status.st_mode & _OTHERS_WRITE
            if place == folder.parent:
                # Groups with one user are common. In a folder with the sticky bit, such as /tmp,
                # users cannot replace each other's files.
                writes = 0 if status.st_mode & stat.S_ISVTX else status.st_mode & stat.S_IWOTH
            if writes or status.st_uid not in (0, os.getuid()):
                what = "others may write to" if writes else f"user {status.st_uid} owns"
                remove = "" if place == folder.parent else f"remove {place}, or "
                raise ConfigError(
                    f"compiled code in {folder} is not trusted, because {what} {place}; {remove}"
                    f"{_WAY_OUT}"
                )


def _write(path: Path, text: bytes) -> None:
    """Write a file atomically, because another process may write the same file."""
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        try:
            file.write(text)
            file.close()
            os.replace(file.name, path)
        except BaseException:
            with suppress(OSError):
                os.unlink(file.name)
            raise


def _imported(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


class _Compiled(FunctionCache):
    """Numba's cache that replaces damaged files, and tolerates a full disk."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # damaged files cause many kinds of errors
            log.info(
                "compiled code in %s cannot be read (%s) and is made again", self.cache_path, error
            )
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            log.warning(
                "compiled code is not kept in %s: %s; %s", self.cache_path, error.strerror, _WAY_OUT
            )
