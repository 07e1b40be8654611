"""Sums over partners of functions of weighted differences, as networks have.

Where every summand is a weighted sum of functions of one number each, and these numbers are
weighted sums of differences between a receiver and a source, then

* the weights of the former leave the sum: what is summed are the functions alone;
* the latter are differences of one number of the receiver and one of the source, so that per pair
  only a difference and a function are left; nothing but their sum is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from nnode.model.crowd_dynamics import OTHERS, POINTS, SMALLEST, CrowdDynamics
from nnode.model.expression import Expr, apply, const, substitute, symbol, symbols
from nnode.model.operations import FUNCTIONS

#: What a difference is made of: the receiver's part and the source's, of which one may be missing.
_PARTS = {
    OTHERS: {"dx": ("x", "x"), "dy": ("y", "y"), "dvx": ("vx", "vx"), "dvy": ("vy", "vy")},
    POINTS: {
        "dx": ("x", "x"), "dy": ("y", "y"), "vx": ("vx", ""), "vy": ("vy", ""),
        "normal_x": ("", "normal_x"), "normal_y": ("", "normal_y"),
    },
}  # fmt: skip


@dataclass(frozen=True)
class Feature:
    """A number of a receiver and one of a source, of which a summand sees the difference."""

    own: Expr
    other: Expr


def split(
    law: CrowdDynamics, uniform: Sequence[str]
) -> tuple[CrowdDynamics, dict[str, dict[str, Feature]]]:
    """A law whose sums are over functions of features, and these features by their symbols; those
    sums for which this is not possible stay what they are.

    Args:
        uniform: symbols that are the same for all.
    """
    known = {*uniform, "t"}

    def same(node: Expr) -> bool:
        return known.issuperset(symbols([node]))

    features: dict[str, dict[str, Feature]] = {}
    if law.sums[SMALLEST]:
        return law, features  # they may name the sums
    for over, parts in _PARTS.items():
        found = law.sums[over]
        outer = {name: _weights(summand, same) for name, summand in found.items()}
        inner = list(dict.fromkeys(g for _, weights in outer.values() for g in weights))
        if not inner or FUNCTIONS.get(inner[0].op) != 1 or len({g.op for g in inner}) > 1:
            continue
        numbers = [_weights(g.args[0], same) for g in inner]
        if not all(s.op == "symbol" and s.value in parts for _, w in numbers for s in w):
            continue
        features[over], sums = {}, {f"{over}_one": const(1)}
        for k, (g, (start, weights)) in enumerate(zip(inner, numbers, strict=True)):
            own, other = start, const(0)
            for part, weight in weights.items():
                mine, its = parts[part.value]
                own = own + weight * symbol(mine) if mine else own
                if its:
                    other = other + weight * symbol(its) if mine else other - weight * symbol(its)
            features[over][f"{over}_z{k}"] = Feature(own, other)
            sums[f"{over}_s{k}"] = apply(g.op, symbol(f"{over}_z{k}"))
        total = {}
        for name, (start, weights) in outer.items():
            total[name] = start * symbol(f"{over}_one")
            for g, weight in weights.items():
                total[name] = total[name] + weight * symbol(f"{over}_s{inner.index(g)}")
        x, y = (substitute(rate, total) for rate in law.rate)
        law = replace(law, rate=(x, y), sums={**law.sums, over: sums})
    return law, features


def _weights(node: Expr, same: Callable[[Expr], bool]) -> tuple[Expr, dict[Expr, Expr]]:
    """A node as a number and a sum of other nodes with weights, which are the same for all."""
    if same(node):
        return node, {}
    if node.op in ("add", "sub"):
        start, found = _weights(node.args[0], same)
        more, others = _weights(node.args[1], same)
        sign = 1.0 if node.op == "add" else -1.0
        for part, weight in others.items():
            weight = sign * weight
            found[part] = found[part] + weight if part in found else weight
        return start + sign * more, found
    if node.op == "neg":
        start, found = _weights(node.args[0], same)
        return -start, {part: -weight for part, weight in found.items()}
    if node.op == "mul":
        for factor, other in (node.args, node.args[::-1]):
            if same(factor):
                start, found = _weights(other, same)
                return factor * start, {part: factor * weight for part, weight in found.items()}
    return const(0), {node: const(1)}
