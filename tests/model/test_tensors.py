"""Values and derivatives of operations and formulas in every library, against Python's numbers and
autograd."""

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

#: Names in compiled code that are no functions of the kernels' own.
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
    found = Formulas([node])(values)[0]
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
        own = {n: float(v[i].detach()) for n, v in values.items()}
        assert float(found[i]) == pytest.approx(eval(text, names, own), rel=1e-13)
    exact = torch.autograd.grad(found.sum(), list(values.values()), allow_unused=True)
    own_slopes = derivatives(node, list("abc"))
    for name, wanted in zip("abc", exact, strict=True):
        if wanted is None:
            assert name not in own_slopes
            continue
        slope = Formulas([own_slopes[name]])(values)[0].expand(50)
        torch.testing.assert_close(slope, wanted, rtol=1e-12, atol=1e-13)


@pytest.mark.thorough
@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_is_the_same_in_every_library(name: str) -> None:
    row = OPERATIONS[name]
    names = "abc"[: row.arguments]
    rng = np.random.default_rng(5)
    values = {n: np.append(rng.uniform(0.1, 3.0, 40), [1.0, 30.0]) for n in names}
    values["a"][1] = values[names[-1]][0]  # a tie, also where there is one argument only
    points = list(zip(*values.values(), strict=True))
    node = apply(name, *map(symbol, names))
    wanted = [apply(name, *map(const, point)).value for point in points]
    np.testing.assert_allclose(Formulas([node])(values)[0], wanted, rtol=1e-14)
    tensors = {n: torch.tensor(v, requires_grad=True) for n, v in values.items()}
    found = Formulas([node])(tensors)[0]
    np.testing.assert_allclose(found.detach(), wanted, rtol=1e-14)
    code = compiled(row.code.format(*names), ", ".join(names), vars(functions) | SCALARS)
    machine = njit(error_model="numpy")(code)
    np.testing.assert_allclose([machine(*point) for point in points], wanted, rtol=2e-14)
    exact = torch.autograd.grad(found.sum(), list(tensors.values()), allow_unused=True)
    for own, slope in zip(slopes(node), exact, strict=True):
        if slope is not None:
            other = Formulas([own])(tensors)[0].expand_as(slope)
            torch.testing.assert_close(other, slope, rtol=1e-13, atol=1e-15)
        else:
            assert own.is_number(0)


@pytest.mark.parametrize("op", ["max", "min"])
def test_the_larger_of_a_number_and_none_is_none(op: str) -> None:
    nan = math.nan
    values = {"a": np.array([nan, 1.0, nan, 1.0]), "b": np.array([1.0, nan, nan, 2.0])}
    node = parse(f"{op}(a, b)")
    wanted = [nan, nan, nan, 2.0 if op == "max" else 1.0]
    tensors = {name: torch.from_numpy(value) for name, value in values.items()}
    np.testing.assert_array_equal(Formulas([node])(tensors)[0].numpy(), wanted)
    np.testing.assert_array_equal(Formulas([node])(values)[0], wanted)
    text = OPERATIONS[op].code.format("a", "b")
    code = njit(error_model="numpy")(compiled(text, "a, b", vars(functions)))
    pairs = list(zip(*values.values(), strict=True))
    np.testing.assert_array_equal([code(a, b) for a, b in pairs], wanted)
    folded = [apply(op, const(a), const(b)).value for a, b in pairs]
    np.testing.assert_array_equal(folded, wanted)


@pytest.mark.parametrize(
    ("text", "slope"), [("max(a, b)", (1.0, 0.0)), ("min(a, b)", (1.0, 0.0)), ("max(b, a)", (0, 1))]
)
def test_ties_go_to_the_first(text: str, slope: tuple[float, float]) -> None:
    found = derivatives(parse(text), ["a", "b"])
    one = {"a": torch.ones(1), "b": torch.ones(1)}
    assert [float(Formulas([found[n]])(one)[0]) for n in "ab"] == list(slope)


def test_a_slope_of_zero_wins_over_what_is_not_finite() -> None:
    # where the other side is chosen, its own slope counts for nothing
    found = derivatives(parse("choose(a, log(a), 2*b)"), ["a", "b"])
    at = {"a": torch.zeros(1), "b": torch.ones(1)}
    assert float(Formulas([found["b"]])(at)[0]) == 2.0
