"""Formulas evaluated with NumPy or PyTorch by straight-line code that computes every node once.

Generating the code takes milliseconds, and a call of it makes one library call per node. This
suits searches over many models, each of which is simulated only a few times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nnode.model.expression import Expr, topological
from nnode.model.operations import LIBRARIES, OPERATIONS

#: A function that a formula calls by its name.
Code = Callable[..., Tensor]


@lru_cache(maxsize=1024)
def _straight_line(
    outputs: tuple[Expr, ...], given: tuple[Expr, ...], library: str
) -> tuple[Callable[..., list[Any]], list[float]]:
    """A function of constants, symbol values, given values and code; and the constants."""
    label = {node: f"k[{i}]" for i, node in enumerate(given)}
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


class Formulas:
    """Formulas as a function of their symbols' values, which are tensors or NumPy arrays.

    An output that depends on no symbol is a number. Values of tensors are differentiable by
    PyTorch's automatic differentiation.

    Args:
        outputs: the formulas.
        given: nodes of the formulas whose values are arguments.
    """

    def __init__(self, outputs: Iterable[Expr], given: Sequence[Expr] = ()) -> None:
        self.outputs, self.given = tuple(outputs), tuple(given)

    @cached_property
    def _numpy(self) -> Callable[..., list[Any]]:
        run, numbers = _straight_line(self.outputs, self.given, "array")
        # Python floats would raise an error in a division by zero
        return partial(run, tuple(map(np.float64, numbers)))

    def __call__(
        self,
        values: Mapping[str, Any],
        given: Sequence[Any] = (),
        code: Mapping[str, Code] | None = None,
    ) -> list[Any]:
        """The formulas' values.

        Args:
            values: symbol to value.
            given: values of the given nodes.
            code: name to the function that calls of this name evaluate; only for tensors.
        """
        like = next(iter(values.values()))
        if not isinstance(like, Tensor):
            return self._numpy(values, given)
        run, numbers = _straight_line(self.outputs, self.given, "tensor")
        constants = [torch.tensor(c, dtype=like.dtype, device=like.device) for c in numbers]
        return run(constants, values, given, code)
