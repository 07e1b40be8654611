"""Compiled crowd code that later processes find again.

Numba keeps compiled functions beside the file they stand in and does not see when something
that this file imports has changed. Therefore the file is copied to the cache folder, under a
name with a digest of all files that are compiled into it, and loaded from there.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from functools import cache
from pathlib import Path
from types import ModuleType

import llvmlite
import numba
import numpy as np

import nnode.models.crowd
from nnode.errors import ConfigError
from nnode.solvers.fused import _math, _rows, crowd_laws, crowd_network, crowd_rows, neighbours
from nnode.solvers.fused._generate import cache_folder

_COMPILED_IN = (_math, _rows, crowd_laws, crowd_network, crowd_rows, neighbours, nnode.models.crowd)


def digest(text: bytes) -> str:
    """Of a file's text, of the files that are compiled into it, and of the tools."""
    found = hashlib.sha256(text)
    for module in _COMPILED_IN:
        assert module.__file__ is not None
        found.update(Path(module.__file__).read_bytes())
    found.update(f"{numba.__version__} {llvmlite.__version__} {np.__version__}".encode())
    return found.hexdigest()[:16]


@cache
def load(name: str) -> ModuleType:
    """The module of this folder called ``name``, with functions kept between processes.

    Raises:
        ConfigError: the cache folder cannot be written.
    """
    text = Path(__file__).with_name(f"{name}.py").read_bytes()
    title = f"nnode_{name}_{digest(text)}"
    path = cache_folder() / f"{title}.py"
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
    spec = importlib.util.spec_from_file_location(title, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[title] = module
    spec.loader.exec_module(module)
    return module
