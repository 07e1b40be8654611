"""Parser of formulas: arithmetic on names and numbers.

Python's grammar reads the text. The parser accepts only the listed elements and never executes
the text. ``law(gap=...)`` is the law with other quantities in place of its own; there may be
several such names.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Mapping

from nnode.errors import ConfigError
from nnode.model import operations
from nnode.model.expression import Expr, apply, const, substitute, symbol, topological

#: Limits of a text's characters, of nested parts, and of exponents.
LENGTH, DEPTH, EXPONENT = 2000, 60, 64
#: Limit of the operations of a formula with all its parts. The largest law of the package has 400.
#: A part with other quantities, as part(dx=...), is built again, so that 30 short parts can
#: require 10^9 operations. Building 10,000 takes half a second; compiling 1,200 takes more than
#: three minutes.
OPERATIONS = 10_000
#: Names of functions and their numbers of arguments.
FUNCTIONS = {**operations.FUNCTIONS, "abs": 1, "clip": 3}
_BINARY: dict[type, Callable[[Expr, Expr], Expr]] = {
    ast.Add: Expr.__add__,
    ast.Sub: Expr.__sub__,
    ast.Mult: Expr.__mul__,
    ast.Div: Expr.__truediv__,
    ast.Pow: Expr.__pow__,
}
#: The meaning of a called name: a formula, or a function of the arguments' formulas.
Part = Expr | Callable[..., Expr]
_LISTED = "expected + - * / **, brackets, numbers, names, and the functions " + ", ".join(FUNCTIONS)


class FormulaError(ConfigError):
    """A text that is not a formula; the message shows the place of the problem."""

    def __init__(self, text: str, column: int, problem: str) -> None:
        shown, column = _around(text, column)
        super().__init__(f"formula: {problem}\n  {shown}\n  {' ' * column}^")
        self.problem = problem


def _around(text: str, column: int) -> tuple[str, int]:
    """The part of a text around a column, and the column in it."""
    first = max(0, column - 50)
    return text[first : column + 30].replace("\n", " "), column - first


def parse(
    text: str, names: Mapping[str, Expr] | None = None, laws: Mapping[str, Part] | None = None
) -> Expr:
    """Parse a formula.

    Args:
        text: text such as ``v0*(1 - L/gap)``.
        names: name to its formula; None makes a symbol of every name.
        laws: name to the formula that ``name(...)`` denotes with other quantities in it; or to a
            function of the arguments' formulas, as for a network.

    Raises:
        FormulaError: the text is not a formula.
    """
    if not isinstance(text, str):
        raise FormulaError(str(text), 0, f"expected text, got {type(text).__name__}")
    if len(text) > LENGTH:
        raise FormulaError(text, 0, f"it has {len(text)} characters, at most {LENGTH} are read")
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        at = max(int(getattr(error, "offset", 1) or 1) - 1, 0)
        raise FormulaError(text.strip(), at, f"this cannot be read; {_LISTED}") from error
    reader = _Reader(text.strip(), names, laws or {})
    formula = reader.read(tree.body, 0)
    reader.count(tree.body, formula)
    return formula


class _Reader:
    def __init__(
        self, text: str, names: Mapping[str, Expr] | None, laws: Mapping[str, Part]
    ) -> None:
        self.text, self.names, self.laws = text, names, laws
        self.built = 0

    def count(self, node: ast.AST, *parts: Expr) -> None:
        """Count the operations of new parts, and refuse more than the limit."""
        self.built += len(topological(parts))
        if self.built > OPERATIONS:
            raise self.fail(
                node, f"it has more than {OPERATIONS} operations with the parts that it names"
            )

    def fail(self, node: ast.AST, problem: str) -> FormulaError:
        return FormulaError(self.text, getattr(node, "col_offset", 0), problem)

    def read(self, node: ast.AST, depth: int) -> Expr:
        if depth > DEPTH:
            raise self.fail(node, f"it is nested more than {DEPTH} deep; name parts under where")
        match node:
            case ast.BinOp() if type(node.op) in _BINARY:
                return self.binary(node, depth)
            case ast.UnaryOp(op=ast.USub()):
                return -self.read(node.operand, depth + 1)
            case ast.UnaryOp(op=ast.UAdd()):
                return self.read(node.operand, depth + 1)
            case ast.Constant(value=float() | int() as value) if not isinstance(value, bool):
                if not abs(value) <= sys.float_info.max:
                    raise self.fail(node, "this number is too large")
                return const(value)
            case ast.Name():
                return self.name(node)
            case ast.Call(func=ast.Name(id=name)):
                return self.call(node, name, depth)
        raise self.fail(node, f"this is not allowed in a formula; {_LISTED}")

    def name(self, node: ast.Name) -> Expr:
        if self.names is None:
            return symbol(node.id)
        if node.id not in self.names:
            listed = ", ".join(sorted(self.names))
            raise self.fail(node, f"{node.id} is unknown; there are {listed}")
        return self.names[node.id]

    def binary(self, node: ast.BinOp, depth: int) -> Expr:
        a, b = self.read(node.left, depth + 1), self.read(node.right, depth + 1)
        power = isinstance(node.op, ast.Pow) and b.op == "const"
        if power and abs(b.value) > EXPONENT:
            raise self.fail(node.right, f"an exponent is at most {EXPONENT}")
        negative = power and b.value < 0
        divides = isinstance(node.op, ast.Div)
        if (divides and b.is_number(0)) or (negative and a.is_number(0)):
            raise self.fail(node.right, "this divides by 0")
        return _BINARY[type(node.op)](a, b)

    def call(self, node: ast.Call, name: str, depth: int) -> Expr:
        if name in self.laws:
            part = self.laws[name]
            if isinstance(part, Expr):
                return self.of_law(node, name, part, depth)
            if node.keywords or not node.args:
                raise self.fail(node, f"{name} takes its inputs one after the other")
            made = part(*(self.read(a, depth + 1) for a in node.args))
            self.count(node, made)
            return made
        if name not in FUNCTIONS:
            raise self.fail(node, f"there is no function {name}; {_LISTED}")
        if node.keywords or len(node.args) != FUNCTIONS[name]:
            raise self.fail(node, f"{name} takes {FUNCTIONS[name]} argument(s)")
        args = [self.read(a, depth + 1) for a in node.args]
        if name == "abs":
            return apply("max", args[0], -args[0])
        if name == "clip":
            return apply("min", apply("max", args[0], args[1]), args[2])
        return apply(name, *args)

    def of_law(self, node: ast.Call, name: str, law: Expr, depth: int) -> Expr:
        values: dict[str, Expr] = {}
        if node.args or any(keyword.arg is None for keyword in node.keywords):
            raise self.fail(node, f"{name} takes what it replaces by name, as {name}(gap=gap_1)")
        for keyword in node.keywords:
            assert keyword.arg is not None
            if self.names is not None and keyword.arg not in self.names:
                raise self.fail(node, f"the law has no {keyword.arg} that could be replaced")
            target = self.names.get(keyword.arg) if self.names is not None else None
            if target is not None and target.op != "symbol":
                raise self.fail(node, f"{keyword.arg} is made of others and cannot be replaced")
            place = keyword.arg if target is None else target.value
            values[place] = self.read(keyword.value, depth + 1)
        self.count(node, law)
        return substitute(law, values)
