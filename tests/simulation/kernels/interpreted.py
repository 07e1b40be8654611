"""Generated source of lanes in Python's interpreter, which is faster than a compilation."""

from __future__ import annotations

import math
import re
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from nnode.model.operations import LIBRARIES
from nnode.simulation.kernels.lanes import LaneSource

#: Rows are computed in multiples of this number.
CHUNK = 8


def _copy(target: Any, source: Any, number: int) -> None:
    target[:number] = source[:number].copy()


def _undecorated(*_: Any, **__: Any) -> Any:
    return lambda function: function


def _float(operation: Any, otherwise: float) -> Any:
    """A library function with the results of compiled code outside its domain."""

    def checked(x: float) -> float:
        try:
            return float(operation(x))
        except (ValueError, OverflowError):
            return otherwise

    return checked


#: The names that the generated source imports, for float64.
_NAMES: dict[str, Any] = {
    **LIBRARIES["number"],
    "njit": _undecorated,
    "INLINE": {},
    "LOOP": {},
    "copy": _copy,
    "real": lambda value, like: float(value),
    "add": lambda total, value: total + value,
    "exp": _float(math.exp, math.inf),
    "log": _float(math.log, math.nan),
    "sqrt": _float(math.sqrt, math.nan),
    # Python's integers are faster than NumPy's
    "np": SimpleNamespace(uint64=int, zeros=np.zeros, array=np.array),
}
#: Imports of the generated source.
_IMPORTS = re.compile(r"^(?:from \S+ )?import .*$", re.MULTILINE)


@cache
def interpreted(source: LaneSource) -> SimpleNamespace:
    """The module of a source, in place of :func:`nnode.simulation.kernels.runs.compiled`."""
    names = dict(_NAMES)
    exec(_IMPORTS.sub("", source.text()), names)
    names["CHUNK"] = CHUNK
    return SimpleNamespace(forward=names["forward"], backward=names.get("backward"))
