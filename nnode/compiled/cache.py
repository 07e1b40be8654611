"""Modules that are kept in a cache folder, so that Numba finds their compiled code again.

Numba stores compiled code beside the file that holds the function, and compiles again when this
file changes; changes of what it imports go unseen. A kept file therefore carries a digest of
everything that is compiled into it in its name.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

import llvmlite
import numba
import numpy as np
from platformdirs import user_cache_path

from nnode.errors import ConfigError


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

    Raises:
        ConfigError: the cache folder cannot be written.
    """
    path = cache_folder() / f"{name}.py"
    if not path.is_file():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # written aside: another process may want the same file
            with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
                file.write(text)
            os.replace(file.name, path)
        except OSError as error:
            raise ConfigError(
                f"cannot keep compiled code in {path.parent}: {error.strerror}; set the "
                "environment variable NNODE_CACHE to a folder that can be written"
            ) from error
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
