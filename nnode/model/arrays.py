"""Formulas computed with NumPy or PyTorch: straight-line code, every part computed once.

Such code takes milliseconds to make, and a call of it one call of the library a node: what a
search over many models needs, each of which is simulated a few times only.
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

#: Of symbols' values, and of those of nodes that are known, the outputs' values: arrays, or
#: numbers where an output depends on nothing else.
NumpyFunction = Callable[[Mapping[str, Any], tuple[Any, ...]], list[Any]]
#: What a call in a formula stands for.
Code = Callable[..., Tensor]


@lru_cache(maxsize=1024)
def _straight_line(
    outputs: tuple[Expr, ...], known: tuple[Expr, ...], library: str
) -> tuple[Callable[..., list[Any]], list[float]]:
    """A function of numbers, values of symbols, values of known nodes and code; and its numbers."""
    label = {node: f"k[{i}]" for i, node in enumerate(known)}
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
    given = [f"{', '.join(numbers)}, = c"] if numbers else []
    results = ", ".join(label[node] for node in outputs)
    body = "".join(f"    {line}\n" for line in [*given, *lines, f"return [{results}]"])
    names = dict(LIBRARIES[library])
    exec(f"def run(c, g, k, code=None):\n{body}", names)
    return names["run"], list(numbers.values())


def numpy_function(outputs: tuple[Expr, ...], known: tuple[Expr, ...] = ()) -> NumpyFunction:
    """A function of symbols and of known nodes.

    Args:
        outputs: formulas without calls of code.
        known: nodes that are computed already.
    """
    run, numbers = _straight_line(outputs, known, "array")
    # Python's own numbers would raise where one is divided by zero
    return partial(run, tuple(map(np.float64, numbers)))


def computed(
    outputs: Sequence[Expr],
    values: Mapping[str, Tensor],
    known: Mapping[Expr, Tensor] | None = None,
    code: Mapping[str, Code] | None = None,
) -> list[Tensor]:
    """Formulas from the values of their symbols with PyTorch, differentiable as PyTorch is.

    Args:
        known: values of nodes that are computed already.
        code: what calls stand for.
    """
    known = known or {}
    run, numbers = _straight_line(tuple(outputs), tuple(known), "tensor")
    like = next(iter(values.values()))
    constants = [torch.tensor(c, dtype=like.dtype, device=like.device) for c in numbers]
    return run(constants, values, tuple(known.values()), code)
