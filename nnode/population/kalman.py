"""A Kalman filter of many segments at once, compiled.

The state is (d, e, a, q): d the M states of the linear response, e the J processes that force them,
a the autocorrelated errors, if there are any, and q the O oscillators, two elements each. a is
added to the first element of d, so that this element is measured. Without such errors, the first
elements of d are measured one after the other, plus the first elements of the oscillators along the
measured coordinate.

The last axis of arrays of states are the segments of a block, so that every inner loop is over
segments and becomes vector code. Arrays are allocated once, because allocations would take most of
the time.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from nnode.simulation.kernels.functions import INLINE, LOOP

#: Segments of a block, whose arrays fit the cache.
BLOCK = 16


@njit(cache=True, nogil=True, **LOOP)
def filtered(
    columns: np.ndarray,
    observed: np.ndarray,
    step: np.ndarray,
    forced: np.ndarray,
    sigma: np.ndarray,
    keep: np.ndarray,
    within: np.ndarray,
    variance: float,
    restart: np.ndarray,
    start: np.ndarray,
    direction: np.ndarray,
    omega: np.ndarray,
    dt: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Columns whitened by the filter, ``(S, K, C)``, and logarithms of the determinants of the
    samples' covariances, ``(S,)``.

    Args:
        columns, observed, step, forced, restart, dt: see
            :class:`~nnode.population.likelihood.Linearised`.
        sigma: ``(J + 1 + 2 O,)`` standard deviations of e, a and q. keep: the same of their
            autocorrelations over a sampling interval, without the oscillation.
        within: ``(J,)`` variances that are added to the sum of e at both ends of an interval.
        variance: of white errors.
        start: ``(M,)`` variances of d at restarts.
        direction: ``(S, K / A, O, A)`` unit vectors of the oscillators. omega: ``(O,)`` their
            angular frequencies, 1/s.
    """
    number, samples, width = columns.shape
    m, processes = forced.shape[-2:]
    axes = samples // (step.shape[1] + 1)
    lasting = sigma[processes] > 0
    if not lasting:
        others = np.arange(len(sigma)) != processes
        sigma, keep = sigma[others], keep[others]
    n, oscillating = m + len(sigma), m + len(sigma) - 2 * len(omega)
    fresh, turn = sigma**2 * (1 - keep**2), omega * dt
    white, logdet = np.zeros((number, samples, width)), np.zeros(number)
    mean, before = np.empty((n, width, BLOCK)), np.empty((n, width, BLOCK))
    spread, half = np.empty((n, n, BLOCK)), np.empty((m, n, BLOCK))
    forward, force = np.zeros((m, oscillating, BLOCK)), np.zeros((m, processes, BLOCK))
    way, covariance = np.zeros((len(omega), BLOCK)), np.empty((n, BLOCK))
    innovation, precision = np.zeros((width, BLOCK)), np.zeros(BLOCK)
    for first in range(0, number, BLOCK):
        block = slice(first, min(first + BLOCK, number))
        mean[:] = 0.0
        _begin(spread, sigma, m, processes, lasting)
        for k in range(_last(observed[block]) // axes + 1):
            if k:
                _set_transition(
                    step[block, k - 1], forced[block, k - 1], keep, lasting, forward, force
                )
                _predict_mean(mean, forward, keep, before)
                _predict_spread(spread, forward, keep, half)
                _add_innovations(spread, force, fresh, within)
                if lasting:
                    _add_error(spread, m + processes, fresh[processes])
                _oscillate(mean, spread, oscillating, turn, fresh)
            for b in range(len(restart[block, k])):
                if restart[first + b, k]:
                    _restart(mean[..., b], spread[..., b], start, sigma[: oscillating - m])
            for at in range(k * axes, (k + 1) * axes):
                axis = at - k * axes
                _fill(way, direction[block, k, :, axis])
                _fill(innovation, columns[block, at])
                _measure(spread, axis, oscillating, way, covariance, precision)
                _invert(precision, variance, observed[block, at])
                _condition(mean, spread, axis, oscillating, way, innovation, covariance, precision)
                _write(white[block, at], logdet[block], innovation, precision)
    return white, logdet


@njit(**INLINE)
def _begin(spread: np.ndarray, sigma: np.ndarray, m: int, processes: int, lasting: bool) -> None:
    """The covariance of the state before the first sample."""
    spread[:] = 0.0
    for p in range(len(sigma)):
        spread[m + p, m + p] = sigma[p] ** 2
    if lasting:
        spread[m + processes, m + processes] = 0.0
        _add_error(spread, m + processes, sigma[processes] ** 2)


@njit(**INLINE)
def _last(observed: np.ndarray) -> int:
    """The place of the last sample of any segment; 0 if there is none."""
    last = observed.shape[1] - 1
    while last > 0 and not observed[:, last].any():
        last -= 1
    return last


@njit(**INLINE)
def _turn(one: np.ndarray, other: np.ndarray, cosine: float, sine: float) -> None:
    """Turn two elements into each other."""
    for b in range(len(one)):
        x, y = one[b], other[b]
        one[b], other[b] = cosine * x + sine * y, cosine * y - sine * x


@njit(**INLINE)
def _fill(out: np.ndarray, values: np.ndarray) -> None:
    """Fill ``out``, whose last axis is the first one of ``values``."""
    for i in range(len(out)):
        for b in range(len(values)):
            out[i, b] = values[b, i]


@njit(**INLINE)
def _restart(mean: np.ndarray, spread: np.ndarray, start: np.ndarray, sigma: np.ndarray) -> None:
    """Restart d of one segment with the variances ``start``, and forget e, whose standard
    deviations are ``sigma``. The other states continue."""
    m = len(start)
    for i in range(m + len(sigma)):
        mean[i] = 0.0
        spread[i] = 0.0
        spread[:, i] = 0.0
        spread[i, i] = start[i] if i < m else sigma[i - m] ** 2


@njit(**INLINE)
def _oscillate(
    mean: np.ndarray, spread: np.ndarray, oscillating: int, turn: np.ndarray, fresh: np.ndarray
) -> None:
    """Turn the oscillators, the states from ``oscillating`` on, by the angles ``turn``, and add the
    variances of their innovations, the last ones of ``fresh``."""
    for o in range(len(turn)):
        first, cosine, sine = oscillating + 2 * o, np.cos(turn[o]), np.sin(turn[o])
        for c in range(mean.shape[1]):
            _turn(mean[first, c], mean[first + 1, c], cosine, sine)
        for j in range(len(spread)):
            _turn(spread[first, j], spread[first + 1, j], cosine, sine)
        for j in range(len(spread)):
            _turn(spread[j, first], spread[j, first + 1], cosine, sine)
        for i in (first, first + 1):
            spread[i, i] += fresh[len(fresh) + i - len(spread)]


@njit(**INLINE)
def _set_transition(
    step: np.ndarray,
    forced: np.ndarray,
    keep: np.ndarray,
    lasting: bool,
    forward: np.ndarray,
    force: np.ndarray,
) -> None:
    """Fill ``force`` with ``forced``, and ``forward`` ``(M, M + J)`` or ``(M, M + J + 1)`` with the
    derivatives of d after a sampling interval by (d, e, a) before it. All elements besides d decay
    by themselves."""
    size, m, processes = forced.shape
    for b in range(size):
        for i in range(m):
            for j in range(m):
                forward[i, j, b] = step[b, i, j]
            for p in range(processes):
                force[i, p, b] = forced[b, i, p]
                forward[i, m + p, b] = forced[b, i, p] * (1 + keep[p])
            if lasting:
                own = keep[processes] if i == 0 else 0.0
                forward[i, m + processes, b] = own - step[b, i, 0]


@njit(**INLINE)
def _add_error(spread: np.ndarray, place: int, variance: float) -> None:
    """Add a variance to the error, which the first state contains."""
    for i in (0, place):
        for j in (0, place):
            spread[i, j] += variance


@njit(**INLINE)
def _add_innovations(
    spread: np.ndarray, force: np.ndarray, fresh: np.ndarray, within: np.ndarray
) -> None:
    """Add the covariance of the innovations of e, of variances ``fresh``, and of d by them and by
    the variances ``within``."""
    m, processes = force.shape[:2]
    for p in range(processes):
        e = m + p
        spread[e, e] += fresh[p]
        for i in range(m):
            for b in range(spread.shape[2]):
                change = force[i, p, b] * fresh[p]
                spread[i, e, b] += change
                spread[e, i, b] += change
            for j in range(m):
                for b in range(spread.shape[2]):
                    spread[i, j, b] += force[i, p, b] * force[j, p, b] * (fresh[p] + within[p])


@njit(**INLINE)
def _predict_mean(
    mean: np.ndarray, forward: np.ndarray, keep: np.ndarray, before: np.ndarray
) -> None:
    """Replace the mean of the state by that of one sample later. ``before`` is a work array."""
    m, n = forward.shape[:2]
    width = mean.shape[1]
    before[:] = mean
    mean[:m] = 0.0
    for i in range(m):
        for j in range(n):
            for c in range(width):
                for b in range(mean.shape[2]):
                    mean[i, c, b] += forward[i, j, b] * before[j, c, b]
    for i in range(m, len(mean)):
        for c in range(width):
            for b in range(mean.shape[2]):
                mean[i, c, b] *= keep[i - m]


@njit(**INLINE)
def _predict_spread(
    spread: np.ndarray, forward: np.ndarray, keep: np.ndarray, half: np.ndarray
) -> None:
    """Replace the covariance of the state by that of one sample later, without innovations.
    ``half`` is a work array."""
    m, n = len(forward), len(spread)
    _multiply(half, forward, spread)
    _multiply_symmetric(spread, half, forward)
    for i in range(m, n):
        for j in range(m):
            for b in range(spread.shape[2]):
                spread[i, j, b] = keep[i - m] * half[j, i, b]
                spread[j, i, b] = keep[i - m] * half[j, i, b]
        for j in range(m, n):
            for b in range(spread.shape[2]):
                spread[i, j, b] *= keep[i - m] * keep[j - m]


@njit(**INLINE)
def _multiply(half: np.ndarray, forward: np.ndarray, spread: np.ndarray) -> None:
    """The rows of d of ``forward`` times ``spread``."""
    m, coupled = forward.shape[:2]
    for i in range(m):
        for j in range(len(spread)):
            for b in range(spread.shape[2]):
                half[i, j, b] = 0.0
            for q in range(coupled):
                for b in range(spread.shape[2]):
                    half[i, j, b] += forward[i, q, b] * spread[q, j, b]


@njit(**INLINE)
def _multiply_symmetric(spread: np.ndarray, half: np.ndarray, forward: np.ndarray) -> None:
    """The block of d of ``half`` times the transposed ``forward``."""
    m, coupled = forward.shape[:2]
    for i in range(m):
        for j in range(i + 1):
            for b in range(spread.shape[2]):
                spread[i, j, b] = 0.0
            for q in range(coupled):
                for b in range(spread.shape[2]):
                    spread[i, j, b] += half[i, q, b] * forward[j, q, b]
            for b in range(spread.shape[2]):
                spread[j, i, b] = spread[i, j, b]


@njit(**INLINE)
def _measure(
    spread: np.ndarray,
    axis: int,
    oscillating: int,
    way: np.ndarray,
    covariance: np.ndarray,
    variance: np.ndarray,
) -> None:
    """Fill ``variance`` with the variance of a sample without its error, and ``covariance`` with
    its covariances with the state: of the state's element ``axis``, plus the oscillators, the
    states from ``oscillating`` on, times ``way``."""
    for i in range(len(spread)):
        for b in range(spread.shape[2]):
            covariance[i, b] = spread[i, axis, b]
        for o in range(len(way)):
            for b in range(spread.shape[2]):
                covariance[i, b] += way[o, b] * spread[i, oscillating + 2 * o, b]
    for b in range(spread.shape[2]):
        variance[b] = covariance[axis, b]
    for o in range(len(way)):
        for b in range(spread.shape[2]):
            variance[b] += way[o, b] * covariance[oscillating + 2 * o, b]


@njit(**INLINE)
def _invert(precision: np.ndarray, variance: float, observed: np.ndarray) -> None:
    """Replace variances of samples by the inverse of those with errors; 0 where there is none."""
    for b in range(len(observed)):
        precision[b] = 1 / (precision[b] + variance) if observed[b] else 0.0


@njit(**INLINE)
def _condition(
    mean: np.ndarray,
    spread: np.ndarray,
    axis: int,
    oscillating: int,
    way: np.ndarray,
    innovation: np.ndarray,
    covariance: np.ndarray,
    precision: np.ndarray,
) -> None:
    """Replace mean and spread by those of the state after a sample, see :func:`_measure`.

    Args:
        innovation: the sample; it is replaced by its difference to the expected one.
        covariance: of the sample with the state.
        precision: see :func:`_invert`.
    """
    n, width = mean.shape[:2]
    for c in range(width):
        for b in range(spread.shape[2]):
            innovation[c, b] -= mean[axis, c, b]
        for o in range(len(way)):
            for b in range(spread.shape[2]):
                innovation[c, b] -= way[o, b] * mean[oscillating + 2 * o, c, b]
    for i in range(n):
        for c in range(width):
            for b in range(spread.shape[2]):
                mean[i, c, b] += covariance[i, b] * precision[b] * innovation[c, b]
        for j in range(n):
            for b in range(spread.shape[2]):
                spread[i, j, b] -= covariance[i, b] * covariance[j, b] * precision[b]


@njit(**INLINE)
def _write(
    white: np.ndarray, logdet: np.ndarray, innovation: np.ndarray, precision: np.ndarray
) -> None:
    """Write whitened samples, and add the logarithms of their variances to ``logdet``."""
    for b in range(len(white)):
        if precision[b] != 0:
            logdet[b] -= np.log(precision[b])
            for c in range(len(innovation)):
                white[b, c] = innovation[c, b] * np.sqrt(precision[b])
