"""Compiled crowd code that later processes find again.

The file is copied to the cache folder, see :mod:`nnode.simulate._cache`, and loaded from
there.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import ModuleType

import nnode.models.crowd
from nnode.simulate import _cache, _math, _polynomials, lane_rows
from nnode.simulate._cache import keep
from nnode.solvers.fused import crowd_laws, crowd_network, crowd_rows, neighbours

_COMPILED_IN = (
    _math,
    _polynomials,
    lane_rows,
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
