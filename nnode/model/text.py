"""Formulas as text: plain, and LaTeX."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from nnode.model.expression import Expr, topological

#: How tightly an operation binds.
_SUM, _PRODUCT, _SIGN, _POWER, _ATOM = 1, 2, 3, 4, 5


def number(value: float) -> str:
    """As short as it can be read back."""
    short = f"{value:.12g}"
    return short if float(short) == value else repr(value)


def plain(node: Expr) -> str:
    """As :func:`nnode.model.parse.parse` reads it; parts that are longer than it reads are
    written ``(...)``."""
    return _written(node, _plain)


def latex(node: Expr, names: Mapping[str, str] | None = None) -> str:
    """For a page; ``names`` of symbols that are written otherwise."""
    names = names or {}

    def one(part: Expr, found: _Found) -> tuple[str, int]:
        return _latex(part, found, names)

    return _written(node, one)


_Found = Mapping[Expr, tuple[str, int]]
_Writer = Callable[[Expr, _Found], tuple[str, int]]

#: Characters of a part that is written out: what can be read again. A part that is named often
#: is written as often: without a bound, 40 parts that double have 10^12 characters.
LONGEST = 2000


def _written(node: Expr, writer: _Writer) -> str:
    found: dict[Expr, tuple[str, int]] = {}
    for part in topological([node]):
        text, level = writer(part, found)
        found[part] = (text, level) if len(text) <= LONGEST else ("(...)", _ATOM)
    return found[node][0]


def _in(text: tuple[str, int], least: int, brackets: str = "plain") -> str:
    left, right = ("\\left(", "\\right)") if brackets == "latex" else ("(", ")")
    return text[0] if text[1] >= least else f"{left}{text[0]}{right}"


def _plain(part: Expr, found: _Found) -> tuple[str, int]:
    of = [found[a] for a in part.args]
    match part.op:
        case "const":
            return number(part.value), _ATOM if part.value >= 0 else _SIGN
        case "symbol":
            return part.value.replace("__", "."), _ATOM  # a parameter by its address
        case "add" | "sub":
            sign = "+" if part.op == "add" else "-"
            # what is added as a whole stays in brackets, so that it is read as it was written
            return f"{_in(of[0], _SUM)} {sign} {_in(of[1], _SUM + 1)}", _SUM
        case "mul":
            if part.args[0] is part.args[1]:
                return f"{_in(of[0], _ATOM)}**2", _POWER
            for i in (1, 0):
                if part.args[i].op == "recip":
                    under = part.args[i].args[0]
                    return (
                        f"{_in(of[1 - i], _PRODUCT)}/{_in((found[under][0], _level(under)), 4)}",
                        2,
                    )
            return f"{_in(of[0], _PRODUCT)}*{_in(of[1], _PRODUCT + 1)}", _PRODUCT
        case "neg":
            return f"-{_in(of[0], _PRODUCT)}", _SIGN
        case "recip":
            return f"1/{_in(of[0], 4)}", _PRODUCT
    name = part.value if part.op == "call" else part.op
    return f"{name}({', '.join(text for text, _ in of)})", _ATOM


def _level(node: Expr) -> int:
    if node.op == "mul" and node.args[0] is node.args[1]:
        return _POWER
    return {"add": 1, "sub": 1, "mul": 2, "recip": 2, "neg": 3}.get(node.op, _ATOM)


def _latex(part: Expr, found: _Found, names: Mapping[str, str]) -> tuple[str, int]:
    of = [found[a] for a in part.args]
    match part.op:
        case "const":
            return number(part.value), _ATOM if part.value >= 0 else _SIGN
        case "symbol":
            return names.get(part.value, _subscript(part.value)), _ATOM
        case "add" | "sub":
            sign = "+" if part.op == "add" else "-"
            right = _in(of[1], _SUM + (part.op == "sub"), "latex")
            return f"{_in(of[0], _SUM, 'latex')} {sign} {right}", _SUM
        case "mul":
            if part.args[0] is part.args[1]:
                return f"{{{_in(of[0], _ATOM, 'latex')}}}^{{2}}", _POWER
            for i in (1, 0):
                if part.args[i].op == "recip":
                    under = found[part.args[i].args[0]][0]
                    return f"\\frac{{{of[1 - i][0]}}}{{{under}}}", _ATOM
            return f"{_in(of[0], _PRODUCT, 'latex')}\\,{_in(of[1], _PRODUCT, 'latex')}", _PRODUCT
        case "neg":
            return f"-{_in(of[0], _PRODUCT, 'latex')}", _SIGN
        case "recip":
            return f"\\frac{{1}}{{{of[0][0]}}}", _ATOM
        case "sqrt":
            return f"\\sqrt{{{of[0][0]}}}", _ATOM
    name = part.value if part.op == "call" else part.op
    return f"\\mathrm{{{name}}}\\left({', '.join(text for text, _ in of)}\\right)", _ATOM


_GREEK = {"alpha", "beta", "gamma", "kappa", "tau", "phi", "sigma", "lambda", "eta"}


def _subscript(name: str) -> str:
    first, _, rest = name.partition("_")
    shown = (
        f"\\{first}" if first in _GREEK else first if len(first) == 1 else f"\\mathrm{{{first}}}"
    )
    return shown + (f"_{{{rest}}}" if rest else "")
