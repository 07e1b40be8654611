"""Reading, simplifying and printing formulas; errors and their positions."""

from __future__ import annotations

import contextlib

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nnode.model.arrays import Formulas
from nnode.model.expression import Expr, const, symbol, topological
from nnode.model.parse import FormulaError, parse
from nnode.model.text import latex, plain

IDM = "a*(1 - (v/v0)**4 - ((s0 + max(0, v*T + v*dv/(2*sqrt(a*b))))/gap)**2)"


@pytest.mark.parametrize(
    ("text", "problem", "column"),
    [
        ("a.b(3)", "not allowed", 0),
        ("1 + a.b", "not allowed", 4),
        ("__import__('os')", "no function __import__", 0),
        ("eval(a)", "no function eval", 0),
        ("9**9**9", "at most 64", 3),
        ("1 if a else 2", "not allowed", 0),
        ("x[0]", "not allowed", 0),
        ("f'{a}'", "not allowed", 0),
        ("lambda: 1", "not allowed", 0),
        ("a, b", "not allowed", 0),
        ("a == b", "not allowed", 0),
        ("True", "not allowed", 0),
        ("'a'", "not allowed", 0),
        ("(a := 1)", "not allowed", 1),
        ("[a for a in b]", "not allowed", 0),
        ("1e400", "too large", 0),
        ("1/0", "divides by 0", 2),
        ("max(1)", "max takes 2", 0),
        ("exp(a, b=1)", "exp takes 1", 0),
        ("exp(*a)", "not allowed", 4),
        ("v0*(1 - ", "cannot be read", 3),
        ("", "cannot be read", 0),
        ("a\nb", "cannot be read", 0),
        ("a\x00b", "cannot be read", 0),
        ("law()", "no function law", 0),
        ("-" * 100 + "a", "nested", 60),
        ("+".join("a" * 1500), "characters", 0),
        ("(" * 300 + "a" + ")" * 300, "cannot be read|nested", 0),
    ],
)
def test_invalid_formulas(text: str, problem: str, column: int) -> None:
    with pytest.raises(FormulaError, match=problem) as error:
        parse(text)
    mark = str(error.value).splitlines()[-1]
    assert mark.strip() == "^"
    if column and column < 50:
        assert mark.index("^") == column + 2


def test_unknown_name() -> None:
    with pytest.raises(FormulaError, match=r"gpa is unknown; there are gap, v0\n  v0\*gpa\n {5}\^"):
        parse("v0*gpa", {"v0": symbol("v0"), "gap": symbol("gap")})


def test_equal_subexpressions_share_one_node() -> None:
    assert parse("exp(a + b)*exp(a + b)").args[0] is parse("exp(a + b)")
    assert len(topological([parse("(a + b)*(a + b)")])) == 4


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("a + 0", "a"),
        ("a*1", "a"),
        ("a - -b", "a + b"),
        ("0*a", "0"),
        ("--a", "a"),
        ("2*3 + 1", "7"),
        ("a**1", "a"),
        ("a**0", "1"),
        ("(w + g) - g", "w"),
        ("max(2, 3)", "3"),
        ("abs(a)", "max(a, -a)"),
        ("clip(a, 0, 1)", "min(max(a, 0), 1)"),
        ("a - a", "0"),
    ],
)
def test_simplification(text: str, same: str) -> None:
    assert parse(text) is parse(same)


def test_law_in_an_effect() -> None:
    names = {name: symbol(name) for name in ("gap", "beta", "W", "v0")}
    law = parse("v0*gap", names)
    assert parse("W + law(gap=gap - beta) - law()", names, {"law": law}) is parse(
        "W + v0*(gap - beta) - v0*gap", names
    )
    with pytest.raises(FormulaError, match="by name"):
        parse("law(gap)", names, {"law": law})


leaves = st.sampled_from(["a", "b", "gap", "2", "0.5", "3.25"])
formulas = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda t: f"({t[0]} {t[1]} {t[2]})"),
        st.tuples(st.sampled_from(["exp", "sqrt", "-", "softplus"]), inner).map(
            lambda t: f"{t[0]}({t[1]})"
        ),
        st.tuples(inner, st.sampled_from(["2", "3", "-1", "0.5", "1.7"])).map(
            lambda t: f"({t[0]})**{t[1]}"
        ),
        st.tuples(inner, inner).map(lambda t: f"max({t[0]}, {t[1]})"),
    ),
    max_leaves=8,
)


@given(formulas)
@settings(max_examples=200, deadline=None)
def test_printed_formula_has_the_same_value(text: str) -> None:
    try:
        node = parse(text)
    except FormulaError:
        return  # a division by zero
    inputs = {"a": 0.7, "b": 1.3, "gap": 2.9}
    tensors = {name: torch.tensor(value, dtype=torch.float64) for name, value in inputs.items()}
    printed, original = map(float, Formulas([parse(plain(node)), node])(tensors))
    assert printed == pytest.approx(original, rel=1e-12, nan_ok=True)
    assert latex(node).count("{") == latex(node).count("}")


@pytest.mark.parametrize(
    "text",
    ["v0*(1 - L/gap)", "a + (b - a)", "a - (b + c)", "a*(1 - (v/v0)**4 - (w/s)**2)", "-a*b/(c*d)"],
)
def test_printed_formula_is_the_same_node(text: str) -> None:
    assert parse(plain(parse(text))) is parse(text)


@pytest.mark.thorough
@given(st.text(max_size=40))
@settings(max_examples=300, deadline=None)
def test_any_text(text: str) -> None:
    with contextlib.suppress(FormulaError):
        assert isinstance(parse(text), Expr)


def test_printed_numbers_have_all_digits() -> None:
    value = 0.1 + 0.2
    assert parse(plain(const(value))).value == value
    assert "frac" in latex(parse(IDM))
