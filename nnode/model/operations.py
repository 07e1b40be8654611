"""The table of the operations of formulas.

A row defines the value for Python numbers, NumPy arrays, PyTorch tensors and compiled code, the
derivative, the rule for the unit, and the notation. Compiled code takes the named functions from
:mod:`nnode.simulation.kernels.functions`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.special import expit
from torch.nn.functional import softplus

#: A text with a field for every argument, and the precedence: 1 for a sum, 2 a product, 3 a sign,
#: 4 a power, 5 for text that never needs brackets. An argument is written in brackets if its
#: precedence is below the number in its field.
Notation = tuple[str, int]


@dataclass(frozen=True)
class Operation:
    """An operation of one to three arguments.

    Attributes:
        name: name of the operation, by which users' formulas call it.
        code: Python code of the value, with a field for every argument.
        slope: Python code of the derivatives by the arguments a, b, c, where f is the value.
        number: the function of this name that ``code`` calls, for Python numbers. It raises an
            error for arguments where it is undefined.
        array: this function for NumPy.
        tensor: this function for PyTorch.
        alike: indices of the arguments that must have the unit of the value.
        powers: exponents of the arguments' units in the value's unit. Without ``alike`` and
            ``powers``, arguments and value are dimensionless.
        plain: the notation that the parser reads; None for ``name(...)``.
        latex: the notation on pages; None for the plain notation.
        internal: whether users' formulas may not call it.
    """

    name: str
    code: str
    slope: str
    number: Callable[..., float] | None = None
    array: Callable[..., Any] | None = None
    tensor: Callable[..., torch.Tensor] | None = None
    alike: tuple[int, ...] = ()
    powers: tuple[float, ...] = ()
    plain: Notation | None = None
    latex: Notation | None = None
    internal: bool = False

    @property
    def arguments(self) -> int:
        return sum(field in self.code for field in ("{0}", "{1}", "{2}"))


def _everywhere(name: str, slope: str, **other: Any) -> Operation:
    """A function with the same name in all libraries."""
    functions = (getattr(library, name) for library in (math, np, torch))
    return Operation(name, name + "({0})", slope, *functions, **other)


def _logistic(a: float) -> float:
    return 1 / (1 + math.exp(-a)) if a > 0 else math.exp(a) / (1 + math.exp(a))


#: Operations by name. The softplus is PyTorch's, which is a for a > 20. ``max`` and ``min``
#: propagate NaN; where both arguments are equal, the derivative is by the first one. A sum as the
#: second summand is written in brackets, so that the parser restores the order of the additions.
OPERATIONS = {
    row.name: row
    for row in (
        Operation(
            "add",
            "{0} + {1}",
            "1, 1",
            alike=(0, 1),
            plain=("{0:1} + {1:2}", 1),
            latex=("{0:1} + {1:1}", 1),
        ),
        Operation("sub", "{0} - {1}", "1, -1", alike=(0, 1), plain=("{0:1} - {1:2}", 1)),
        Operation(
            "mul",
            "{0} * {1}",
            "b, a",
            powers=(1, 1),
            plain=("{0:2}*{1:3}", 2),
            latex=("{0:2}\\,{1:2}", 2),
        ),
        Operation("neg", "-{0}", "-1", powers=(1,), plain=("-{0:2}", 3)),
        Operation(
            "recip",
            "recip({0})",
            "-(f * f)",
            lambda a: 1 / a,
            partial(np.divide, 1.0),
            torch.reciprocal,
            powers=(-1,),
            plain=("1/{0:4}", 2),
            latex=("\\frac{{1}}{{{0}}}", 5),
        ),
        _everywhere("sqrt", "0.5 * recip(f)", powers=(0.5,), latex=("\\sqrt{{{0}}}", 5)),
        _everywhere("exp", "f"),
        _everywhere("log", "recip(a)"),
        _everywhere("tanh", "1 - f * f"),
        _everywhere("sin", "cos(a)"),
        _everywhere("cos", "-sin(a)"),
        Operation(
            "softplus",
            "softplus({0})",
            "softplus_slope(a)",
            lambda a: a if a > 20 else math.log1p(math.exp(a)),
            lambda a: np.where(a > 20, a, np.log1p(np.exp(np.minimum(a, 20.0)))),
            softplus,
        ),
        Operation(
            "softplus_slope",
            "softplus_slope({0})",
            "f * (1 - f)",
            lambda a: 1.0 if a > 20 else _logistic(a),
            lambda a: np.where(a > 20, 1.0, expit(a)),
            lambda a: torch.where(a > 20, 1.0, torch.sigmoid(a)),
            internal=True,
        ),
        Operation("logistic", "logistic({0})", "f * (1 - f)", _logistic, expit, torch.sigmoid),
        Operation(
            "max",
            "where(({1} > {0}) | ({1} != {1}), {1}, {0})",
            "choose(b - a, 0, 1), choose(b - a, 1, 0)",
            alike=(0, 1),
        ),
        Operation(
            "min",
            "where(({1} < {0}) | ({1} != {1}), {1}, {0})",
            "choose(a - b, 0, 1), choose(a - b, 1, 0)",
            alike=(0, 1),
        ),
        Operation(
            "choose",
            "where({0} > zero, {1}, {2})",
            "0, choose(a, 1, 0), choose(a, 0, 1)",
            alike=(1, 2),
        ),
    )
}

#: Function that users' formulas may call to its number of arguments.
FUNCTIONS = {
    name: row.arguments for name, row in OPERATIONS.items() if not (row.plain or row.internal)
}
#: Library to the functions that the operations' code calls.
LIBRARIES: dict[str, dict[str, Any]] = {
    "number": {"where": lambda condition, a, b: a if condition else b},
    "array": {"where": np.where},
    "tensor": {"where": torch.where},
}
for _library, _names in LIBRARIES.items():
    _names |= {row.name: getattr(row, _library) for row in OPERATIONS.values() if row.number}
    _names["zero"] = 0


def compiled(code: str, arguments: str, names: dict[str, Any]) -> Callable[..., Any]:
    """An operation's code as a function of arguments such as ``"f, a, b"``."""
    function: Callable[..., Any] = eval(f"lambda {arguments}: {code}", dict(names))
    return function
