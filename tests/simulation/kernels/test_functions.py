"""Vectorisable functions against arbitrary-precision arithmetic, and at their limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest
from numba import njit

from nnode.simulation.kernels import functions
from nnode.simulation.kernels.functions import FLAGS

KINDS = [np.float32, np.float64]


def loop(name: str) -> Callable[[Any, Any], None]:
    function = functions.softplus_logistic if name == "softplus" else getattr(functions, name)
    first = name == "softplus"

    @njit(error_model="numpy", fastmath=FLAGS)
    def run(x: Any, out: Any) -> None:
        for i in range(len(x)):
            out[i] = function(x[i])[0] if first else function(x[i])

    return run


def plus(x: Any) -> Any:
    return x + mpmath.log1p(mpmath.exp(-x)) if x > 0 else mpmath.log1p(mpmath.exp(x))


EXACT = {
    "exp": mpmath.exp,
    "log": mpmath.log,
    "softplus": plus,
    "logistic": lambda x: 1 / (1 + mpmath.exp(-x)),
}
LOOPS = {name: loop(name) for name in EXACT}


def compute(name: str, x: np.ndarray) -> np.ndarray:
    result = np.empty_like(x)
    LOOPS[name](x, result)
    return result


def arguments(name: str, kind: Any) -> np.ndarray:
    draw = np.random.default_rng(5)
    reach = 86.0 if kind is np.float32 else 708.0
    x = np.concatenate(
        [
            draw.uniform(-reach, reach, 400),
            3 * draw.standard_normal(400),
            1e-4 * draw.standard_normal(50),
            [0.0, -0.0, 1.0, -1.0],
        ]
    )
    if name == "log":
        x = np.concatenate([np.exp(x), 1 + 1e-3 * draw.standard_normal(100), [1.0, 1e-40]])
    return x.astype(kind)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", EXACT)
def test_relative_error(name: str, kind: Any) -> None:
    x = arguments(name, kind)
    with mpmath.workdps(40):
        for value, result in zip(x, compute(name, x), strict=True):
            exact = EXACT[name](mpmath.mpf(float(value)))
            error = abs(mpmath.mpf(float(result)) - exact)
            assert error <= 4 * float(np.finfo(kind).eps) * abs(exact), value


@pytest.mark.parametrize("kind", KINDS)
def test_limits_and_nan(kind: Any) -> None:
    large = np.array([1e3, 1e20, np.finfo(kind).max, np.inf], kind)
    nan = np.full(40, np.nan, kind)
    for name, x, expected in (
        ("exp", -large, 0.0),
        ("exp", large, np.inf),
        ("logistic", -large, 0.0),
        ("logistic", large, 1.0),
        ("softplus", -large, 0.0),
        ("softplus", large, large),
        ("log", np.array([0.0, -1.0, -np.inf, np.inf], kind), [-np.inf, np.nan, np.nan, np.inf]),
        *((name, nan, nan) for name in EXACT),
    ):
        np.testing.assert_array_equal(compute(name, x), expected, err_msg=name)


@pytest.mark.parametrize("kind", KINDS)
def test_functions_with_derivatives(kind: Any) -> None:
    @njit(error_model="numpy")
    def pairs(x: Any, out: Any) -> None:
        for i in range(len(x)):
            out[0, i], out[1, i] = functions.softplus_logistic(x[i])
            out[2, i], out[3, i] = functions.torch_softplus(x[i])

    x = np.linspace(-50, 50, 301).astype(kind)
    out = np.empty((4, len(x)), kind)
    pairs(x, out)
    for values, name in zip(out, ("softplus", "logistic"), strict=False):
        np.testing.assert_allclose(values, compute(name, x), rtol=4 * np.finfo(kind).eps)
    short = x <= 20
    np.testing.assert_array_equal(out[2:, short], out[:2, short])
    np.testing.assert_array_equal(out[2, ~short], x[~short])
    np.testing.assert_array_equal(out[3, ~short], 1.0)


def test_functions_need_compilation() -> None:
    for name in ["exp", "log", "logistic", "softplus_logistic", "torch_softplus"]:
        with pytest.raises(TypeError, match="Numba"):
            getattr(functions, name)(1.0)
    with pytest.raises(TypeError, match="Numba"):
        functions.real(1.0, 2.0)
