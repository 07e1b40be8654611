"""Formulas evaluated with NumPy or PyTorch by straight-line code that computes every node once.

Generating the code takes milliseconds, and a call of it makes one library call per node. This
suits searches over many models, each of which is simulated only a few times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.model.expression import Expr, topological
from nnode.model.operations import LIBRARIES, OPERATIONS

#: Maps the symbols' values and the values of precomputed nodes to the outputs' values. An output
#: that depends on no symbol is a number.
NumpyFunction = Callable[[Mapping[str, Any], tuple[Any, ...]], list[Any]]
#: A function that a formula calls by its name.
Code = Callable[..., Tensor]


@lru_cache(maxsize=1024)
def _straight_line(
    outputs: tuple[Expr, ...], precomputed: tuple[Expr, ...], library: str
) -> tuple[Callable[..., list[Any]], list[float]]:
    """A function of constants, symbol values, precomputed values and code; and the constants."""
    label = {node: f"k[{i}]" for i, node in enumerate(precomputed)}
    numbers: dict[str, float] = {}
    lines: list[str] = []
    for node in topological(outputs, label):
        args = [label[a] for a in node.args]
        label[node] = f"n{len(lines)}"
        if node.op == "const":
            label[node] = f"c{len(numbers)}"
            numbers[label[node]] = node.value
        elif node.op == "symbol":
            lines.append(f"{label[node]} = g[{node.value!r}]")
        elif node.op == "call":
            lines.append(f"{label[node]} = code[{node.value!r}]({', '.join(args)})")
        else:
            lines.append(f"{label[node]} = {OPERATIONS[node.op].code.format(*args)}")
    unpacking = [f"{', '.join(numbers)}, = c"] if numbers else []
    results = ", ".join(label[node] for node in outputs)
    body = "".join(f"    {line}\n" for line in [*unpacking, *lines, f"return [{results}]"])
    names = dict(LIBRARIES[library])
    exec(f"def run(c, g, k, code=None):\n{body}", names)
    return names["run"], list(numbers.values())


def numpy_function(outputs: tuple[Expr, ...], precomputed: tuple[Expr, ...] = ()) -> NumpyFunction:
    """A NumPy function of the symbols and the precomputed nodes.

    Args:
        outputs: formulas without calls of code.
        precomputed: nodes whose values are arguments of the function.
    """
    run, numbers = _straight_line(outputs, precomputed, "array")
    # Python floats would raise an error in a division by zero
    return partial(run, tuple(map(np.float64, numbers)))


def computed(
    outputs: Sequence[Expr],
    values: Mapping[str, Tensor],
    precomputed: Mapping[Expr, Tensor] | None = None,
    code: Mapping[str, Code] | None = None,
) -> list[Tensor]:
    """The values of formulas by PyTorch, differentiable by its automatic differentiation.

    Args:
        values: symbol to value.
        precomputed: node to value.
        code: name to the function that calls of this name evaluate.
    """
    precomputed = precomputed or {}
    run, numbers = _straight_line(tuple(outputs), tuple(precomputed), "tensor")
    like = next(iter(values.values()))
    constants = [torch.tensor(c, dtype=like.dtype, device=like.device) for c in numbers]
    return run(constants, values, tuple(precomputed.values()), code)
