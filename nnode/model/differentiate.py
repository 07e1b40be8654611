"""Derivatives of formulas, on their own nodes."""

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
    """The derivative of an operation by each of what it is applied to."""
    if node.op not in _SLOPES:
        raise ValueError(f"there is no derivative of {node.op}")
    return [as_expr(slope) for slope in _SLOPES[node.op](node, *node.args)]


def _weighted(weight: Expr, slope: Expr) -> Expr:
    """A product that is 0 where a chosen slope is, whatever the weight."""
    if slope.op == "choose" and slope.args[1].op == slope.args[2].op == "const":
        condition, b, c = slope.args
        return apply("choose", condition, weight * b, weight * c)
    return weight * slope


def vjp(seeds: Mapping[Expr, Expr], ends: Callable[[Expr], bool]) -> dict[Expr, Expr]:
    """Reverse mode: adjoints of the nodes where ``ends`` says so, and of symbols.

    Args:
        seeds: weights of the outputs.
        ends: nodes that are not followed further.
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
    """Of one formula by symbols; those that it does not contain are left out."""
    adjoints = vjp({node: _ONE}, lambda part: False)
    gradient = {part.value: bar for part, bar in adjoints.items() if not bar.is_number(0)}
    return {name: gradient[name] for name in names if name in gradient}


def shift_slopes(outputs: Sequence[Expr], moved: Collection[str]) -> list[Expr]:
    """Forward mode: derivatives of formulas by an amount that is added to several symbols at once.

    What depends on differences of these symbols alone has the number 0.
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
