"""A formula is a directed acyclic graph; equal subexpressions share one node.

A node is a number, a symbol, a call of code by its name, or an operation on nodes
(:mod:`nnode.model.operations`). Building an expression twice gives the same object, so repeated
parts are computed once.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Container, Iterable, Mapping
from contextlib import suppress
from typing import Any
from weakref import WeakValueDictionary

from nnode.model.operations import LIBRARIES, OPERATIONS, compiled


class Expr:
    """A node; made by :func:`symbol`, :func:`const`, arithmetic and :func:`apply`.

    Attributes:
        op: ``const``, ``symbol``, ``call``, or the name of an operation.
        args: arguments of the operation.
        value: the number, or the symbol's or the code's name.
        key: a digest of the whole formula below, the same in every process.
    """

    __slots__ = ("__weakref__", "args", "key", "op", "value")
    op: str
    args: tuple[Expr, ...]
    value: Any
    key: bytes

    def __add__(self, other: Expr | float) -> Expr:
        a, b = self, as_expr(other)
        if a.is_number(0):
            return b
        if b.is_number(0):
            return a
        if b.op == "neg":
            return a - b.args[0]
        if a.op == "neg":
            return b - a.args[0]
        return _folded("add", a, b)

    def __sub__(self, other: Expr | float) -> Expr:
        a, b = self, as_expr(other)
        if b.is_number(0):
            return a
        if a.is_number(0):
            return -b
        if a is b:
            return const(0)
        if b.op == "neg":
            return a + b.args[0]
        if a.op == "add" and b in a.args:
            return a.args[1 - a.args.index(b)]
        return _folded("sub", a, b)

    def __mul__(self, other: Expr | float) -> Expr:
        a, b = self, as_expr(other)
        for u, v in ((a, b), (b, a)):
            if u.is_number(0):
                return u
            if u.is_number(1):
                return v
            if u.is_number(-1):
                return -v
            if u.op == "neg":
                return -(u.args[0] * v)
        return _folded("mul", a, b)

    def __neg__(self) -> Expr:
        if self.op == "neg":
            return self.args[0]
        return _folded("neg", self)

    def __truediv__(self, other: Expr | float) -> Expr:
        return self * reciprocal(as_expr(other))

    def __pow__(self, exponent: Expr | float) -> Expr:
        return power(self, as_expr(exponent))

    def __radd__(self, other: float) -> Expr:
        return const(other) + self

    def __rsub__(self, other: float) -> Expr:
        return const(other) - self

    def __rmul__(self, other: float) -> Expr:
        return const(other) * self

    def __rtruediv__(self, other: float) -> Expr:
        return const(other) / self

    def is_number(self, value: float | None = None) -> bool:
        """Whether this is a number, or that number."""
        return self.op == "const" and (value is None or self.value == value)

    def __reduce__(self) -> Any:
        return _made, (self.op, self.args, self.value)


_NODES: WeakValueDictionary[bytes, Expr] = WeakValueDictionary()


def _made(op: str, args: tuple[Expr, ...], value: Any = None) -> Expr:
    text = f"{op}|{value!r}|".encode() + b"".join(a.key for a in args)
    key = hashlib.blake2b(text, digest_size=16).digest()
    existing = _NODES.get(key)
    if existing is not None:
        return existing
    node = object.__new__(Expr)
    node.op, node.args, node.value, node.key = op, args, value, key
    _NODES[key] = node
    return node


#: Values of operations on numbers.
_NUMBERS = {
    name: compiled(row.code.format(*"abc"), ", ".join("abc"[: row.arguments]), LIBRARIES["number"])
    for name, row in OPERATIONS.items()
}


def _folded(op: str, *args: Expr) -> Expr:
    if all(a.op == "const" for a in args):
        with suppress(ValueError, OverflowError, ZeroDivisionError):
            value = _NUMBERS[op](*(a.value for a in args))
            if math.isfinite(value) or not all(math.isfinite(a.value) for a in args):
                return const(value)
        # An overflow of finite numbers stays an operation, so that its evaluation reports it.
    return _made(op, args)


def const(value: float) -> Expr:
    """A number."""
    return _made("const", (), float(value) + 0.0)  # no negative zero


def symbol(name: str) -> Expr:
    """A quantity with a name."""
    return _made("symbol", (), name)


def as_expr(value: Expr | float) -> Expr:
    return value if isinstance(value, Expr) else const(value)


def reciprocal(a: Expr) -> Expr:
    if a.op == "recip":
        return a.args[0]
    if a.op == "neg":
        return -reciprocal(a.args[0])
    return _folded("recip", a)


def power(base: Expr, exponent: Expr) -> Expr:
    """Whole and half exponents by multiplication and roots, others by exp and log."""
    if exponent.op == "const" and (2 * exponent.value).is_integer() and abs(exponent.value) <= 64:
        n = exponent.value
        if n < 0:
            return reciprocal(power(base, const(-n)))
        if n.is_integer():
            return _whole_power(base, int(n))
        return _whole_power(apply("sqrt", base), int(2 * n))
    return apply("exp", exponent * apply("log", base))


def _whole_power(base: Expr, n: int) -> Expr:
    if n == 0:
        return const(1)
    half = _whole_power(base, n // 2)
    square = half * half
    return square * base if n % 2 else square


def _chosen(a: Expr, b: Expr, c: Expr) -> Expr:
    if a.op == "const":
        return b if a.value > 0 else c
    return b if b is c else _made("choose", (a, b, c))


#: Operations that simplify their result.
_SIMPLIFIED: dict[str, Callable[..., Expr]] = {
    "add": Expr.__add__,
    "sub": Expr.__sub__,
    "mul": Expr.__mul__,
    "neg": Expr.__neg__,
    "recip": reciprocal,
    "choose": _chosen,
}


def apply(name: str, *args: Expr | float) -> Expr:
    """The operation of a name, applied to arguments."""
    if name not in OPERATIONS:
        raise ValueError(f"there is no operation {name}")
    nodes = map(as_expr, args)
    return _SIMPLIFIED[name](*nodes) if name in _SIMPLIFIED else _folded(name, *nodes)


def call(name: str, *args: Expr) -> Expr:
    """A call of code that is not a formula. Evaluation takes the code by its name."""
    return _made("call", args, name)


def topological(outputs: Iterable[Expr], excluded: Container[Expr] = ()) -> list[Expr]:
    """All nodes of formulas in a deterministic order, each after its arguments.

    Args:
        excluded: nodes that are left out, as well as the nodes that only they depend on.
    """
    ordered: dict[Expr, None] = {}
    stack = [(node, False) for node in reversed(list(outputs))]
    while stack:
        node, done = stack.pop()
        if node in ordered or node in excluded:
            continue
        if done:
            ordered[node] = None
        else:
            stack.append((node, True))
            stack += [(a, False) for a in reversed(node.args) if a not in ordered]
    return list(ordered)


def symbols(outputs: Iterable[Expr]) -> list[str]:
    """Names of the quantities in formulas."""
    return [node.value for node in topological(outputs) if node.op == "symbol"]


def substitute(node: Expr, values: Mapping[str, Expr]) -> Expr:
    """A formula in which other formulas simultaneously replace symbols."""
    done: dict[Expr, Expr] = {}
    for part in topological([node]):
        args = tuple(done[a] for a in part.args)
        if part.op == "symbol":
            done[part] = values.get(part.value, part)
        elif args == part.args:
            done[part] = part
        else:
            done[part] = call(part.value, *args) if part.op == "call" else apply(part.op, *args)
    return done[node]
