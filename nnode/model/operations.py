"""The operations of formulas: one row each, which everything else reads.

A row gives the value for numbers of Python, arrays of NumPy, tensors of PyTorch and compiled code,
the derivative, the rule for the unit, and the notation. Compiled code takes the functions that a
row names from :mod:`nnode.simulate.kernels.functions`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.special import expit
from torch.nn.functional import softplus

#: How tightly a notation binds.
SUM, PRODUCT, SIGN, POWER, ATOM = 1, 2, 3, 4, 5


class Notation(NamedTuple):
    """How an operation is written.

    Attributes:
        text: with a field for every argument.
        level: how tightly it binds.
        least: of every argument, how tightly it must bind to stand without brackets.
    """

    text: str
    level: int
    least: tuple[int, ...]


@dataclass(frozen=True)
class Operation:
    """An operation of one to three arguments.

    Attributes:
        name: of the operation; public ones are called by it in formulas.
        code: Python code of the value, with a field for every argument.
        slope: Python code of the derivatives by the arguments a, b, c, where f is the value.
        alike: arguments that have one unit, which is that of the value.
        powers: exponents of the arguments' units in the value's. Without ``alike`` and ``powers``
            arguments and value are numbers without unit.
        plain: the notation that is read again; None for ``name(...)``.
        latex: the notation on pages; None for ``name(...)``.
        public: whether a user's formula may call it.
        number: the function that ``code`` names, for Python's numbers; an error if undefined.
        array: that function for NumPy.
        tensor: that function for PyTorch.
    """

    name: str
    code: str
    slope: str
    alike: tuple[int, ...] = ()
    powers: tuple[float, ...] = ()
    plain: Notation | None = None
    latex: Notation | None = None
    public: bool = False
    number: Callable[..., float] | None = None
    array: Callable[..., Any] | None = None
    tensor: Callable[..., torch.Tensor] | None = None

    @property
    def arguments(self) -> int:
        return sum(field in self.code for field in ("{0}", "{1}", "{2}"))


def _function(
    name: str,
    slope: str,
    number: Callable[..., float],
    array: Callable[..., Any],
    tensor: Callable[..., torch.Tensor],
    **other: Any,
) -> Operation:
    """A function of one argument, which every library has."""
    row = {"public": True, "number": number, "array": array, "tensor": tensor, **other}
    return Operation(name, name + "({0})", slope, **row)


def _logistic(a: float) -> float:
    return 1 / (1 + math.exp(-a)) if a > 0 else math.exp(a) / (1 + math.exp(a))


#: Operations by name. The softplus is PyTorch's: a itself beyond 20. What is no number stays none
#: in ``max`` and ``min``; where both arguments are equal, the slope is that of the first.
OPERATIONS = {
    row.name: row
    for row in (
        Operation(
            "add",
            "{0} + {1}",
            "1, 1",
            alike=(0, 1),
            # a sum that is added stays in brackets, so that it is read as it was written
            plain=Notation("{0} + {1}", SUM, (SUM, SUM + 1)),
            latex=Notation("{0} + {1}", SUM, (SUM, SUM)),
        ),
        Operation(
            "sub",
            "{0} - {1}",
            "1, -1",
            alike=(0, 1),
            plain=Notation("{0} - {1}", SUM, (SUM, SUM + 1)),
            latex=Notation("{0} - {1}", SUM, (SUM, SUM + 1)),
        ),
        Operation(
            "mul",
            "{0} * {1}",
            "b, a",
            powers=(1, 1),
            plain=Notation("{0}*{1}", PRODUCT, (PRODUCT, PRODUCT + 1)),
            latex=Notation("{0}\\,{1}", PRODUCT, (PRODUCT, PRODUCT)),
        ),
        Operation(
            "neg",
            "-{0}",
            "-1",
            powers=(1,),
            plain=Notation("-{0}", SIGN, (PRODUCT,)),
            latex=Notation("-{0}", SIGN, (PRODUCT,)),
        ),
        _function(
            "recip",
            "-(f * f)",
            lambda a: 1 / a,
            partial(np.divide, 1.0),
            torch.reciprocal,
            powers=(-1,),
            plain=Notation("1/{0}", PRODUCT, (POWER,)),
            latex=Notation("\\frac{{1}}{{{0}}}", ATOM, (SUM,)),
            public=False,
        ),
        _function(
            "sqrt",
            "0.5 * recip(f)",
            math.sqrt,
            np.sqrt,
            torch.sqrt,
            powers=(0.5,),
            latex=Notation("\\sqrt{{{0}}}", ATOM, (SUM,)),
        ),
        _function("exp", "f", math.exp, np.exp, torch.exp),
        _function("log", "recip(a)", math.log, np.log, torch.log),
        _function("tanh", "1 - f * f", math.tanh, np.tanh, torch.tanh),
        _function("sin", "cos(a)", math.sin, np.sin, torch.sin),
        _function("cos", "-sin(a)", math.cos, np.cos, torch.cos),
        _function(
            "softplus",
            "softplus_slope(a)",
            lambda a: a if a > 20 else math.log1p(math.exp(a)),
            lambda a: np.where(a > 20, a, np.log1p(np.exp(np.minimum(a, 20.0)))),
            softplus,
        ),
        _function(
            "softplus_slope",
            "f * (1 - f)",
            lambda a: 1.0 if a > 20 else _logistic(a),
            lambda a: np.where(a > 20, 1.0, expit(a)),
            lambda a: torch.where(a > 20, 1.0, torch.sigmoid(a)),
            public=False,
        ),
        _function("logistic", "f * (1 - f)", _logistic, expit, torch.sigmoid),
        Operation(
            "max",
            "where(({1} > {0}) | ({1} != {1}), {1}, {0})",
            "1 - choose(b - a, 1, 0), choose(b - a, 1, 0)",
            alike=(0, 1),
            public=True,
        ),
        Operation(
            "min",
            "where(({1} < {0}) | ({1} != {1}), {1}, {0})",
            "1 - choose(a - b, 1, 0), choose(a - b, 1, 0)",
            alike=(0, 1),
            public=True,
        ),
        Operation(
            "choose",
            "where({0} > zero, {1}, {2})",
            "0, choose(a, 1, 0), choose(a, 0, 1)",
            alike=(1, 2),
            public=True,
        ),
    )
}

#: Numbers of arguments of the functions that formulas of users may call.
FUNCTIONS = {name: row.arguments for name, row in OPERATIONS.items() if row.public}
#: Names that code of operations contains, in the libraries that formulas are computed with.
LIBRARIES: dict[str, dict[str, Any]] = {
    "number": {"where": lambda condition, a, b: a if condition else b},
    "array": {"where": np.where},
    "tensor": {"where": torch.where},
}
for _library, _names in LIBRARIES.items():
    _names |= {name: getattr(row, _library) for name, row in OPERATIONS.items()} | {"zero": 0}


def compiled(code: str, arguments: str, names: dict[str, Any]) -> Callable[..., Any]:
    """Code of a row as a function of arguments such as ``"f, a, b"``."""
    function: Callable[..., Any] = eval(f"lambda {arguments}: {code}", dict(names))
    return function
