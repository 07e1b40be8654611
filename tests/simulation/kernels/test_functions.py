"""The vectorisable functions against arbitrary-precision arithmetic, and at the ends."""

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

    return run  # type: ignore[no-any-return]


def plus(x: Any) -> Any:
    return x + mpmath.log1p(mpmath.exp(-x)) if x > 0 else mpmath.log1p(mpmath.exp(x))


EXACT = {
    "exp": mpmath.exp,
    "log": mpmath.log,
    "softplus": plus,
    "logistic": lambda x: 1 / (1 + mpmath.exp(-x)),
}
LOOPS = {name: loop(name) for name in EXACT}


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
def test_a_few_units_in_the_last_place(name: str, kind: Any) -> None:
    x = arguments(name, kind)
    computed = np.empty_like(x)
    LOOPS[name](x, computed)
    with mpmath.workdps(40):
        for value, result in zip(x, computed, strict=True):
            exact = EXACT[name](mpmath.mpf(float(value)))
            error = abs(mpmath.mpf(float(result)) - exact)
            assert error <= 4 * float(np.finfo(kind).eps) * abs(exact), value


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("name", "below", "above"),
    [("exp", 0.0, np.inf), ("logistic", 0.0, 1.0), ("softplus", 0.0, None)],
)
def test_saturates_without_nan(name: str, below: float, above: float | None, kind: Any) -> None:
    large = np.array([1e3, 1e20, np.finfo(kind).max, np.inf], kind)
    computed = np.empty_like(large)
    LOOPS[name](-large, computed)
    np.testing.assert_array_equal(computed, below)
    LOOPS[name](large, computed)
    np.testing.assert_array_equal(computed, large if above is None else above)


@pytest.mark.parametrize("kind", KINDS)
def test_logarithm_at_its_ends(kind: Any) -> None:
    x = np.array([0.0, -1.0, -np.inf, np.inf], kind)
    computed = np.empty_like(x)
    LOOPS["log"](x, computed)
    np.testing.assert_array_equal(computed, np.array([-np.inf, np.nan, np.nan, np.inf], kind))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", EXACT)
def test_nan_stays_nan(name: str, kind: Any) -> None:
    computed = np.zeros(40, kind)
    LOOPS[name](np.full(40, np.nan, kind), computed)
    assert np.isnan(computed).all()


@pytest.mark.parametrize("kind", KINDS)
def test_pairs_agree_with_their_parts(kind: Any) -> None:
    @njit(error_model="numpy")
    def pairs(x: Any, out: Any) -> None:
        for i in range(len(x)):
            out[0, i], out[1, i] = functions.softplus_logistic(x[i])
            out[2, i], out[3, i] = functions.torch_softplus(x[i])

    x = np.linspace(-50, 50, 301).astype(kind)
    out, value, slope = np.empty((4, len(x)), kind), np.empty_like(x), np.empty_like(x)
    pairs(x, out)
    LOOPS["softplus"](x, value)
    LOOPS["logistic"](x, slope)
    np.testing.assert_allclose(out[0], value, rtol=4 * np.finfo(kind).eps)
    np.testing.assert_allclose(out[1], slope, rtol=4 * np.finfo(kind).eps)
    short = x <= 20
    np.testing.assert_array_equal(out[2:, short], out[:2, short])
    np.testing.assert_array_equal(out[2, ~short], x[~short])
    np.testing.assert_array_equal(out[3, ~short], 1.0)


def test_functions_are_for_compiled_code() -> None:
    for name in ["exp", "log", "logistic", "softplus_logistic", "torch_softplus"]:
        with pytest.raises(TypeError, match="Numba"):
            getattr(functions, name)(1.0)
    with pytest.raises(TypeError, match="Numba"):
        functions.real(1.0, 2.0)
