"""Formulas computed with PyTorch: one operation a node, differentiable as PyTorch is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.functional import softplus

from nnode.model.expression import Expr, topological

Code = Callable[..., Tensor]
#: Functions of a node's arguments, by operation.
OPERATIONS: dict[str, Code] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "neg": torch.neg,
    "recip": torch.reciprocal,
    "sqrt": torch.sqrt,
    "exp": torch.exp,
    "log": torch.log,
    "tanh": torch.tanh,
    "sin": torch.sin,
    "cos": torch.cos,
    "softplus": softplus,
    "softplus_slope": lambda a: torch.where(a > 20, 1.0, torch.sigmoid(a)),
    "logistic": torch.sigmoid,
    "max": lambda a, b: torch.where((b > a) | (b != b), b, a),
    "min": lambda a, b: torch.where((b < a) | (b != b), b, a),
    "choose": lambda a, b, c: torch.where(a > 0, b, c),
}


def computed(
    outputs: Sequence[Expr],
    values: Mapping[str, Tensor],
    known: dict[Expr, Tensor] | None = None,
    code: Mapping[str, Code] | None = None,
) -> list[Tensor]:
    """Formulas from the values of their symbols.

    Args:
        known: nodes that are computed already; those that are computed now are added.
        code: what calls stand for.
    """
    found: dict[Expr, Tensor] = {} if known is None else known
    like = next(iter(values.values()))
    for node in topological(outputs, dict(found)):
        if node.op == "const":
            found[node] = torch.tensor(node.value, dtype=like.dtype, device=like.device)
        elif node.op == "symbol":
            found[node] = values[node.value]
        elif node.op == "call":
            assert code is not None
            found[node] = code[node.value](*(found[a] for a in node.args))
        else:
            found[node] = OPERATIONS[node.op](*(found[a] for a in node.args))
    return [found[node] for node in outputs]
