"""Formulas as straight-line functions of NumPy arrays, every part computed once.

Such a function takes milliseconds to make, and a call of it one NumPy call a node: what a search
over many models needs, each of which is simulated a few times only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import expit

from nnode.model.expression import Expr, topological

#: Of symbols' values, and of those of nodes that are known, the outputs' values: arrays, or
#: numbers where an output depends on nothing else.
NumpyFunction = Callable[[Mapping[str, Any], tuple[Any, ...]], list[Any]]

#: What a node is in Python, by operation; as PyTorch computes it, but for rounding.
OPERATIONS = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "neg": "-{0}",
    "recip": "1.0 / {0}",
    "max": "where(({1} > {0}) | ({1} != {1}), {1}, {0})",
    "min": "where(({1} < {0}) | ({1} != {1}), {1}, {0})",
    "choose": "where({0} > 0, {1}, {2})",
    **{name: name + "({0})" for name in ("sqrt", "exp", "log", "tanh", "sin", "cos")},
    **{name: name + "({0})" for name in ("softplus", "softplus_slope", "logistic")},
}


def _softplus(a: Any) -> Any:
    return np.where(a > 20, a, np.log1p(np.exp(np.minimum(a, 20.0))))


_NAMES: dict[str, Any] = {
    **{name: getattr(np, name) for name in ("where", "sqrt", "exp", "log", "tanh", "sin", "cos")},
    "softplus": _softplus,
    "softplus_slope": lambda a: np.where(a > 20, 1.0, expit(a)),
    "logistic": expit,
}


@lru_cache(maxsize=1024)
def numpy_function(outputs: tuple[Expr, ...], known: tuple[Expr, ...] = ()) -> NumpyFunction:
    """A function of symbols and of known nodes.

    Args:
        outputs: formulas without calls of code.
        known: nodes that are computed already.
    """
    label = {node: f"k[{i}]" for i, node in enumerate(known)}
    lines: list[str] = []
    names = dict(_NAMES)
    for node in topological(outputs, label):
        if node.op == "const":
            label[node] = f"c{len(names)}"
            # Python's own numbers would raise where one is divided by zero
            names[label[node]] = np.float64(node.value)
            continue
        text = f"g[{node.value!r}]"
        if node.op != "symbol":
            text = OPERATIONS[node.op].format(*(label[a] for a in node.args))
        label[node] = f"n{len(lines)}"
        lines.append(f"    {label[node]} = {text}\n")
    found = ", ".join(label[node] for node in outputs)
    exec("def run(g, k):\n" + "".join(lines) + f"    return [{found}]\n", names)
    run: NumpyFunction = names["run"]
    return run
