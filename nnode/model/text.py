"""Formulas as text: plain, and LaTeX."""

from __future__ import annotations

from collections.abc import Mapping

from nnode.model.expression import Expr, topological
from nnode.model.operations import ATOM, OPERATIONS, POWER, PRODUCT, SIGN, SUM, Notation

#: Characters of a part that is written out: what can be read again. A part that is named often
#: is written as often: without a bound, 40 parts that double have 10^12 characters.
LONGEST = 2000
#: Notations of products of equal factors and of products with a reciprocal.
_SQUARE = {
    "plain": Notation("{0}**2", POWER, (ATOM,)),
    "latex": Notation("{{{0}}}^{{2}}", POWER, (ATOM,)),
}
_QUOTIENT = {
    "plain": Notation("{0}/{1}", PRODUCT, (PRODUCT, POWER)),
    "latex": Notation("\\frac{{{0}}}{{{1}}}", ATOM, (SUM, SUM)),
}
_BRACKETS = {"plain": "({0})", "latex": "\\left({0}\\right)"}


def number(value: float) -> str:
    """As short as it can be read back."""
    short = f"{value:.12g}"
    return short if float(short) == value else repr(value)


def plain(node: Expr) -> str:
    """As :func:`nnode.model.parse.parse` reads it; parts that are longer than it reads are
    written ``(...)``."""
    return _written(node, "plain", {})


def latex(node: Expr, names: Mapping[str, str] | None = None) -> str:
    """For a page; ``names`` of symbols that are written otherwise."""
    return _written(node, "latex", names or {})


def _written(node: Expr, language: str, names: Mapping[str, str]) -> str:
    """Every part with how tightly it binds, each after what it is made of."""
    found: dict[Expr, tuple[str, int]] = {}
    for part in topological([node]):
        if part.op == "const":
            text, level = number(part.value), ATOM if part.value >= 0 else SIGN
        elif part.op == "symbol":
            # in plain text a parameter by its address
            own = part.value.replace("__", ".") if language == "plain" else _subscript(part.value)
            text, level = names.get(part.value, own), ATOM
        else:
            notation, args = _notation(part, language)
            level = notation.level
            text = notation.text.format(
                *(
                    found[a][0] if found[a][1] >= least else _BRACKETS[language].format(found[a][0])
                    for a, least in zip(args, notation.least, strict=True)
                )
            )
        found[part] = (text, level) if len(text) <= LONGEST else ("(...)", ATOM)
    return found[node][0]


def _notation(part: Expr, language: str) -> tuple[Notation, tuple[Expr, ...]]:
    """How an operation is written, and the arguments of that."""
    if part.op == "mul":
        a, b = part.args
        if a is b:
            return _SQUARE[language], (a,)
        for over, under in ((a, b), (b, a)):
            if under.op == "recip":
                return _QUOTIENT[language], (over, under.args[0])
    if part.op != "call" and (notation := getattr(OPERATIONS[part.op], language)) is not None:
        return notation, part.args
    name = part.value if part.op == "call" else part.op
    name = name if language == "plain" else f"\\mathrm{{{{{name}}}}}"
    fields = ", ".join(f"{{{i}}}" for i in range(len(part.args)))
    return Notation(name + _BRACKETS[language].format(fields), ATOM, (SUM,) * len(part.args)), (
        part.args
    )


_GREEK = {"alpha", "beta", "gamma", "kappa", "tau", "phi", "sigma", "lambda", "eta"}


def _subscript(name: str) -> str:
    first, _, rest = name.partition("_")
    shown = (
        f"\\{first}" if first in _GREEK else first if len(first) == 1 else f"\\mathrm{{{first}}}"
    )
    return shown + (f"_{{{rest}}}" if rest else "")
