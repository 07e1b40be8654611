"""The marginal likelihood of a mixed-effects model with autocorrelated disturbances.

Linearised at parameters theta, at the deviations b of each agent and at the deviations h of each
start, the samples y of a segment are

    w = y - f(theta, b, h) + Z b + H h = X (theta* - theta) + Z b* + H h* + d + eps,

where b* ~ N(0, Omega) and h* ~ N(0, S) with diagonal Omega and S, d is the response to a push e(t),
an Ornstein-Uhlenbeck process of standard deviation sigma and correlation time tau, and to the error
of the leader's path, a second one with known parameters. eps are measurement errors: white noise,
to which a third one is added where errors are autocorrelated. A Kalman filter whitens all columns
by the covariance of d + eps; b* and h* are then integrated out with products of whitened columns
(Woodbury's identity).

Source:
    Lindstrom & Bates 1990, Biometrics 46 (the linearisation at the modes);
    Overgaard et al. 2005, J. Pharmacokin. Pharmacodyn. 32 (mixed effects with a Kalman filter);
    Harville 1977, J. Am. Stat. Assoc. 72 (restricted likelihood).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numba import njit
from scipy.optimize import lsq_linear

from nnode.data.clusters import group_sums
from nnode.errors import SimulationError
from nnode.simulation.kernels.functions import INLINE, LOOP

#: Share of the largest eigenvalue of the scaled information below which a direction is flat.
FLAT = 1e-10
#: Parameters of :class:`PushNoise`: standard deviations of pushes (m/s or m/s²), of white errors of
#: positions and of autocorrelated ones (m), and correlation times (s).
NOISE = ("push", "push_time", "measurement", "lasting_error", "lasting_error_time")
#: Units of these and of the parameters of :class:`RestartNoise`, except pushes.
UNITS = {
    "push_time": "s",
    "measurement": "m",
    "lasting_error": "m",
    "lasting_error_time": "s",
    "start_speed": "m/s",
    "sway": "m",
    "sway_along": "m",
    "sway_frequency": "Hz",
    "sway_time": "s",
}
#: Restarts of simulated paths: pushes continue, or nothing is known of them.
CONTINUED, ANEW = 1, 2
#: Standard deviation of pushes of which nothing is known, m/s².
UNKNOWN = 5.0


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """Samples of S segments of D agents, linearised; K samples at most.

    Where a place has A coordinates, the K samples are those of K / A times, one coordinate after
    the other at each time. The first A states of the linear response are the coordinates.

    Attributes:
        residual: ``(S, K)`` w of the module's text.
        fixed: ``(S, K, P)`` X, by parameters.
        random: ``(Q,)`` numbers of the parameters that differ between agents; Z are their columns.
        start: ``(S, K, H)`` by the deviations of the segment's start; H may be 0.
        observed: ``(S, K)`` True where there is a sample.
        agent: ``(S,)`` number of the segment's agent, from 0.
        step: ``(S, K / A - 1, M, M)`` transition matrices of the linear response over a sampling
            interval; None: there are no pushes.
        forced: ``(S, K / A - 1, M, A + 1)`` its derivatives by the sums of the pushes along the
            coordinates at both ends, and by that of the error of the leader's path, which may be
            absent.
        leader: standard deviation and correlation time of the error of the leader's path, m and s;
            it is neglected if the former is 0.
        dt: sampling interval, s.
        restart: ``(S, K / A)`` where the simulated path restarts from a smoothed measured state:
            :data:`CONTINUED` where pushes continue, :data:`ANEW` where nothing is known of them,
            0 elsewhere; None: nowhere.
        weight: ``(S, K)`` of the whitened samples' squares; None: 1.
        heading: ``(S, K / A, A)`` unit vectors in the direction of walking, along and across which
            people sway; None: they do not sway.
    """

    residual: np.ndarray
    fixed: np.ndarray
    random: np.ndarray
    start: np.ndarray
    observed: np.ndarray
    agent: np.ndarray
    step: np.ndarray | None = None
    forced: np.ndarray | None = None
    leader: tuple[float, float] = (0.0, 1.0)
    dt: float = 1.0
    restart: np.ndarray | None = None
    weight: np.ndarray | None = None
    heading: np.ndarray | None = None

    @property
    def axes(self) -> int:
        """The number A of coordinates of a place."""
        assert self.step is not None
        return self.residual.shape[1] // (self.step.shape[1] + 1)

    @property
    def by_deviation(self) -> np.ndarray:
        """``(S, K, Q)`` Z, by the agent's deviations."""
        return self.fixed[..., self.random]

    def processes(self, push: float, push_time: float) -> list[tuple[float, float]]:
        """Standard deviation and correlation time of each process that acts, in the order of
        :attr:`forced`: of the pushes, and of the error of the leader's path if there is one."""
        pushes = [(push, push_time)] * self.axes
        return [*pushes, self.leader] if self.leader[0] > 0 else pushes

    @cached_property
    def columns(self) -> np.ndarray:
        """``(S, K, 1 + P + H)`` w, X and H; 0 where there is no sample."""
        blocks = [self.residual[..., None], self.fixed, self.start]
        return np.where(self.observed[..., None], np.concatenate(blocks, -1), 0.0)

    @cached_property
    def order(self) -> np.ndarray:
        """``(1 + P + Q + H,)`` places of w, X, Z and H in :attr:`columns`."""
        n = 1 + self.fixed.shape[-1]
        return np.concatenate([np.arange(n), 1 + self.random, np.arange(n, self.columns.shape[-1])])


