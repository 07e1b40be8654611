"""Exponential functions that the compiler can turn into vector instructions.

Calls into the mathematical library stay scalar inside a compiled loop, which costs a factor of
ten and more. The functions here are branch-free polynomials, inlined by force, so that a loop
over them becomes vector code. They take float32 or float64 and return the same type, and work
only inside functions compiled by Numba:

========================  =====================================  =============================
function                  value                                  at the ends
========================  =====================================  =============================
``exp(x)``                e^x                                    0 below, inf above the range
``log(x)``                natural logarithm                      -inf at 0, NaN below
``logistic(x)``           1 / (1 + e^-x)                         0; 1
``softplus_logistic(x)``  log(1 + e^x), and its derivative       0; x and 0; 1
``torch_softplus(x)``     both, as PyTorch computes them         0; x and 1 for x > 20
``real(value, like)``     ``value`` in the type of ``like``
========================  =====================================  =============================

Others are made of these, under the names of :mod:`nnode.model.operations`. All may be computed from
either branch of a condition, so that ``where`` is an instruction and no branch.

PyTorch's softplus is x itself beyond 20, which is off by 2e-9; a network must do the same to
agree with PyTorch to the last digits. NaN gives NaN everywhere. Relative errors stay below 4
units in the last place (measured, see the tests), apart from results within a factor of 2 of the
smallest normal number and below, which may become 0.

A plain number such as 0.5 is float64 to Numba and would turn a float32 loop into a mixed one:
write ``real(0.5, x)``.

All functions are compiled with the flags ``contract`` and ``nsz`` alone. Full ``fastmath``
would break the range reductions, and the NaN of a simulation that blew up.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, overload

#: Flags of every compiled function: fused multiply-add, and zeros without sign.
FLAGS = {"contract", "nsz"}
#: Options of every function that is to vanish into its caller's loop.
INLINE: Any = {"forceinline": True, "fastmath": FLAGS, "error_model": "numpy"}
#: Options of functions that hold a loop.
LOOP: Any = {"fastmath": FLAGS, "error_model": "numpy"}

# Chebyshev interpolants of the named functions, computed with 50 digits; lowest power first.
# e^r for |r| <= log(2)/2, errors 2e-9 and 3e-18
_EXP = {
    32: (
        1.0,
        1.00000003771621384254,
        0.500000004711775767439,
        0.166664155146532754274,
        0.0416663528967751567865,
        0.00837512639815333568204,
        0.00139411084339726746085,
    ),
    64: (
        0.999999999999999996933,
        0.999999999999999999764,
        0.500000000000001838553,
        0.166666666666666808057,
        0.0416666666664880954954,
        0.00833333333331960061091,
        0.00138888889523147746524,
        0.000198412698900471137067,
        0.000024801485482328492419,
        0.0000027557240918578969823,
        2.76326396390410297493e-7,
        2.5110037605963777712e-8,
    ),
}
# log(1 + u) / u for 0 <= u <= 1, errors 3e-8 and 6e-17
_LOG1P = {
    32: (
        0.999999965925509633898,
        -0.499994449763400948935,
        0.33318121707533190711,
        -0.248353989885155441301,
        0.190768807357477941354,
        -0.136022476224794049625,
        0.0775160867403694123913,
        -0.0290740646774942012784,
        0.00512610214096691339682,
    ),
    64: (
        0.999999999999999936399,
        -0.499999999999949059467,
        0.333333333326518324907,
        -0.249999999636291075227,
        0.199999989679202162096,
        -0.166666486659057620449,
        0.142855038356318111019,
        -0.124982539332801252394,
        0.111004124039941493755,
        -0.0995015979448041810981,
        0.0891045737791934367523,
        -0.0781661998990208076546,
        0.0650458267690869899976,
        -0.049194866349137803936,
        0.0322117318057700102917,
        -0.0173379923612713908281,
        0.00723815434800420666636,
        -0.00217226324948275166126,
        0.000413714998632802538582,
        -0.0000373611109062551082644,
    ),
}
# (2 artanh(s) - 2 s) / s^3 as a function of s^2, for |s| <= (sqrt(2) - 1) / (sqrt(2) + 1)
_LOG = {
    32: (
        0.666666850395758550224,
        0.399887805660219818994,
        0.295799493919727847094,
    ),
    64: (
        0.666666666666666968616,
        0.399999999998995044898,
        0.285714286259754849215,
        0.222222111347950798551,
        0.181828891252617220803,
        0.153317216005560412686,
        0.146164496850434058604,
    ),
}
#: log(2) in two parts, the first with so few digits that a whole multiple of it is exact
LOG2 = {
    32: (0.693359375, -2.121944400546905827679e-4),
    64: (0.693147180369123816490, 1.90821492927058770002e-10),
}
LOG2E = 1.442695040888963407360
_DIGITS: dict[int, Any] = {32: np.int32, 64: np.int64}
#: Binary digits after the leading one.
MANTISSA = {32: 23, 64: 52}
#: Where e^x leaves the normal numbers of its type: below it is 0, above inf
RANGE = {32: (-87.6, 89.0), 64: (-708.7, 710.0)}


def _for_compiled_code(typed: Callable[[Any, int], Callable[[Any], Any]]) -> Callable[[Any], Any]:
    """A function of one number. ``typed`` makes its body, of the number's type and of the bits
    of that."""

    def function(x: Any) -> Any:
        raise TypeError("this function works only inside functions compiled by Numba")

    @overload(function, jit_options=INLINE)
    def overloaded(x: Any) -> Callable[[Any], Any] | None:
        if not isinstance(x, types.Float):
            return None
        return typed(np.float32 if x.bitwidth == 32 else np.float64, x.bitwidth)

    function.__name__, function.__doc__ = typed.__name__, typed.__doc__
    return function


def _polynomial(table: dict[int, tuple[float, ...]], factor: float = 1.0) -> Any:
    """A function of x that evaluates one polynomial, coefficients by bit width."""

    def evaluate(kind: Any, width: int) -> Callable[[Any], Any]:
        numbers = tuple(kind(factor * c) for c in table[width])
        text = "c[-1]"
        for i in reversed(range(len(numbers) - 1)):
            text = f"c[{i}] + x * ({text})"
        body: Callable[[Any], Any] = eval(f"lambda x: {text}", {"c": numbers})
        body.__annotations__ = {"x": "Any"}  # as Numba compares it with the others
        return body

    return _for_compiled_code(evaluate)


_exp_polynomial = _polynomial(_EXP, 2.0)
_log1p_polynomial = _polynomial(_LOG1P)
_log_polynomial = _polynomial(_LOG)


def _whole(width: int) -> float:
    """A number so large that its last binary digit is 1; adding it rounds."""
    return 1.5 * 2.0 ** MANTISSA[width]


@_for_compiled_code
def _half_power(kind: Any, width: int) -> Callable[[Any], Any]:
    """2^(n-1), where n + bias - 1 stands in the lowest digits of ``t``."""
    digits, shift = _DIGITS[width], _DIGITS[width](MANTISSA[width])

    def body(x: Any) -> Any:
        return digits(kind(x).view(digits) << shift).view(kind)

    return body


@_for_compiled_code
def _mantissa_exponent(kind: Any, width: int) -> Callable[[Any], Any]:
    """(m, k) of a positive normal number m 2^k with sqrt(1/2) <= m < sqrt(2)."""
    digits, shift = _DIGITS[width], _DIGITS[width](MANTISSA[width])
    smallest_bits, large = kind(0.5**0.5).view(digits), kind(_whole(width))
    base = large.view(digits)

    def body(x: Any) -> Any:
        bits = kind(x).view(digits)
        k = digits(digits(bits - smallest_bits) >> shift)
        m = digits(bits - digits(k << shift)).view(kind)
        # conversion of 64-bit integers is scalar on many processors, an addition is not
        return m, digits(k + base).view(kind) - large

    return body


def real(value: float, like: Any) -> Any:
    """``value`` in the type of ``like``; inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


