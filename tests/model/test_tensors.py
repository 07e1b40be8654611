"""Values and derivatives of operations in every library, against Python and autograd."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numba import njit

from nnode.model.arrays import Formulas
from nnode.model.differentiate import derivatives, slopes
from nnode.model.expression import apply, const, symbol
from nnode.model.operations import OPERATIONS, compiled
from nnode.model.parse import parse
from nnode.simulation.kernels import functions

#: Names in compiled code besides the functions of the kernels.
SCALARS = {"zero": 0.0, "sqrt": math.sqrt, "sin": math.sin, "cos": math.cos}
FORMULAS = [
    "a*(1 - (b/c)**4) - exp(-a)*log(b)",
    "sqrt(a*b)/c + tanh(c - a) - sin(a)*cos(b)",
    "softplus(30*a - b)*logistic(c)",
    "max(a, b)*min(b, c) + clip(a, 0.5, 0.9)",
    "choose(a - b, a*c, b/c) + abs(a - c)",
    "(a + b)**1.7 - a**-2 + b**0.5",
]


@pytest.mark.parametrize("text", FORMULAS)
def test_values_and_derivatives(text: str) -> None:
    rng = np.random.default_rng(3)
    node = parse(text)
    values = {n: torch.tensor(rng.uniform(0.3, 2.0, 50), requires_grad=True) for n in "abc"}
    computed = Formulas([node])(values)[0]
    names = {
        **vars(math),
        "max": max,
        "min": min,
        "abs": abs,
        "softplus": lambda x: x if x > 20 else math.log1p(math.exp(x)),
        "logistic": lambda x: 1 / (1 + math.exp(-x)),
        "clip": lambda x, low, high: min(max(x, low), high),
        "choose": lambda condition, x, y: x if condition > 0 else y,
    }
    for i in range(50):
        numbers = {n: float(v[i].detach()) for n, v in values.items()}
        assert float(computed[i]) == pytest.approx(eval(text, names, numbers), rel=1e-13)
    exact = torch.autograd.grad(computed.sum(), list(values.values()), allow_unused=True)
    symbolic = derivatives(node, list("abc"))
    for name, expected in zip("abc", exact, strict=True):
        if expected is None:
            assert name not in symbolic
        else:
            slope = Formulas([symbolic[name]])(values)[0].expand(50)
            torch.testing.assert_close(slope, expected, rtol=1e-12, atol=1e-13)


@pytest.mark.thorough
@pytest.mark.parametrize("name", OPERATIONS)
def test_operation_in_every_library(name: str) -> None:
    row = OPERATIONS[name]
    names = "abc"[: row.arguments]
    rng = np.random.default_rng(5)
    values = {n: np.append(rng.uniform(0.1, 3.0, 40), [1.0, 30.0]) for n in names}
    values["a"][1] = values[names[-1]][0]
    points = list(zip(*values.values(), strict=True))
    node = apply(name, *map(symbol, names))
    expected = [apply(name, *map(const, point)).value for point in points]
    np.testing.assert_allclose(Formulas([node])(values)[0], expected, rtol=1e-14)
    tensors = {n: torch.tensor(v, requires_grad=True) for n, v in values.items()}
    computed = Formulas([node])(tensors)[0]
    np.testing.assert_allclose(computed.detach(), expected, rtol=1e-14)
    code = compiled(row.code.format(*names), ", ".join(names), vars(functions) | SCALARS)
    machine = njit(error_model="numpy")(code)
    np.testing.assert_allclose([machine(*point) for point in points], expected, rtol=2e-14)
    exact = torch.autograd.grad(computed.sum(), list(tensors.values()), allow_unused=True)
    for symbolic, slope in zip(slopes(node), exact, strict=True):
        if slope is not None:
            value = Formulas([symbolic])(tensors)[0].expand_as(slope)
            torch.testing.assert_close(value, slope, rtol=1e-13, atol=1e-15)
        else:
            assert symbolic.is_number(0)


@pytest.mark.parametrize("op", ["max", "min"])
def test_max_and_min_of_nan(op: str) -> None:
    nan = math.nan
    values = {"a": np.array([nan, 1.0, nan, 1.0]), "b": np.array([1.0, nan, nan, 2.0])}
    formula = Formulas([parse(f"{op}(a, b)")])
    tensors = {name: torch.from_numpy(value) for name, value in values.items()}
    text = OPERATIONS[op].code.format("a", "b")
    code = njit(error_model="numpy")(compiled(text, "a, b", vars(functions)))
    pairs = list(zip(*values.values(), strict=True))
    expected = [nan, nan, nan, 2.0 if op == "max" else 1.0]
    for computed in (
        formula(tensors)[0].numpy(),
        formula(values)[0],
        [code(a, b) for a, b in pairs],
        [apply(op, const(a), const(b)).value for a, b in pairs],
    ):
        np.testing.assert_array_equal(computed, expected)


@pytest.mark.parametrize(
    ("text", "slope"), [("max(a, b)", (1.0, 0.0)), ("min(a, b)", (1.0, 0.0)), ("max(b, a)", (0, 1))]
)
def test_slope_at_a_tie_is_of_the_first_argument(text: str, slope: tuple[float, float]) -> None:
    symbolic = derivatives(parse(text), ["a", "b"])
    ones = {"a": torch.ones(1), "b": torch.ones(1)}
    assert [float(Formulas([symbolic[n]])(ones)[0]) for n in "ab"] == list(slope)


def test_slope_of_the_chosen_branch() -> None:
    """The infinite slope of the other branch does not matter."""
    symbolic = derivatives(parse("choose(a, log(a), 2*b)"), ["a", "b"])
    inputs = {"a": torch.zeros(1), "b": torch.ones(1)}
    assert float(Formulas([symbolic["b"]])(inputs)[0]) == 2.0
