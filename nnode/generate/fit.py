"""Estimation of the noise by the method of simulated moments (McFadden 1989).

The residual of a vehicle, or of a component of a person's position, is the measured minus the
simulated position. The moments are the mean squares of the residual, of its changes over several
times, and of its second differences over the shorter ones. They are compared with those of sampled
motion minus the motion without noise. All are averages over the samples of all clusters, and
intervals come from a bootstrap of clusters.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares
from torch import Tensor

from nnode.calibrate.resampling import group_weights
from nnode.data.paths import noise_variance
from nnode.data.sequence import Batch
from nnode.errors import DataError
from nnode.generate.noise import Noise, allows_driver_differences, sample, sample_each
from nnode.model import System

#: Correlation times of the noise at which motion is sampled, s. Moments are interpolated between.
TIMES = np.geomspace(0.25, 128.0, 8)
#: Samples per sequence for each correlation time.
SAMPLES = 2
#: Order to the size of the noise in the first round, m/s and m/s². The second round uses the
#: estimate of the first.
_FIRST = {1: 0.5, 2: 0.2}
#: Spread of the drivers in the first round; and the smallest and largest sampled spread.
_SPREAD, _SPREADS = 0.15, (0.05, 0.4)
_WHO = {"traffic": "followers", "crowd": "people"}
#: Number of bootstrap draws of the clusters.
DRAWS = 200
#: Tolerance of their costs. Most steps of a search reduce a spread that is practically zero.
ROUGH = 1e-4
#: Number of lags, from the shortest to a third of the longest sequence.
_LAGS = 8
#: Shortest lag, s. Reactions of people to others last half a second.
_SHORTEST = {"traffic": 1.0, "crowd": 0.25}
#: Number of the shorter lags, which are also used for second differences.
_SHORT = 4


@dataclass(frozen=True)
class FittedNoise:
    """Noise with 95 % intervals.

    Attributes:
        noise: size, correlation time and measurement error.
        sigma, tau, drivers: 95 % intervals by a bootstrap of clusters, or of the estimate with the
            law; None: there is none.
        clusters: number of clusters.
        lags: lags of the compared changes of the residual, s. It and the following are empty if the
            noise was estimated with the law.
        measured, modelled: m², mean squares of these changes, of second differences over the first
            lags, and of the residual.
    """

    noise: Noise
    sigma: tuple[float, float] | None
    tau: tuple[float, float] | None
    drivers: tuple[float, float] | None
    clusters: int
    lags: list[float] = field(default_factory=list)
    measured: list[float] = field(default_factory=list)
    modelled: list[float] = field(default_factory=list)


def fit_noise(
    system: System,
    batches: list[Batch],
    label: np.ndarray,
    *,
    seed: int = 0,
    dt: float | None = None,
    method: str | None = None,
) -> FittedNoise:
    """The noise for which sampled motion deviates from the model as much as measured motion.

    Args:
        system: model of :func:`nnode.generate.noise.free_running`.
        batches: batches of sequences of the model's calibration.
        label: ``(S,)`` cluster of each sequence, in the order of the batches.
        seed: seed of samples and bootstrap.
        dt, method: steps, see :func:`nnode.generate.noise.sample`.

    Raises:
        DataError: the sequences are too short, or have no followers.
    """
    options: dict[str, Any] = {"dt": dt, "method": method}
    sampling, longest = batches[0].dt, max(batch.n_samples for batch in batches)
    lags = lags_of(sampling, longest, _SHORTEST[system.domain])
    _, label = np.unique(label, return_inverse=True)
    groups = np.split(label, np.cumsum([len(batch) for batch in batches])[:-1])
    number = int(label.max()) + 1
    without_noise = [
        sample(system, batch, Noise(0.0, 1.0), 1, seed=seed, **options).x for batch in batches
    ]

    def sums(paths: Iterable[Tensor]) -> np.ndarray:
        return _sums(paths, without_noise, batches, groups, lags, number)

    measured = sums(batch.x for batch in batches)
    if not (measured[1].sum(0) > 0).all():
        shortest = 3 * _SHORTEST[system.domain]
        raise DataError(
            f"the noise needs {_WHO[system.domain]} that are measured for more than {shortest:g} s"
        )

    def sampled(*noises: Noise) -> list[np.ndarray]:
        parts = [
            sample_each(system, batch, list(noises), SAMPLES, seed=(seed, i), **options)
            for i, batch in enumerate(batches)
        ]
        return [sums(trajectory.x for trajectory in each) for each in zip(*parts, strict=True)]

    error = _measurement(batches)
    equal_weights = np.ones(number)
    sigma = _FIRST[system.order]
    spread = _SPREAD if allows_driver_differences(system, batches[0]) else 0.0
    starts = TIMES[1:-1:2]
    for _ in range(2):
        search = _Search(
            measured,
            sampled(*(Noise(sigma, tau) for tau in TIMES)),
            sampled(Noise(0.0, 1.0, 0.0, spread))[0] if spread else None,
            sigma,
            spread,
            _white(len(lags), error),
        )
        sigma, tau, drivers, modelled = search(equal_weights, starts)
        spread = float(np.clip(drivers, *_SPREADS)) if spread else 0.0
    fitted = FittedNoise(
        Noise(sigma, tau, error, drivers),
        None,
        None,
        None,
        number,
        [lag * sampling for lag in lags],
        _mean(measured, equal_weights).tolist(),
        modelled.tolist(),
    )
    if number < 2:
        return fitted
    weights = number * group_weights(np.arange(number), DRAWS, np.random.default_rng(seed))
    draws = np.array([search(weight, np.array([tau]), ROUGH)[:3] for weight in weights])
    ends = np.quantile(draws, [0.025, 0.975], axis=0).T.tolist()
    sigma_ends, tau_ends, drivers_ends = map(tuple, ends)
    return replace(fitted, sigma=sigma_ends, tau=tau_ends, drivers=drivers_ends if spread else None)


def lags_of(sampling: float, samples: int, shortest: float) -> list[int]:
    """The lags of changes, in samples.

    Args:
        sampling: sampling interval, s.
        samples: number of samples of the longest sequence.
        shortest: shortest lag, s.

    Raises:
        DataError: sequences are too short.
    """
    first, last = max(1, round(shortest / sampling)), (samples - 1) // 3
    if last <= first:
        raise DataError(
            f"the longest sequence has {samples} samples, {sampling:g} s apart; the noise shows in "
            f"sequences of more than {3 * shortest:g} s"
        )
    return sorted({round(lag) for lag in np.geomspace(first, last, _LAGS)})


def _measurement(batches: list[Batch]) -> float:
    """Variance of the measurement error of a component of positions, m²."""
    parts = [
        noise_variance(batch.x[batch.valid[:, b, i], b, i].numpy())
        for batch in batches
        for b, i in batch.agent.nonzero().tolist()
    ]
    finite = [part for part in parts if np.isfinite(part)]
    return float(np.mean(finite)) if finite else 0.0


def _sums(
    paths: Iterable[Tensor],
    without_noise: list[Tensor],
    batches: list[Batch],
    groups: list[np.ndarray],
    lags: list[int],
    number: int,
) -> np.ndarray:
    """``(2, G, M)`` sums of squares (m²), and numbers of samples, of M moments per cluster.

    Args:
        paths: ``(K, S * B, N, D)`` measured or sampled positions of each batch.
    """
    short = lags[:_SHORT]
    sums = np.zeros((2, number, len(lags) + len(short) + 1))
    for x, mean_path, batch, group in zip(paths, without_noise, batches, groups, strict=True):
        copies = x.shape[1] // len(batch)
        e = x - mean_path.repeat(1, copies, 1, 1)
        follower = batch.valid.clone()
        if e.shape[-1] == 1:  # leaders follow their measured paths
            follower[:, torch.arange(len(batch)), batch.agent.sum(1) - 1] = False
        valid = follower.repeat(1, copies, 1)[..., None].expand(-1, -1, -1, e.shape[-1])
        cluster = np.tile(group, copies)
        # short batches give empty parts
        parts = [(e[lag:] - e[: max(len(e) - lag, 0)], valid[lag:]) for lag in lags]
        for lag in short:
            bend = e[2 * lag :] - 2 * e[lag:][: max(len(e) - 2 * lag, 0)]
            parts.append((bend + e[: len(bend)], valid[2 * lag :]))
        parts.append((e[1:], valid[1:]))
        for j, (change, real) in enumerate(parts):
            squares = torch.where(real, change.square(), 0.0)
            for total, values in zip(sums, (squares, real), strict=True):
                total[:, j] += np.bincount(cluster, values.sum((0, 2, 3)).numpy(), number)
    return sums


def _mean(sums: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """``(M,)`` moments, m², with weights of clusters."""
    squares, number = (weight @ each for each in sums)
    return np.asarray(squares / number)


def _white(lags: int, error: float) -> np.ndarray:
    """``(M,)`` moments, m², of a white measurement error with the variance ``error``."""
    # simulations start at measured positions, whose error is not added
    return error * np.array([2.0] * lags + [6.0] * min(_SHORT, lags) + [1.0])


@dataclass
class _Search:
    """Least-squares fit of the logarithms of moments.

    Noise and driver differences are independent, and their moments are proportional to their
    variances.

    Attributes:
        measured: measured moments, as :func:`_sums` returns them.
        pushes: moments of noise of size ``unit``, by correlation time.
        drivers: moments of drivers with the spread ``spread``; None if all drivers are equal.
        white: ``(M,)`` moments of the measurement error, m².
    """

    measured: np.ndarray
    pushes: list[np.ndarray]
    drivers: np.ndarray | None
    unit: float
    spread: float
    white: np.ndarray

    def __call__(
        self, weight: np.ndarray, starts: np.ndarray, tolerance: float = 1e-8
    ) -> tuple[float, float, float, np.ndarray]:
        """Size, correlation time, spread, and their moments ``(M,)``, m².

        Args:
            weight: ``(G,)`` weights of clusters.
            starts: start values of the correlation time, s, since there may be several minima.
            tolerance: the search ends when the cost decreases by less than this share.
        """
        goal = np.log(np.maximum(_mean(self.measured, weight), 1e-12))
        pushes = np.array([_mean(sums, weight) for sums in self.pushes]) / self.unit**2
        log_push = PchipInterpolator(np.log(TIMES), np.log(pushes))
        slope = log_push.derivative()
        driver_moments = 0.0 * goal
        if self.drivers is not None:
            driver_moments = _mean(self.drivers, weight) / self.spread**2

        def parts(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.exp(2 * p[0] + log_push(p[1])), np.exp(2 * p[2]) * driver_moments

        def moments(p: np.ndarray) -> np.ndarray:
            pushed, driven = parts(p)
            return np.asarray(pushed + self.white + driven)

        def slopes(p: np.ndarray) -> np.ndarray:
            pushed, driven = parts(p)
            columns = [2 * pushed, slope(p[1]) * pushed, 2 * driven]
            return np.stack(columns, -1) / (pushed + self.white + driven)[:, None]

        low, high = np.log(TIMES[[0, -1]])
        best = None
        for start in np.clip(np.log(starts), low + 1e-6, high - 1e-6):
            size = 0.5 * float(np.mean(goal - log_push(start)))
            fit = least_squares(
                lambda p: np.log(moments(p)) - goal,
                [size, start, np.log(0.05)],
                slopes,
                x_scale="jac",
                ftol=tolerance,
                bounds=([-20.0, low, -20.0], [20.0, high, 0.0]),
            )
            best = fit if best is None or fit.cost < best.cost else best
        assert best is not None
        sigma, tau, drivers = np.exp(best.x).tolist()
        return sigma, tau, drivers if self.spread else 0.0, moments(best.x)