@overload(real, jit_options=INLINE)
def _real(value: Any, like: Any) -> Callable[..., Any] | None:
    if not isinstance(like, types.Float):
        return None
    kind = np.float32 if like.bitwidth == 32 else np.float64

    def body(value: Any, like: Any) -> Any:
        return kind(value)

    return body


@_for_compiled_code
def _exp_unbounded(kind: Any, width: int) -> Callable[[Any], Any]:
    """e^x for x within the range of its type."""
    log2e, high, low = kind(LOG2E), kind(LOG2[width][0]), kind(LOG2[width][1])
    large = kind(_whole(width) + (126 if width == 32 else 1022))

    def body(x: Any) -> Any:
        t = x * log2e + large
        n = t - large
        r = (x - n * high) - n * low
        # half the power and twice the polynomial: 2^128 is no float32, e^88.7 is one
        return _exp_polynomial(r) * _half_power(t)

    return body


@_for_compiled_code
def exp(kind: Any, width: int) -> Callable[[Any], Any]:
    """e^x; inside compiled functions only."""
    bottom, top = kind(RANGE[width][0]), kind(RANGE[width][1])

    def body(x: Any) -> Any:
        # written so that NaN passes
        y = bottom if x < bottom else x
        y = top if y > top else y
        return _exp_unbounded(y)

    return body


