"""Modules that are kept in a cache folder, so that Numba finds their compiled code again.

Numba stores compiled code beside the file that holds the function, and compiles again when this
file changes; changes of what it imports go unseen. A kept file therefore carries a digest of
everything that is compiled into it in its name.

A module and its compiled code are run as they lie there. Nobody else may therefore own the folder
or write to it, and a file whose text is another one is written again.
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

#: Where Python and Numba keep compiled code, beside the module.
_COMPILED = "__pycache__"
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_WAY_OUT = "set the environment variable NNODE_CACHE to a folder of your own that can be written"


def cache_folder() -> Path:
    """The folder of kept modules: NNODE_CACHE, else the user's own cache."""
    chosen = os.environ.get("NNODE_CACHE")
    return (Path(chosen) if chosen else user_cache_path("nnode")) / "fused"


def digest(text: bytes, compiled_in: Iterable[ModuleType]) -> str:
    """Of a file's text, of the files of modules that are compiled into it, and of the tools."""
    found = hashlib.sha256(text)
    for module in compiled_in:
        assert module.__file__ is not None
        found.update(Path(module.__file__).read_bytes())
    found.update(f"{numba.__version__} {llvmlite.__version__} {np.__version__}".encode())
    return found.hexdigest()[:16]


def keep(name: str, text: bytes) -> ModuleType:
    """The module ``name`` with the source ``text``, imported from the cache folder.

    Where the user's own cache cannot be used, a temporary folder of this process takes its place,
    and a warning says so. A folder that NNODE_CACHE names is used, or refused.

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
    """A folder that ends with the process; ``reason`` is what is wrong with the usual one."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="nnode-"))
    except OSError as error:
        raise ConfigError(f"{reason} (a temporary folder cannot be made: {error})") from error
    atexit.register(_remove, folder, os.getpid())
    log.warning("%s. Until then every process compiles anew, in %s", reason, folder)
    return folder


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:  # and not a fork of it
        shutil.rmtree(folder, ignore_errors=True)


def _kept(folder: Path, name: str, text: bytes) -> ModuleType:
    path = folder / f"{name}.py"
    try:
        _make(folder)
        if not (path.is_file() and path.read_bytes() == text):
            _write(path, text)
        module = _imported(name, path)
    except (OSError, RuntimeError) as error:  # the latter where Numba may not write anywhere
        found = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"cannot keep compiled code in {folder}: {found}; {_WAY_OUT}") from error
    for function in vars(module).values():
        if isinstance(function, Dispatcher):
            inner = cast(Any, function)
            if isinstance(inner._cache, FunctionCache):
                inner._cache = _Compiled(inner.py_func)
    return module


def _make(folder: Path) -> None:
    """Make the folder for its owner alone, or make sure that it is the owner's alone.

    Raises:
        ConfigError: others own it or may write to it.
        OSError: it cannot be made.
    """
    compiled = folder / _COMPILED
    for place in (*reversed(folder.parents), folder, compiled):
        if not place.is_dir():
            # where nothing may be written, files that are there can still be read
            with suppress(*[OSError] if place == compiled else []):
                place.mkdir(mode=0o700, exist_ok=True)
    if not hasattr(os, "getuid"):
        return
    for place in (folder.parent, folder, compiled):
        with suppress(FileNotFoundError):
            found = place.stat()
            writes = found.st_mode & _OTHERS_WRITE
            if place == folder.parent:
                # Groups of one's own are common, and in a folder such as /tmp nobody can put
                # something else in the place of what is another's.
                writes = 0 if found.st_mode & stat.S_ISVTX else found.st_mode & stat.S_IWOTH
            if writes or found.st_uid not in (0, os.getuid()):
                what = "others may write to" if writes else f"user {found.st_uid} owns"
                remove = "" if place == folder.parent else f"remove {place}, or "
                raise ConfigError(
                    f"compiled code in {folder} is not trusted, because {what} {place}; {remove}"
                    f"{_WAY_OUT}"
                )


def _write(path: Path, text: bytes) -> None:
    """Write a file at once: another process may want the same one."""
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
    """Compiled code in files: damaged ones are made again, and a full disk ends no simulation."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # a damaged file leads to almost any error
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
