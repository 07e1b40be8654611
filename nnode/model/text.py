"""Formulas as plain text and as LaTeX."""

from __future__ import annotations

from typing import NamedTuple

from nnode.model.expression import Expr, topological
from nnode.model.operations import OPERATIONS, Notation

#: Largest number of characters of a part that is written out, which is the parser's limit. The
#: text repeats shared nodes: without a bound, 40 nodes that double it have 10^12 characters.
LONGEST = 2000


class _Language(NamedTuple):
    brackets: str
    call: str
    square: Notation
    quotient: Notation


_PLAIN = _Language("({})", "{}({})", ("{0:5}**2", 4), ("{0:2}/{1:4}", 2))
_LATEX = _Language(
    "\\left({}\\right)",
    "\\mathrm{{{}}}\\left({}\\right)",
    ("{{{0:5}}}^{{2}}", 4),
    ("\\frac{{{0}}}{{{1}}}", 5),
)


class _Part(NamedTuple):
    """The text of a node, its precedence, and the brackets of its language."""

    text: str
    level: int
    brackets: str

    def __format__(self, min_level: str) -> str:
        return self.brackets.format(self.text) if self.level < int(min_level or 0) else self.text


def number(value: float) -> str:
    """The shortest of two texts that restores the number."""
    short = f"{value:.12g}"
    return short if float(short) == value else repr(value)


def plain(node: Expr) -> str:
    """The text that :func:`nnode.model.parse.parse` reads; longer parts are written ``(...)``."""
    return _written(node, _PLAIN)


def latex(node: Expr) -> str:
    """The LaTeX text for a page; longer parts are written ``(...)``."""
    return _written(node, _LATEX)


def _written(node: Expr, language: _Language) -> str:
    written: dict[Expr, _Part] = {}
    for part in topological([node]):
        args: tuple[Expr, ...] = part.args
        level = 5
        if part.op == "const":
            text, level = number(part.value), 5 if part.value >= 0 else 3
        elif part.op == "symbol":
            # plain text shows a parameter's address
            text = part.value.replace("__", ".") if language is _PLAIN else _subscript(part.value)
        elif part.op == "mul" and args[0] is args[1]:
            text, level = language.square
        elif part.op == "mul" and "recip" in (args[0].op, args[1].op):
            over, under = args if args[1].op == "recip" else args[::-1]
            args = (over, under.args[0])
            text, level = language.quotient
        elif notation := _notation(part.op, language):
            text, level = notation
        else:
            name = part.value if part.op == "call" else part.op
            text = language.call.format(name, ", ".join(written[a].text for a in args))
            args = ()
        text = text.format(*(written[a] for a in args)) if args else text
        if len(text) > LONGEST:
            text, level = "(...)", 5
        written[part] = _Part(text, level, language.brackets)
    return written[node].text


def _notation(op: str, language: _Language) -> Notation | None:
    """The notation of an operation; None if it is written as a call."""
    if op == "call":
        return None
    row = OPERATIONS[op]
    return row.plain if language is _PLAIN else row.latex or row.plain


_GREEK = {"alpha", "beta", "gamma", "kappa", "tau", "phi", "sigma", "lambda", "eta"}


def _subscript(name: str) -> str:
    first, _, index = name.partition("_")
    shown = (
        f"\\{first}" if first in _GREEK else first if len(first) == 1 else f"\\mathrm{{{first}}}"
    )
    return shown + (f"_{{{index}}}" if index else "")