@_for_compiled_code
def _exp_negative(kind: Any, width: int) -> Callable[[Any], Any]:
    """e^-|x|."""
    bottom = kind(RANGE[width][0])

    def body(x: Any) -> Any:
        y = -abs(x)
        y = bottom if y < bottom else y
        return _exp_unbounded(y)

    return body


@_for_compiled_code
def log(kind: Any, width: int) -> Callable[[Any], Any]:
    """Natural logarithm; inside compiled functions only."""
    high, low = kind(LOG2[width][0]), kind(LOG2[width][1])
    smallest = kind(np.finfo(kind).tiny)
    up, places = kind(2.0 ** MANTISSA[width]), kind(MANTISSA[width])
    zero, one, two, infinity, nan = kind(0), kind(1), kind(2), kind(np.inf), kind(np.nan)

    def body(x: Any) -> Any:
        tiny = x < smallest
        m, k = _mantissa_exponent(x * up if tiny else x)
        k = k - places if tiny else k
        f = m - one
        s = f / (two + f)
        z = s * s
        # f - s f = 2 s without a rounding error in the leading part
        tail = s * (z * _log_polynomial(z) - f)
        y = k * high + (f + (tail + k * low))
        y = y if x < infinity else x
        y = -infinity if x == zero else y
        return nan if x < zero else y

    return body


@_for_compiled_code
def logistic(kind: Any, width: int) -> Callable[[Any], Any]:
    """1 / (1 + e^-x); inside compiled functions only."""
    zero, one = kind(0), kind(1)

    def body(x: Any) -> Any:
        u = _exp_negative(x)
        # the numerator is chosen, not the quotient: one division
        return (u if x < zero else one) / (one + u)

    return body


@_for_compiled_code
def softplus_logistic(kind: Any, width: int) -> Callable[[Any], Any]:
    """(softplus(x), logistic(x)); inside compiled functions only."""
    zero, one = kind(0), kind(1)

    def body(x: Any) -> Any:
        u = _exp_negative(x)
        plus = (x if x > zero else zero) + u * _log1p_polynomial(u)
        return plus, (u if x < zero else one) / (one + u)

    return body


@_for_compiled_code
def torch_softplus(kind: Any, width: int) -> Callable[[Any], Any]:
    """(softplus(x), its derivative) as in PyTorch; inside compiled functions only."""

    def short(x: Any) -> Any:
        return softplus_logistic(x)

    def body(x: Any) -> Any:
        value, slope = softplus_logistic(x)
        beyond = x > 20.0
        return (x if beyond else value), (1.0 if beyond else slope)

    # in single precision 2e-9 is less than one unit in the last place
    return short if width == 32 else body


@njit(**{**INLINE, "fastmath": {*FLAGS, "reassoc"}})
def add(total: Any, value: Any) -> Any:
    """A sum whose order the compiler may choose; nothing else in a loop may be reordered."""
    return total + value


@njit(**INLINE)
def where(condition: Any, a: Any, b: Any) -> Any:
    return a if condition else b


@njit(**INLINE)
def recip(x: Any) -> Any:
    return real(1, x) / x


@njit(**INLINE)
def tanh(x: Any) -> Any:
    """By the logistic function, which becomes vector instructions."""
    two = real(2, x)
    return two * logistic(two * x) - real(1, x)


@njit(**INLINE)
def softplus(x: Any) -> Any:
    return torch_softplus(x)[0]


@njit(**INLINE)
def softplus_slope(x: Any) -> Any:
    return torch_softplus(x)[1]


_memmove: Any = cgutils.raw_memmove


@intrinsic
def copy(typing_context: Any, target: Any, source: Any, number: Any) -> Any:
    """The first numbers of a row to another one, which may be the same array further on: a loop
    that cannot know how far would take them one by one."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        rows = [
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(signature.args[:2], args[:2], strict=True)
        ]
        _memmove(builder, *rows, args[2], context.get_abi_sizeof(rows[0].type.pointee))
        return context.get_dummy_value()

    return types.none(target, source, types.intp), emit
