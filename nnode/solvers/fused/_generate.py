"""Compiled functions of a law: generated, so that Numba keeps them between processes."""

from __future__ import annotations

import sys
from functools import cache
from types import ModuleType

from nnode.models import traffic
from nnode.solvers.fused import _math, _polynomials, _rows
from nnode.solvers.fused._cache import digest, keep
from nnode.solvers.fused._templates import TEMPLATE
from nnode.solvers.fused.laws import LawKernel

#: Compiled into every law besides its own functions; the laws take a number from ``traffic``.
_COMPILED_IN = (_math, _polynomials, _rows, traffic)


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
    modules = {module.__name__ for module in _COMPILED_IN}
    modules |= {kernel.share.__module__, kernel.pull.__module__}
    return digest(text.encode(), [sys.modules[name] for name in sorted(modules)])


@cache
def compiled(kernel: LawKernel) -> ModuleType:
    """The module with ``forward`` and ``backward`` of a law.

    Raises:
        ConfigError: the cache folder cannot be written.
    """
    text = source(kernel)
    name = f"nnode_fused_{_digest(text, kernel)}"
    return keep(name, text.encode())
