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
``softplus(x)``           log(1 + e^x)                           0; x
``logistic(x)``           1 / (1 + e^-x), softplus' derivative   0; 1
``softplus_logistic(x)``  both, for little more than one         see above
``torch_softplus(x)``     both, as PyTorch computes them         0; x and 1 for x > 20
``real(value, like)``     ``value`` in the type of ``like``
========================  =====================================  =============================

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
from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic, overload

#: Flags of every compiled function: fused multiply-add, and zeros without sign.
FLAGS = {"contract", "nsz"}
#: Options of every function that is to vanish into its caller's loop.
INLINE: Any = {"forceinline": True, "fastmath": FLAGS, "error_model": "numpy"}

_CONTRACT = ("contract",)

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
# log(2) in two parts, the first with so few digits that a whole multiple of it is exact
_LOG2 = {
    32: (0.693359375, -2.121944400546905827679e-4),
    64: (0.693147180369123816490, 1.90821492927058770002e-10),
}
_LOG2E = 1.442695040888963407360
_MANTISSA = {32: 23, 64: 52}
# where e^x leaves the normal numbers of its type: below it is 0, above inf
_RANGE = {32: (-87.6, 89.0), 64: (-708.7, 710.0)}


def _float(*args: Any) -> bool:
    return all(isinstance(arg, types.Float) for arg in args)


def _polynomial(table: dict[int, tuple[float, ...]], factor: float = 1.0) -> Any:
    """A function of x that evaluates one polynomial, coefficients by bit width."""

    @intrinsic
    def evaluate(typing_context: Any, x: Any) -> Any:
        if not _float(x):
            raise TypingError(f"expected float32 or float64, got {x}")

        def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            kind = args[0].type
            terms = [
                ir.Constant(kind, np.float32(c * factor) if x.bitwidth == 32 else c * factor)
                for c in table[x.bitwidth]
            ]
            total = terms[-1]
            for term in terms[-2::-1]:
                product = builder.fmul(total, args[0], flags=_CONTRACT)
                total = builder.fadd(product, term, flags=_CONTRACT)
            return total

        return x(x), emit

    return evaluate


_exp_polynomial = _polynomial(_EXP, 2.0)
_log1p_polynomial = _polynomial(_LOG1P)
_log_polynomial = _polynomial(_LOG)


def _whole(width: int) -> float:
    """A number so large that its last binary digit is 1; adding it rounds."""
    return 1.5 * 2.0 ** _MANTISSA[width]


def _half_power_code(typing_context: Any, t: Any) -> Any:
    """2^(n-1), where n + bias - 1 stands in the lowest digits of ``t``."""
    width = t.bitwidth

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        integer = ir.IntType(width)
        digits = builder.bitcast(args[0], integer)
        shifted = builder.shl(digits, ir.Constant(integer, _MANTISSA[width]))
        return builder.bitcast(shifted, args[0].type)

    return t(t), emit


def _mantissa_exponent_code(typing_context: Any, x: Any) -> Any:
    """(m, k) of a positive normal number m 2^k with sqrt(1/2) <= m < sqrt(2)."""
    width = x.bitwidth

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        integer, kind = ir.IntType(width), args[0].type
        digit = np.int32 if width == 32 else np.int64
        real = np.float32 if width == 32 else np.float64

        def digits_of(value: float) -> int:
            return int(real(value).view(digit))

        shift = ir.Constant(integer, _MANTISSA[width])
        digits = builder.bitcast(args[0], integer)
        away = builder.sub(digits, ir.Constant(integer, digits_of(0.5**0.5)))
        k = builder.ashr(away, shift)
        m = builder.bitcast(builder.sub(digits, builder.shl(k, shift)), kind)
        # conversion of 64-bit integers is scalar on many processors, an addition is not
        large = builder.add(k, ir.Constant(integer, digits_of(_whole(width))))
        number = builder.fsub(builder.bitcast(large, kind), ir.Constant(kind, _whole(width)))
        return context.make_tuple(builder, signature.return_type, (m, number))

    return types.UniTuple(x, 2)(x), emit


_half_power: Any = intrinsic(_half_power_code)
_mantissa_exponent: Any = intrinsic(_mantissa_exponent_code)


