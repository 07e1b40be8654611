"""Symbolic derivatives of formulas."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

from nnode.model.expression import Expr, apply, as_expr, const, topological
from nnode.model.operations import OPERATIONS, compiled

_ONE, _ZERO = const(1), const(0)
_BUILDERS = {name: partial(apply, name) for name in OPERATIONS}
_SLOPES = {
    name: compiled(f"({row.slope},)", ", ".join("fabc"[: row.arguments + 1]), _BUILDERS)
    for name, row in OPERATIONS.items()
}


def slopes(node: Expr) -> list[Expr]:
    """The derivatives of an operation by each of its arguments."""
    if node.op not in _SLOPES:
        raise ValueError(f"there is no derivative of {node.op}")
    return [as_expr(slope) for slope in _SLOPES[node.op](node, *node.args)]


def _weighted(weight: Expr, slope: Expr) -> Expr:
    """The product of a weight and a slope. It is 0 where a ``choose`` of constants selects the
    slope 0, even if the weight is infinite."""
    if slope.op == "choose" and slope.args[1].op == slope.args[2].op == "const":
        condition, b, c = slope.args
        return apply("choose", condition, weight * b, weight * c)
    return weight * slope


def vjp(seeds: Mapping[Expr, Expr], ends: Callable[[Expr], bool]) -> dict[Expr, Expr]:
    """Reverse-mode differentiation: the adjoints of symbols and of the nodes where it ends.

    Args:
        seeds: output to its weight.
        ends: whether a node is treated as a leaf.
    """
    bar, adjoints = dict(seeds), {}
    for node in reversed(topological(seeds)):
        if node not in bar or node.op == "const":
            continue
        if node.op == "symbol" or ends(node):
            adjoints[node] = bar[node]
            continue
        for part, slope in zip(node.args, slopes(node), strict=True):
            if part.op == "const" or slope.is_number(0):
                continue
            share = _weighted(bar[node], slope)
            bar[part] = bar[part] + share if part in bar else share
    return adjoints


def derivatives(node: Expr, names: list[str]) -> dict[str, Expr]:
    """The derivatives of one formula by symbols, without those that it does not contain."""
    adjoints = vjp({node: _ONE}, lambda part: False)
    gradient = {part.value: bar for part, bar in adjoints.items() if not bar.is_number(0)}
    return {name: gradient[name] for name in names if name in gradient}


def shift_slopes(outputs: Sequence[Expr], moved: Collection[str]) -> list[Expr]:
    """Forward-mode derivatives of formulas by an amount that is added to several symbols.

    The derivative is the number 0 for a formula that depends only on differences of the symbols.
    """
    shifted: dict[Expr, Expr] = {}
    for node in topological(outputs):
        if node.op == "symbol":
            shifted[node] = _ONE if node.value in moved else _ZERO
        elif all(shifted[part].is_number(0) for part in node.args):
            shifted[node] = _ZERO
        elif node.op == "call":  # code, whose slope is not known
            shifted[node] = node
        else:
            total = _ZERO
            for part, slope in zip(node.args, slopes(node), strict=True):
                total = total + _weighted(shifted[part], slope)
            shifted[node] = total
    return [shifted[node] for node in outputs]
