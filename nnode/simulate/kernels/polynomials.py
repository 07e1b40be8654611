"""What the vectorisable functions are made of: polynomials, and the digits of numbers.

Compiled in place, not called. Used by :mod:`nnode.simulate.kernels.functions` alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic

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
#: log(2) in two parts, the first with so few digits that a whole multiple of it is exact
LOG2 = {
    32: (0.693359375, -2.121944400546905827679e-4),
    64: (0.693147180369123816490, 1.90821492927058770002e-10),
}
LOG2E = 1.442695040888963407360
#: Binary digits after the leading one.
MANTISSA = {32: 23, 64: 52}
#: Where e^x leaves the normal numbers of its type: below it is 0, above inf
RANGE = {32: (-87.6, 89.0), 64: (-708.7, 710.0)}


def is_float(*args: Any) -> bool:
    """Whether all of these Numba types are those of floating-point numbers."""
    return all(isinstance(arg, types.Float) for arg in args)


def _polynomial(table: dict[int, tuple[float, ...]], factor: float = 1.0) -> Any:
    """A function of x that evaluates one polynomial, coefficients by bit width."""

    @intrinsic
    def evaluate(typing_context: Any, x: Any) -> Any:
        if not is_float(x):
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


exp_polynomial = _polynomial(_EXP, 2.0)
log1p_polynomial = _polynomial(_LOG1P)
log_polynomial = _polynomial(_LOG)


def whole(width: int) -> float:
    """A number so large that its last binary digit is 1; adding it rounds."""
    return 1.5 * 2.0 ** MANTISSA[width]


def _half_power_code(typing_context: Any, t: Any) -> Any:
    """2^(n-1), where n + bias - 1 stands in the lowest digits of ``t``."""
    width = t.bitwidth

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        integer = ir.IntType(width)
        digits = builder.bitcast(args[0], integer)
        shifted = builder.shl(digits, ir.Constant(integer, MANTISSA[width]))
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

        shift = ir.Constant(integer, MANTISSA[width])
        digits = builder.bitcast(args[0], integer)
        away = builder.sub(digits, ir.Constant(integer, digits_of(0.5**0.5)))
        k = builder.ashr(away, shift)
        m = builder.bitcast(builder.sub(digits, builder.shl(k, shift)), kind)
        # conversion of 64-bit integers is scalar on many processors, an addition is not
        large = builder.add(k, ir.Constant(integer, digits_of(whole(width))))
        number = builder.fsub(builder.bitcast(large, kind), ir.Constant(kind, whole(width)))
        return context.make_tuple(builder, signature.return_type, (m, number))

    return types.UniTuple(x, 2)(x), emit


half_power: Any = intrinsic(_half_power_code)
mantissa_exponent: Any = intrinsic(_mantissa_exponent_code)