@dataclass(frozen=True)
class Products:
    """Products of whitened columns, one matrix for each segment or agent.

    Attributes:
        gram: ``(S, C, C)``.
        logdet: ``(S,)`` logarithm of the covariance's determinant.
    """

    gram: np.ndarray
    logdet: np.ndarray

    def without(self, deviations: np.ndarray) -> Products:
        """The products after the last columns have been integrated out.

        Args:
            deviations: ``(Q,)`` standard deviations of the coefficients of these columns.
        """
        q = len(deviations)
        if not q:
            return self
        root, moved = self._inner(deviations)
        half = np.linalg.solve(root, moved)
        n = self.gram.shape[-1] - q
        reduced_gram = self.gram[:, :n, :n] - half.transpose(0, 2, 1) @ half
        logdet = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(1)
        return Products(reduced_gram, self.logdet + logdet)

    def posterior(self, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The distribution of the last columns' coefficients, given the sum of the other columns.

        Args:
            deviations: ``(Q,)`` their prior standard deviations.

        Returns:
            ``(S, Q, C - Q)`` derivatives of their means by the weights of the other columns in this
            sum, and ``(S, Q, Q)`` their covariance.
        """
        root, moved = self._inner(deviations)
        inverse = np.linalg.inv(root)
        scaled = deviations[:, None] * (inverse.transpose(0, 2, 1) @ inverse)
        return scaled @ moved, scaled * deviations

    def summed(self, group: np.ndarray) -> Products:
        """The products of groups of segments."""
        return Products(group_sums(self.gram, group), np.bincount(group, self.logdet))

    def _inner(self, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The Cholesky factor of 1 + D Z'Z D, and D times the products with the other columns."""
        n = self.gram.shape[-1] - len(deviations)
        inner = deviations[:, None] * self.gram[:, n:, n:] * deviations
        root = np.linalg.cholesky(np.eye(len(deviations)) + inner)
        return root, deviations[:, None] * self.gram[:, n:, :n]


class Noise(Protocol):
    """The residual covariance of a segment.

    Attributes:
        names: of its parameters; the last ones may be absent.
    """

    names: ClassVar[tuple[str, ...]]

    def products(self, data: Linearised, values: np.ndarray) -> Products:
        """Products of w, X, Z and H, whitened.

        Args:
            values: positive values of its parameters.
        """
        white, logdet = self.whitened(data, data.columns, values)
        with np.errstate(over="ignore", invalid="ignore"):  # trial parameters may blow up
            gram = white.transpose(0, 2, 1) @ white
        return Products(gram[:, data.order][:, :, data.order], logdet)

    def whitened(
        self, data: Linearised, columns: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """``(S, K, C)`` columns of independent samples of variance 1, and ``(S,)`` logarithms of
        the covariances' determinants.

        Args:
            columns: ``(S, K, C)`` of the samples. values: see :meth:`products`.
        """
        ...


@dataclass(frozen=True)
class WhiteNoise(Noise):
    """Independent errors; the parameter is their standard deviation."""

    names = ("measurement",)

    def whitened(
        self, data: Linearised, columns: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        return columns / values[0], 2 * np.log(values[0]) * data.observed.sum(1)


@dataclass(frozen=True)
class PushNoise(Noise):
    """Pushes on the highest rate (an Ornstein-Uhlenbeck process), and measurement errors.

    The parameters are those of :data:`NOISE`. The last two, of errors that are autocorrelated, may
    be absent.
    """

    names = NOISE

    def whitened(
        self, data: Linearised, columns: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        push, push_time, white, *autocorrelated = values
        lasting = (autocorrelated[0], autocorrelated[1]) if autocorrelated else (0.0, 1.0)
        return _whitened(data, columns, (push, push_time), white, lasting, np.zeros(0))


@dataclass(frozen=True)
class RestartNoise(Noise):
    """Pushes, measurement errors, sway, and errors of the states in which simulated paths restart.

    People sway across their direction once in two steps, and along it with every step: stochastic
    oscillators are added to the positions, with the autocorrelation exp(-t / T) cos(2 pi f t), and
    2 f in place of f along the direction. Simulated paths restart in states that sway.

    The parameters are the first three of :data:`NOISE`, the standard deviation of the errors of
    smoothed speeds, m/s, and the standard deviations of the sway across and along the direction, m,
    its frequency f, Hz, and the time T for which it lasts, s. The last four may be absent.

    Attributes:
        position: standard deviation of the errors of smoothed positions, m.
    """

    names = (*NOISE[:3], "start_speed", "sway", "sway_along", "sway_frequency", "sway_time")
    position: float

    def whitened(
        self, data: Linearised, columns: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        push, push_time, white, speed, *sway = values
        start = np.repeat([self.position, speed], data.axes) ** 2
        oscillation = None
        if sway:
            across, along, frequency, time = sway
            oscillation = _Oscillation(
                np.array([across, along]), 2 * np.pi * frequency * np.array([1.0, 2.0]), time
            )
        return _whitened(data, columns, (push, push_time), white, (0.0, 1.0), start, oscillation)


class _Oscillation(NamedTuple):
    """Stochastic oscillators that are added to positions.

    Attributes:
        sigma: ``(2,)`` standard deviations across and along the direction of walking, m.
        omega: ``(2,)`` angular frequencies, 1/s. time: for which they last, s.
    """

    sigma: np.ndarray
    omega: np.ndarray
    time: float


def _whitened(
    data: Linearised,
    columns: np.ndarray,
    push: tuple[float, float],
    white: float,
    lasting: tuple[float, float],
    start: np.ndarray,
    oscillation: _Oscillation | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """See :meth:`Noise.whitened`.

    Args:
        push, lasting: standard deviation and correlation time of pushes, and of autocorrelated
            errors. white: standard deviation of white errors.
        start: ``(M,)`` variances of states at restarts; without any, they are not used.
        oscillation: None: there is none.
    """
    assert data.step is not None
    assert data.forced is not None
    processes = data.processes(*push)
    sigma, time = np.array([*processes, lasting]).T
    restart, times = data.restart, data.step.shape[1] + 1
    if restart is None:
        restart = np.zeros((len(columns), times), dtype=np.int8)
    keep, omega = np.exp(-data.dt / time), np.zeros(0)
    direction = np.zeros((len(columns), times, 0, data.axes))
    if oscillation is not None:
        assert data.heading is not None
        across = data.heading[..., ::-1] * [-1.0, 1.0]
        direction, omega = np.stack([across, data.heading], 2), oscillation.omega
        sigma = np.concatenate([sigma, np.repeat(oscillation.sigma, 2)])
        keep = np.concatenate([keep, np.full(2 * len(omega), np.exp(-data.dt / oscillation.time))])
    white_columns, logdet = _filtered(
        np.ascontiguousarray(columns),
        data.observed,
        data.step,
        np.ascontiguousarray(data.forced[..., : len(processes)]),
        sigma,
        keep,
        white**2,
        restart,
        start,
        direction,
        omega,
        data.dt,
    )
    if data.weight is not None:
        white_columns = white_columns * np.sqrt(data.weight)[..., None]
    return white_columns, logdet


@njit(cache=True, nogil=True, **LOOP)
def _filtered(
    columns: np.ndarray,
    observed: np.ndarray,
    step: np.ndarray,
    forced: np.ndarray,
    sigma: np.ndarray,
    keep: np.ndarray,
    variance: float,
    restart: np.ndarray,
    start: np.ndarray,
    direction: np.ndarray,
    omega: np.ndarray,
    dt: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Columns whitened by a Kalman filter, and log determinants.

    The state is (d, e, a, q): e the J processes that force d, a the autocorrelated errors, if there
    are any, and q the O oscillators, two elements each. a is added to the first element of d, so
    that this element is measured. Without such errors, the first elements of d are measured one
    after the other, plus the first elements of the oscillators along the measured coordinate. The
    arrays of a step are allocated once, because allocations would take most of the time.

    Args:
        sigma: ``(J + 1 + 2 O,)`` standard deviations of e, a and q. keep: the same of their
            autocorrelations over a sampling interval, without the oscillation. variance: of white
            errors.
        restart: see :class:`Linearised`. start: ``(M,)`` variances of d there.
        direction: ``(S, K / A, O, A)`` unit vectors of the oscillators. omega: ``(O,)`` their
            angular frequencies, 1/s. dt: sampling interval, s.
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
    mean, before = np.empty((n, width)), np.empty((m, width))
    spread, half, gain = np.empty((n, n)), np.empty((m, n)), np.empty(n)
    forward = np.zeros((m, oscillating))
    for s in range(number):
        mean[:] = 0.0
        _begin(spread, sigma, m, processes, lasting)
        for k in range(_last(observed[s]) // axes + 1):
            if k:
                _set_transition(step[s, k - 1], forced[s, k - 1], keep, lasting, forward)
                _predict_mean(mean, forward, keep, before)
                _predict_spread(spread, forward, keep, half)
                _add_innovations(spread, forced[s, k - 1], fresh)
                if lasting:
                    _add_error(spread, m + processes, fresh[processes])
                _oscillate(mean, spread, oscillating, turn, fresh)
            if restart[s, k]:
                _restart(mean, spread, start, oscillating, restart[s, k] == ANEW)
                _restart_swaying(mean, spread, oscillating, direction[s, k], omega)
            for axis in range(axes):
                at = k * axes + axis
                if observed[s, at]:
                    logdet[s] += _condition(
                        mean,
                        spread,
                        axis,
                        oscillating,
                        direction[s, k, :, axis],
                        columns[s, at],
                        variance,
                        white[s, at],
                        gain,
                    )
    return white, logdet


@njit(**INLINE)
def _begin(spread: np.ndarray, sigma: np.ndarray, m: int, processes: int, lasting: bool) -> None:
    """The covariance of the state of :func:`_filtered` before the first sample."""
    spread[:] = 0.0
    for p in range(len(sigma)):
        spread[m + p, m + p] = sigma[p] ** 2
    if lasting:
        spread[m + processes, m + processes] = 0.0
        _add_error(spread, m + processes, sigma[processes] ** 2)


@njit(**INLINE)
def _last(observed: np.ndarray) -> int:
    """The place of the last sample; 0 if there is none."""
    last = len(observed) - 1
    while last > 0 and not observed[last]:
        last -= 1
    return last


@njit(**INLINE)
def _restart(
    mean: np.ndarray, spread: np.ndarray, start: np.ndarray, oscillating: int, anew: bool
) -> None:
    """Restart d with the variances ``start``, and forget e if nothing is known of it: by a push,
    speeds at a restart already differ from those of the law, so that e depends on them. The states
    from ``oscillating`` on continue."""
    m = len(start)
    for i in range(oscillating if anew else m):
        mean[i] = 0.0
        spread[i] = 0.0
        spread[:, i] = 0.0
        spread[i, i] = start[i] if i < m else UNKNOWN**2


@njit(**INLINE)
def _restart_swaying(
    mean: np.ndarray, spread: np.ndarray, oscillating: int, direction: np.ndarray, omega: np.ndarray
) -> None:
    """Subtract the places and speeds of the oscillators, the states from ``oscillating`` on, from
    those of d, which restarts where the measured path sways."""
    oscillators, axes = direction.shape
    for o in range(oscillators):
        for i in range(2 * axes):
            is_speed = i >= axes
            q = oscillating + 2 * o + is_speed
            share = -direction[o, i % axes] * (omega[o] if is_speed else 1.0)
            mean[i] += share * mean[q]
            # the row, and with the changed row the column, so that the matrix remains symmetric
            spread[i] += share * spread[q]
            spread[:, i] += share * spread[:, q]


@njit(**INLINE)
def _oscillate(
    mean: np.ndarray, spread: np.ndarray, oscillating: int, turn: np.ndarray, fresh: np.ndarray
) -> None:
    """Turn the oscillators, the states from ``oscillating`` on, by the angles ``turn``, and add the
    variances of their innovations, the last ones of ``fresh``."""
    for o in range(len(turn)):
        first, cosine, sine = oscillating + 2 * o, np.cos(turn[o]), np.sin(turn[o])
        _turn(mean, first, cosine, sine)
        _turn(spread, first, cosine, sine)
        _turn(spread.T, first, cosine, sine)
        for i in (first, first + 1):
            spread[i, i] += fresh[len(fresh) + i - len(spread)]


@njit(**INLINE)
def _turn(rows: np.ndarray, first: int, cosine: float, sine: float) -> None:
    """Turn a row and the next one into each other."""
    for j in range(rows.shape[1]):
        a, b = rows[first, j], rows[first + 1, j]
        rows[first, j], rows[first + 1, j] = cosine * a + sine * b, cosine * b - sine * a


@njit(**INLINE)
def _set_transition(
    step: np.ndarray, forced: np.ndarray, keep: np.ndarray, lasting: bool, forward: np.ndarray
) -> None:
    """Fill the derivatives ``forward`` ``(M, M + J)`` or ``(M, M + J + 1)`` of d after a sampling
    interval by (d, e, a) before it, see :func:`_filtered`. All elements besides d decay by
    themselves."""
    m, processes = forced.shape
    for i in range(m):
        for j in range(m):
            forward[i, j] = step[i, j]
        for p in range(processes):
            forward[i, m + p] = forced[i, p] * (1 + keep[p])
    if lasting:
        for i in range(m):
            forward[i, m + processes] = -step[i, 0]
        forward[0, m + processes] += keep[processes]


@njit(**INLINE)
def _add_error(spread: np.ndarray, place: int, variance: float) -> None:
    """Add a variance to the error, which the first state contains."""
    for i in (0, place):
        for j in (0, place):
            spread[i, j] += variance


@njit(**INLINE)
def _add_innovations(spread: np.ndarray, forced: np.ndarray, fresh: np.ndarray) -> None:
    """Add the covariance of the innovations of e, of variances ``fresh``, and of d by them."""
    m, processes = forced.shape
    for p in range(processes):
        e = m + p
        spread[e, e] += fresh[p]
        for i in range(m):
            change = forced[i, p] * fresh[p]
            spread[i, e] += change
            spread[e, i] += change
            for j in range(m):
                spread[i, j] += change * forced[j, p]


@njit(**INLINE)
def _predict_mean(
    mean: np.ndarray, forward: np.ndarray, keep: np.ndarray, before: np.ndarray
) -> None:
    """Replace the mean of the state by that of one sample later. ``before`` is a work array. Loops
    over single numbers are faster than slices here."""
    m, n = forward.shape
    width = mean.shape[1]
    for i in range(m):
        for c in range(width):
            before[i, c] = mean[i, c]
            mean[i, c] = 0.0
    for i in range(m):
        for j in range(n):
            for c in range(width):
                mean[i, c] += forward[i, j] * (before[j, c] if j < m else mean[j, c])
    for i in range(m, len(mean)):
        for c in range(width):
            mean[i, c] *= keep[i - m]


@njit(**INLINE)
def _predict_spread(
    spread: np.ndarray, forward: np.ndarray, keep: np.ndarray, half: np.ndarray
) -> None:
    """Replace the covariance of the state by that of one sample later, without innovations.
    ``half`` is a work array."""
    m, coupled = forward.shape
    n = len(spread)
    for i in range(m):
        for j in range(n):
            half[i, j] = 0.0
            for q in range(coupled):
                half[i, j] += forward[i, q] * spread[q, j]
    for i in range(m):
        for j in range(i + 1):
            total = 0.0
            for q in range(coupled):
                total += half[i, q] * forward[j, q]
            spread[i, j] = spread[j, i] = total
    for i in range(m, n):
        for j in range(m):
            spread[i, j] = spread[j, i] = keep[i - m] * half[j, i]
        for j in range(m, n):
            spread[i, j] *= keep[i - m] * keep[j - m]


@njit(**INLINE)
def _covariances(
    spread: np.ndarray, axis: int, oscillating: int, direction: np.ndarray, covariance: np.ndarray
) -> float:
    """The variance of what :func:`_condition` measures, without errors. ``covariance`` is filled
    with its covariances with the state."""
    for i in range(len(spread)):
        covariance[i] = spread[i, axis]
        for o in range(len(direction)):
            covariance[i] += direction[o] * spread[i, oscillating + 2 * o]
    total = covariance[axis]
    for o in range(len(direction)):
        total += direction[o] * covariance[oscillating + 2 * o]
    return float(total)


@njit(**INLINE)
def _condition(
    mean: np.ndarray,
    spread: np.ndarray,
    axis: int,
    oscillating: int,
    direction: np.ndarray,
    sample: np.ndarray,
    variance: float,
    white: np.ndarray,
    gain: np.ndarray,
) -> float:
    """The state after a sample of its element ``axis``, plus the oscillators, the states from
    ``oscillating`` on, times ``direction``: mean and covariance are replaced, ``white`` is filled.
    ``gain`` is a work array of as many numbers as the state has.

    Returns:
        The logarithm of the innovation's variance.
    """
    n, width = mean.shape
    total = variance + _covariances(spread, axis, oscillating, direction, gain)
    for i in range(n):
        gain[i] /= total
    for c in range(width):
        white[c] = sample[c] - mean[axis, c]
        for o in range(len(direction)):
            white[c] -= direction[o] * mean[oscillating + 2 * o, c]
    for i in range(n):
        for c in range(width):
            mean[i, c] += gain[i] * white[c]
        for j in range(n):
            spread[i, j] -= gain[i] * gain[j] * total
    scale = 1 / np.sqrt(total)
    for c in range(width):
        white[c] *= scale
    return float(np.log(total))


class Whitening:
    """Whitens columns of samples by the whole covariance: first by that of :class:`Noise`, then by
    the symmetric inverse square roots for the random effects of starts and of agents.

    Products of whitened columns are products by the inverse of the whole covariance.

    Args:
        data: linearised samples. noise: the residual covariance.
        values: of the noise's parameters.
        spread: ``(Q,)`` standard deviations of the agents' deviations.
        start: ``(H,)`` of the starts' deviations.
    """

    def __init__(
        self,
        data: Linearised,
        noise: Noise,
        values: np.ndarray,
        spread: np.ndarray,
        start: np.ndarray,
    ) -> None:
        self._data, self._noise, self._values = data, noise, values
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        segment = np.arange(len(data.agent))
        for column, deviation, group in (
            (data.start, start, segment),
            (data.by_deviation, spread, data.agent),
        ):
            if column.shape[-1]:
                self._add(self(column) * deviation, group)

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        """``(S, K, C)`` of columns ``(S, K, C)``; 0 where there is no sample."""
        observed = self._data.observed[..., None]
        white, _ = self._noise.whitened(self._data, np.where(observed, columns, 0.0), self._values)
        for column, inner, group in self._parts:
            products = group_sums(column.transpose(0, 2, 1) @ white, group)
            white = white - column @ (inner @ products)[group]
        return white

    def _add(self, column: np.ndarray, group: np.ndarray) -> None:
        """Add random effects of variance 1 with columns ``(S, K, Q)``, in groups of segments."""
        gram = group_sums(column.transpose(0, 2, 1) @ column, group)
        values, vectors = np.linalg.eigh(gram)
        # (1 + B B')^(-1/2) = 1 - B M B', M of the eigenvalues s of B'B: (1 - (1 + s)^(-1/2)) / s
        root = np.sqrt(1 + np.maximum(values, 0.0))
        share = 1 / (root * (1 + root))
        self._parts.append((column, (vectors * share[:, None]) @ vectors.transpose(0, 2, 1), group))


@dataclass(frozen=True, kw_only=True)
class Marginal:
    """The marginal likelihood of linearised samples.

    Attributes:
        loglik: log likelihood, or the restricted one if requested.
        each: ``(D,)`` the agents' terms of it, without the REML term.
        by_spread: ``(D, Q)`` derivatives of the log likelihood by the logarithms of the standard
            deviations of the agents' deviations; they are sums over agents.
        by_start: ``(D, H)`` the same of the starts' deviations.
        change: ``(P,)`` change of the parameters, by generalised least squares.
        information: ``(P, P)`` X' V^-1 X.
        agents: ``(D, 1 + P, 1 + P)`` products of w and X by V^-1, of the agents.
        deviations: ``(D, Q)`` posterior means of the agents' deviations b; variances: their
            posterior variances.
        shrinkage: ``(D, Q)`` posterior over prior variance of the agents' deviations.
        start: ``(S, H)`` posterior means of the starts' deviations.
    """

    loglik: float
    each: np.ndarray
    by_spread: np.ndarray
    by_start: np.ndarray
    change: np.ndarray
    information: np.ndarray
    agents: np.ndarray
    deviations: np.ndarray
    variances: np.ndarray
    shrinkage: np.ndarray
    start: np.ndarray

    @property
    def unchanged(self) -> float:
        """The log likelihood without the change of the parameters."""
        score = self.agents.sum(0)[1:, 0]
        rise = self.change @ score - self.change @ self.information @ self.change / 2
        return self.loglik - float(rise)


def marginal(
    data: Linearised,
    segments: Products,
    spread: np.ndarray,
    start: np.ndarray,
    *,
    low: np.ndarray | None = None,
    high: np.ndarray | None = None,
    restricted: bool = False,
) -> Marginal:
    """The marginal likelihood and the quantities derived from it.

    Args:
        data: the samples. segments: their columns' products by :class:`Noise`.
        spread: ``(Q,)`` standard deviations of the agents' deviations.
        start: ``(H,)`` of the starts' deviations.
        low, high: ``(P,)`` bounds of the change of the parameters.
        restricted: whether to use the restricted likelihood (REML).

    Raises:
        SimulationError: the linear response diverges.
    """
    if not np.isfinite(segments.gram).all():
        raise SimulationError("the linear response of the simulated paths diverges")
    agents = segments.without(start).summed(data.agent)
    without_agents = agents.without(spread)
    total = without_agents.gram.sum(0)
    information, score = total[1:, 1:], total[1:, 0]
    change = flat_solve(information, score)
    if low is not None and high is not None and ((change < low) | (change > high)).any():
        change = _bounded_solve(information, score, low, high)
    loglik, each = _log_likelihood(data, without_agents, change, restricted)
    weights = np.concatenate([[1.0], -change])
    by_weights, covariance = agents.posterior(spread)
    by_all_weights, start_covariance = segments.posterior(start)
    # means of the starts' deviations depend on w, X and the agents' deviations
    by_agents = by_all_weights[..., len(weights) :]
    by_start_weights = by_all_weights[..., : len(weights)] - by_agents @ by_weights[data.agent]
    start_covariance = start_covariance + _moved(by_agents, covariance[data.agent])
    b, h = by_weights @ weights, by_start_weights @ weights
    variances = _diagonal(covariance)
    second, start_second = b**2 + variances, h**2 + _diagonal(start_covariance)
    if restricted:  # the parameters are uncertain, too
        uncertain = np.linalg.pinv(information, rcond=FLAT, hermitian=True)
        second += _diagonal(_moved(by_weights[..., 1:], uncertain))
        start_second += _diagonal(_moved(by_start_weights[..., 1:], uncertain))
    return Marginal(
        loglik=loglik,
        each=each,
        by_spread=second / spread**2 - 1,
        by_start=group_sums(start_second / start**2 - 1, data.agent),
        change=change,
        information=information,
        agents=without_agents.gram,
        deviations=b,
        variances=variances,
        shrinkage=variances / spread**2,
        start=h,
    )


def log_likelihood(
    data: Linearised,
    segments: Products,
    spread: np.ndarray,
    start: np.ndarray,
    change: np.ndarray,
    *,
    restricted: bool = False,
) -> tuple[float, np.ndarray]:
    """The log likelihood and the agents' terms of it, for a given change of the parameters.

    Args:
        data, segments, spread, start, restricted: see :func:`marginal`.
        change: ``(P,)``.
    """
    agents = segments.without(start).summed(data.agent)
    return _log_likelihood(data, agents.without(spread), change, restricted)


def _log_likelihood(
    data: Linearised, agents: Products, change: np.ndarray, restricted: bool
) -> tuple[float, np.ndarray]:
    """See :func:`log_likelihood`; ``agents`` are products of w and X by V^-1."""
    weights = np.concatenate([[1.0], -change])
    square = np.einsum("i,dij,j->d", weights, agents.gram, weights)
    observed = np.bincount(data.agent, data.observed.sum(1), len(square))
    each = -0.5 * (agents.logdet + square + observed * np.log(2 * np.pi))
    loglik = float(each.sum())
    if restricted and len(change):
        information = agents.gram.sum(0)[1:, 1:]
        loglik += 0.5 * (len(change) * np.log(2 * np.pi) - np.linalg.slogdet(information)[1])
    return loglik, each


def _moved(derivatives: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """The covariance ``(S, Q, Q)`` of linear functions with derivatives ``(S, Q, C)``."""
    moved: np.ndarray = derivatives @ covariance @ derivatives.transpose(0, 2, 1)
    return moved


def _diagonal(matrices: np.ndarray) -> np.ndarray:
    """``(S, Q)`` diagonals of ``(S, Q, Q)``."""
    return np.diagonal(matrices, axis1=1, axis2=2)


def _bounded_solve(
    matrix: np.ndarray, vector: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The minimiser of x' A x / 2 - b' x within bounds, for a symmetric matrix A and a vector b.
    Elements with equal bounds are fixed."""
    x, free = np.where(low < high, 0.0, low), low < high
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))[free]
    values, vectors = np.linalg.eigh(matrix[np.ix_(free, free)] / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, FLAT * values.max(initial=0.0)))[:, None] * vectors.T
    aim = np.linalg.solve(root.T, (vector - matrix @ x)[free] / scale)
    x[free] = lsq_linear(root, aim, (low[free] * scale, high[free] * scale), "bvls").x / scale
    return x


def flat_solve(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """The solution of a symmetric system, 0 in its null space."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=FLAT, hermitian=True)
    solution: np.ndarray = inverse @ (vector / scale) / scale
    return solution
