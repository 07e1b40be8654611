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

from nnode.simulate.kernels.polynomials import (
    LOG2,
    LOG2E,
    MANTISSA,
    RANGE,
    exp_polynomial,
    half_power,
    is_float,
    log1p_polynomial,
    log_polynomial,
    mantissa_exponent,
    whole,
)

#: Flags of every compiled function: fused multiply-add, and zeros without sign.
FLAGS = {"contract", "nsz"}
#: Options of every function that is to vanish into its caller's loop.
INLINE: Any = {"forceinline": True, "fastmath": FLAGS, "error_model": "numpy"}
#: Options of functions that hold a loop.
LOOP: Any = {"fastmath": FLAGS, "error_model": "numpy"}


@njit(**{**INLINE, "fastmath": {*FLAGS, "reassoc"}})
def add(total: Any, value: Any) -> Any:
    """A sum whose order the compiler may choose; nothing else in a loop may be reordered."""
    return total + value


def real(value: float, like: Any) -> Any:
    """``value`` in the type of ``like``; inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def exp(x: Any) -> Any:
    """e^x; inside compiled functions only."""
    raise TypeError("this function works only inside functions compiled by Numba")


def log(x: Any) -> Any:
    """Natural logarithm; inside compiled functions only."""
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
    if not is_float(like):
        return None
    kind = np.float32 if like.bitwidth == 32 else np.float64

    def body(value: Any, like: Any) -> Any:
        return kind(value)

    return body


@overload(_exp_unbounded, jit_options=INLINE)
def _exp_unbounded_overload(x: Any) -> Callable[..., Any] | None:
    if not is_float(x):
        return None
    kind, width = (np.float32, 32) if x.bitwidth == 32 else (np.float64, 64)
    log2e, high, low = kind(LOG2E), kind(LOG2[width][0]), kind(LOG2[width][1])
    large = kind(whole(width) + (126 if width == 32 else 1022))

    def body(x: Any) -> Any:
        t = x * log2e + large
        n = t - large
        r = (x - n * high) - n * low
        # half the power and twice the polynomial: 2^128 is no float32, e^88.7 is one
        return exp_polynomial(r) * half_power(t)

    return body


@overload(exp, jit_options=INLINE)
def _exp(x: Any) -> Callable[..., Any] | None:
    if not is_float(x):
        return None
    kind, width = (np.float32, 32) if x.bitwidth == 32 else (np.float64, 64)
    bottom, top = kind(RANGE[width][0]), kind(RANGE[width][1])

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
    if not is_float(x):
        return None
    bottom = np.float32(RANGE[32][0]) if x.bitwidth == 32 else np.float64(RANGE[64][0])

    def body(x: Any) -> Any:
        y = -abs(x)
        y = bottom if y < bottom else y
        return _exp_unbounded(y)

    return body


@overload(log, jit_options=INLINE)
def _log(x: Any) -> Callable[..., Any] | None:
    if not is_float(x):
        return None
    kind, width = (np.float32, 32) if x.bitwidth == 32 else (np.float64, 64)
    high, low = kind(LOG2[width][0]), kind(LOG2[width][1])
    smallest = kind(np.finfo(kind).tiny)
    up, places = kind(2.0 ** MANTISSA[width]), kind(MANTISSA[width])
    zero, one, two, infinity, nan = kind(0), kind(1), kind(2), kind(np.inf), kind(np.nan)

    def body(x: Any) -> Any:
        tiny = x < smallest
        m, k = mantissa_exponent(x * up if tiny else x)
        k = k - places if tiny else k
        f = m - one
        s = f / (two + f)
        z = s * s
        # f - s f = 2 s without a rounding error in the leading part
        tail = s * (z * log_polynomial(z) - f)
        y = k * high + (f + (tail + k * low))
        y = y if x < infinity else x
        y = -infinity if x == zero else y
        return nan if x < zero else y

    return body


@overload(logistic, jit_options=INLINE)
def _logistic(x: Any) -> Callable[..., Any] | None:
    if not is_float(x):
        return None
    zero, one = (np.float32(0), np.float32(1)) if x.bitwidth == 32 else (0.0, 1.0)

    def body(x: Any) -> Any:
        u = _exp_negative(x)
        # the numerator is chosen, not the quotient: one division
        return (u if x < zero else one) / (one + u)

    return body


@overload(softplus_logistic, jit_options=INLINE)
def _softplus_logistic(x: Any) -> Callable[..., Any] | None:
    if not is_float(x):
        return None
    zero, one = (np.float32(0), np.float32(1)) if x.bitwidth == 32 else (0.0, 1.0)

    def body(x: Any) -> Any:
        u = _exp_negative(x)
        plus = (x if x > zero else zero) + u * log1p_polynomial(u)
        return plus, (u if x < zero else one) / (one + u)

    return body


@overload(torch_softplus, jit_options=INLINE)
def _torch_softplus(x: Any) -> Callable[..., Any] | None:
    if not is_float(x):
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
