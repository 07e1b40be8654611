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

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from scipy.optimize import lsq_linear

from nnode.data.clusters import group_sums
from nnode.errors import SimulationError
from nnode.population.kalman import filtered

#: Share of the largest eigenvalue of the scaled information below which a direction is flat.
FLAT = 1e-10
#: Parameters of :class:`PushNoise`: standard deviations of pushes (m/s or m/s²), of white errors of
#: positions and of autocorrelated ones (m), and correlation times (s).
NOISE = ("push", "push_time", "measurement", "lasting_error", "lasting_error_time")
#: Units of these and of the parameters of :class:`RestartNoise`, except pushes, and of directions
#: that differ between agents.
UNITS = {
    "push_time": "s",
    "measurement": "m",
    "lasting_error": "m",
    "lasting_error_time": "s",
    "sway": "m",
    "sway_along": "m",
    "sway_frequency": "Hz",
    "sway_time": "s",
    "desired_direction": "rad",
}


class Process(NamedTuple):
    """An Ornstein-Uhlenbeck process that acts on a path.

    Its mean between two samples is the mean of both times ``share``, plus an independent number.

    Attributes:
        sigma: standard deviation. time: correlation time, s.
        share: 1 for a process that is linear between samples.
        rest: standard deviation of the independent number, as a share of ``sigma``.
    """

    sigma: float
    time: float
    share: float
    rest: float


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
        restart: ``(S, K / A)`` where the simulated path restarts from a smoothed measured state,
            and nothing is known of pushes; None: nowhere.
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

    def processes(self, push: float, push_time: float) -> list[Process]:
        """The processes that act, in the order of :attr:`forced`: the pushes, and the error of the
        leader's path if there is one."""
        pushes = [Process(push, push_time, *_mean_between(self.dt / push_time))] * self.axes
        return [*pushes, Process(*self.leader, 1.0, 0.0)] if self.leader[0] > 0 else pushes

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
    2 f in place of f along the direction.

    The parameters are the first three of :data:`NOISE`, and the standard deviations of the sway
    across and along the direction, m, its frequency f, Hz, and the time T for which it lasts, s.
    The last four may be absent.

    Attributes:
        position, speed: standard deviations of the states in which paths restart, m and m/s. They
            are wide, so that these states, which are smoothed from the samples, are not used twice.
    """

    names = (*NOISE[:3], "sway", "sway_along", "sway_frequency", "sway_time")
    position: float
    speed: float

    def whitened(
        self, data: Linearised, columns: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        push, push_time, white, *sway = values
        start = np.repeat([self.position, self.speed], data.axes) ** 2
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
    processes = np.array(data.processes(*push))
    sigma, time = np.concatenate([processes[:, :2], [lasting]]).T
    share, rest = processes[:, 2:].T
    restart, times = data.restart, data.step.shape[1] + 1
    if restart is None:
        restart = np.zeros((len(columns), times), dtype=bool)
    keep, omega = np.exp(-data.dt / time), np.zeros(0)
    direction = np.zeros((len(columns), times, 0, data.axes))
    if oscillation is not None:
        assert data.heading is not None
        across = data.heading[..., ::-1] * [-1.0, 1.0]
        direction, omega = np.stack([across, data.heading], 2), oscillation.omega
        sigma = np.concatenate([sigma, np.repeat(oscillation.sigma, 2)])
        keep = np.concatenate([keep, np.full(2 * len(omega), np.exp(-data.dt / oscillation.time))])
    white_columns, logdet = filtered(
        np.ascontiguousarray(columns),
        data.observed,
        data.step,
        np.ascontiguousarray(data.forced[..., : len(processes)] * share),
        sigma,
        keep,
        (2 * processes[:, 0] * rest / share) ** 2,
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


def _mean_between(step: float) -> tuple[float, float]:
    """The mean of an Ornstein-Uhlenbeck process of variance 1 over an interval, given its values at
    both ends: the derivative by the mean of these values, and the standard deviation.

    Args:
        step: length of the interval in correlation times.
    """
    share = min(math.tanh(step / 2) / (step / 2), 1.0)
    return share, math.sqrt(2 / step * (1 - share))


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
