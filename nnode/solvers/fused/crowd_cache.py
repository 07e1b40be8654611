"""Compiled crowd code that later processes find again.

The file is copied to the cache folder, see :mod:`nnode.solvers.fused._cache`, and loaded from
there.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import ModuleType

import nnode.models.crowd
from nnode.solvers.fused import (
    _cache,
    _math,
    _polynomials,
    _rows,
    crowd_laws,
    crowd_network,
    crowd_rows,
    neighbours,
)
from nnode.solvers.fused._cache import keep

_COMPILED_IN = (
    _math,
    _polynomials,
    _rows,
    crowd_laws,
    crowd_network,
    crowd_rows,
    neighbours,
    nnode.models.crowd,
)


def digest(text: bytes) -> str:
    """Of a file's text, of the files that are compiled into it, and of the tools."""
    return _cache.digest(text, _COMPILED_IN)


@cache
def load(name: str) -> ModuleType:
    """The module of this folder called ``name``, with functions kept between processes.

    Raises:
        ConfigError: the cache folder cannot be written.
    """
    text = Path(__file__).with_name(f"{name}.py").read_bytes()
    return keep(f"nnode_{name}_{digest(text)}", text)
