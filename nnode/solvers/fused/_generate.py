"""Compiled functions of a law: generated, so that Numba keeps them between processes.

Numba stores compiled code beside the file that holds the function, and compiles again when this
file changes; changes of what it imports go unseen. The generated file therefore carries a
digest of everything that it is made of in its name.
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
from platformdirs import user_cache_path

from nnode.errors import ConfigError
from nnode.solvers.fused import _math, _rows
from nnode.solvers.fused._templates import TEMPLATE
from nnode.solvers.fused.laws import LawKernel


def source(kernel: LawKernel) -> str:
    """The generated module's text."""
    names = range(kernel.size)

    def each(pattern: str, between: str = ", ") -> str:
        return between.join(pattern.format(j=j) for j in names)

    return TEMPLATE.format(
        share_module=kernel.share.__module__,
        share_name=kernel.share.__name__,
        pull_module=kernel.pull.__module__,
        pull_name=kernel.pull.__name__,
        q=each("q{j}"),
        a=each("a{j}") + ("," if kernel.size == 1 else ""),
        a_tuple=f"({each('a{j}')},)",
        d=each("d{j}"),
        zeros=f"({each('real(0, gap[0])')},)",
        adds=each("a{j} = add(a{j}, d{j})", "\n        "),
        shares0=each("shares[r, 0, {j}]"),
        sharesu=each("shares[r, u, {j}]"),
        sums0=each("sums[0, {j}] += a{j}", "\n            "),
        sumsu=each("sums[u, {j}] += a{j}", "\n                "),
        size=kernel.size,
        own=each("own[k + {j} * APART]"),
        own_adds=each(
            f"own[k + ({{j}} + {kernel.size}) * APART] += d{{j}}",
            "\n        ",
        ),
    )


def _digest(text: str, kernel: LawKernel) -> str:
    """Of the text, of every file whose code is compiled into it, and of the tools."""
    modules = {
        _math.__name__,
        _rows.__name__,
        kernel.share.__module__,
        kernel.pull.__module__,
    }
    found = hashlib.sha256(text.encode())
    for name in sorted(modules):
        file = sys.modules[name].__file__
        assert file is not None
        found.update(Path(file).read_bytes())
    found.update(f"{numba.__version__} {llvmlite.__version__} {np.__version__}".encode())
    return found.hexdigest()[:16]


def cache_folder() -> Path:
    """The folder of generated modules: NNODE_CACHE, else the user's own cache."""
    chosen = os.environ.get("NNODE_CACHE")
    return (Path(chosen) if chosen else user_cache_path("nnode")) / "fused"


@cache
def compiled(kernel: LawKernel) -> ModuleType:
    """The module with ``forward`` and ``backward`` of a law.

    Raises:
        ConfigError: the cache folder cannot be written.
    """
    text = source(kernel)
    name = f"nnode_fused_{_digest(text, kernel)}"
    path = cache_folder() / f"{name}.py"
    if not path.is_file():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # written aside: another process may want the same file
            with tempfile.NamedTemporaryFile(
                "w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8"
            ) as file:
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