def real(value: float, like: Any) -> Any:
    """``value`` in the type of ``like``; inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def exp(x: Any) -> Any:
    """e^x; inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def log(x: Any) -> Any:
    """Natural logarithm; inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def softplus(x: Any) -> Any:
    """log(1 + e^x); inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def logistic(x: Any) -> Any:
    """1 / (1 + e^-x); inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def softplus_logistic(x: Any) -> Any:
    """(softplus(x), logistic(x)); inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def torch_softplus(x: Any) -> Any:
    """(softplus(x), its derivative) as in PyTorch; inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def _exp_unbounded(x: Any) -> Any:
    """e^x for x within the range of its type."""


@overload(real, jit_options=INLINE)
def _real(value: Any, like: Any) -> Callable[..., Any] | None:
    if not _float(like):
        return None
    kind = np.float32 if like.bitwidth == 32 else np.float64

    def body(value: Any, like: Any) -> Any:
        return kind(value)

    return body


@overload(_exp_unbounded, jit_options=INLINE)
def _exp_unbounded_overload(x: Any) -> Callable[..., Any] | None:
    if not _float(x):
        return None
    kind, width = (np.float32, 32) if x.bitwidth == 32 else (np.float64, 64)
    log2e, high, low = kind(_LOG2E), kind(_LOG2[width][0]), kind(_LOG2[width][1])
    large = kind(_whole(width) + (126 if width == 32 else 1022))

    def body(x: Any) -> Any:
        t = x * log2e + large
        n = t - large
        r = (x - n * high) - n * low
        # half the power and twice the polynomial: 2^128 is no float32, e^88.7 is one
        return _exp_polynomial(r) * _half_power(t)

    return body


@overload(exp, jit_options=INLINE)
def _exp(x: Any) -> Callable[..., Any] | None:
    if not _float(x):
        return None
    kind, width = (np.float32, 32) if x.bitwidth == 32 else (np.float64, 64)
    bottom, top = kind(_RANGE[width][0]), kind(_RANGE[width][1])

    def body(x: Any) -> Any:
        # written so that NaN passes
        y = bottom if x < bottom else x
        y = top if y > top else y
        return _exp_unbounded(y)

    return body


def _exp_negative(x: Any) -> Any:
    """e^-|x|."""


@overload(_exp_negative, jit_options=INLINE)
def _exp_negative_overload(x: Any) -> Callable[..., Any] | None:
    if not _float(x):
        return None
    bottom = np.float32(_RANGE[32][0]) if x.bitwidth == 32 else np.float64(_RANGE[64][0])

    def body(x: Any) -> Any:
        y = -abs(x)
        y = bottom if y < bottom else y
        return _exp_unbounded(y)

    return body


@overload(log, jit_options=INLINE)
def _log(x: Any) -> Callable[..., Any] | None:
    if not _float(x):
        return None
    kind, width = (np.float32, 32) if x.bitwidth == 32 else (np.float64, 64)
    high, low = kind(_LOG2[width][0]), kind(_LOG2[width][1])
    smallest = kind(np.finfo(kind).tiny)
    up, places = kind(2.0 ** _MANTISSA[width]), kind(_MANTISSA[width])
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


@overload(softplus, jit_options=INLINE)
def _softplus(x: Any) -> Callable[..., Any] | None:
    if not _float(x):
        return None
    zero = np.float32(0) if x.bitwidth == 32 else np.float64(0)

    def body(x: Any) -> Any:
        u = _exp_negative(x)
        return (x if x > zero else zero) + u * _log1p_polynomial(u)

    return body


@overload(logistic, jit_options=INLINE)
def _logistic(x: Any) -> Callable[..., Any] | None:
    if not _float(x):
        return None
    zero, one = (np.float32(0), np.float32(1)) if x.bitwidth == 32 else (0.0, 1.0)

    def body(x: Any) -> Any:
        u = _exp_negative(x)
        # the numerator is chosen, not the quotient: one division
        return (u if x < zero else one) / (one + u)

    return body


@overload(softplus_logistic, jit_options=INLINE)
def _softplus_logistic(x: Any) -> Callable[..., Any] | None:
    if not _float(x):
        return None
    zero, one = (np.float32(0), np.float32(1)) if x.bitwidth == 32 else (0.0, 1.0)

    def body(x: Any) -> Any:
        u = _exp_negative(x)
        plus = (x if x > zero else zero) + u * _log1p_polynomial(u)
        return plus, (u if x < zero else one) / (one + u)

    return body


@overload(torch_softplus, jit_options=INLINE)
def _torch_softplus(x: Any) -> Callable[..., Any] | None:
    if not _float(x):
        return None
    if x.bitwidth == 32:  # 2e-9 is less than one unit in the last place

        def short(x: Any) -> Any:
            return softplus_logistic(x)

        return short

    def body(x: Any) -> Any:
        value, slope = softplus_logistic(x)
        beyond = x > 20.0
        return (x if beyond else value), (1.0 if beyond else slope)

    return body
