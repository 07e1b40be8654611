"""Size and time of the noise, from how far vehicles and people come away from a model without it.

The residual of a vehicle, or of a component of a person's place, is its measured minus its
simulated place. Its mean square, those of its changes over several times, and of the changes of
these over the shorter ones, are compared with those of sampled motion minus the motion without
noise: the method of simulated moments (McFadden 1989). All are averages over all samples of all
clusters; intervals come from clusters drawn with replacement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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
from nnode.generate.noise import Noise, sample, sample_each, takes_drivers
from nnode.model import System

#: s; times of the noise at which motion is sampled, between which moments are interpolated.
TIMES = np.geomspace(0.25, 128.0, 8)
#: Samples per sequence of each.
SAMPLES = 2
#: Pushes of the first round, m/s and m/s²; the second one has those that the first one found.
_FIRST = {1: 0.5, 2: 0.2}
#: Spread of the drivers in the first round; and the least and largest one that is sampled.
_SPREAD, _SPREADS = 0.15, (0.05, 0.4)
_WHO = {"traffic": "followers", "crowd": "people"}
#: Draws of the clusters.
DRAWS = 200
#: Number of times over which changes are looked at, from the shortest to a third of the longest
#: sequence.
_LAGS = 8
#: s; the shortest: what people do against the pushes of others lasts half a second.
_SHORTEST = {"traffic": 1.0, "crowd": 0.25}
#: Of these the shorter ones, over which changes of changes are looked at.
_SHORT = 4


@dataclass(frozen=True)
class FittedNoise:
    """Noise with 95 % intervals.

    Attributes:
        noise: size, time and measurement error.
        sigma, tau, drivers: 95 % intervals, clusters resampled; of at least two clusters, else
            None.
        clusters: their number.
        lags: s; over them changes of the residual were compared.
        measured, modelled: m², mean squares of these changes, of changes of changes over the
            first lags, and of the residual itself.
    """

    noise: Noise
    sigma: tuple[float, float] | None
    tau: tuple[float, float] | None
    drivers: tuple[float, float] | None
    clusters: int
    lags: list[float]
    measured: list[float]
    modelled: list[float]


@dataclass
class _Sums:
    """Sums of squares and numbers of samples per cluster, ``(G, M)`` each, of M moments."""

    squares: np.ndarray
    number: np.ndarray

    def mean(self, weight: np.ndarray) -> np.ndarray:
        """``(M,)`` m², clusters weighted."""
        found: np.ndarray = weight @ self.squares / (weight @ self.number)
        return found


def fit_noise(
    system: System,
    batches: list[Batch],
    label: np.ndarray,
    *,
    seed: int = 0,
    dt: float | None = None,
    method: str | None = None,
) -> FittedNoise:
    """The noise with which sampled motion comes as far away from the model as measured motion.

    Args:
        system: of :func:`nnode.generate.noise.free`.
        batches: of sequences that the model was calibrated to.
        label: ``(S,)`` cluster of each sequence, in the order of the batches.
        seed: of what is sampled and resampled.
        dt, method: of the steps, see :func:`nnode.generate.noise.sample`.

    Raises:
        DataError: sequences too short to see changes, or no follower in them.
    """
    options: dict[str, Any] = {"dt": dt, "method": method}
    sampling, longest = batches[0].dt, max(batch.n_samples for batch in batches)
    lags = lags_of(sampling, longest, _SHORTEST[system.domain])
    _, label = np.unique(label, return_inverse=True)
    groups = np.split(label, np.cumsum([len(batch) for batch in batches])[:-1])
    plain = [sample(system, batch, Noise(0.0, 1.0), 1, seed=seed, **options).x for batch in batches]
    error = _measurement(batches)
    number = int(label.max()) + 1
    measured = _sums(
        [batch.x - x for batch, x in zip(batches, plain, strict=True)],
        batches,
        groups,
        lags,
        number,
    )
    if not (measured.number.sum(0) > 0).all():
        least = 3 * _SHORTEST[system.domain]
        raise DataError(
            f"the noise needs {_WHO[system.domain]} that are measured for more than {least:g} s"
        )

    def sampled(*noises: Noise) -> list[_Sums]:
        parts = [
            [
                found.x - x.repeat(1, SAMPLES, 1, 1)
                for found in sample_each(
                    system, batch, list(noises), SAMPLES, seed=(seed, i), **options
                )
            ]
            for i, (batch, x) in enumerate(zip(batches, plain, strict=True))
        ]
        return [
            _sums(list(each), batches, groups, lags, number) for each in zip(*parts, strict=True)
        ]

    every = np.ones(number)
    sigma, spread = _FIRST[system.order], _SPREAD if takes_drivers(system, batches[0]) else 0.0
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
        sigma, tau, drivers, modelled = search(every, starts)
        spread = float(np.clip(drivers, *_SPREADS)) if spread else 0.0
    fitted = FittedNoise(
        Noise(sigma, tau, error, drivers),
        None,
        None,
        None,
        number,
        [lag * sampling for lag in lags],
        measured.mean(every).tolist(),
        modelled.tolist(),
    )
    if number < 2:
        return fitted
    weights = number * group_weights(np.arange(number), DRAWS, np.random.default_rng(seed))
    draws = np.array([search(weight, np.array([tau]))[:3] for weight in weights])
    ends = np.quantile(draws, [0.025, 0.975], axis=0).T.tolist()
    own_sigma, own_tau, own_drivers = ((low, high) for low, high in ends)
    return replace(fitted, sigma=own_sigma, tau=own_tau, drivers=own_drivers if spread else None)


def lags_of(sampling: float, samples: int, shortest: float) -> list[int]:
    """Numbers of samples over which changes are looked at.

    Args:
        sampling: interval, s.
        samples: of the longest sequence.
        shortest: time to begin with, s.

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
    """Variance of the measurement error, m², of a component of everybody's places."""
    parts = [
        noise_variance(batch.x[batch.valid[:, b, i], b, i].numpy())
        for batch in batches
        for b, i in batch.agent.nonzero().tolist()
    ]
    known = [part for part in parts if np.isfinite(part)]
    return float(np.mean(known)) if known else 0.0


def _sums(
    residuals: list[Tensor],
    batches: list[Batch],
    groups: list[np.ndarray],
    lags: list[int],
    number: int,
) -> _Sums:
    """Squares of residuals ``(K, S * B, N, D)`` and of their changes, by cluster."""
    short = lags[:_SHORT]
    squares, count = np.zeros((2, number, len(lags) + len(short) + 1))
    for e, batch, group in zip(residuals, batches, groups, strict=True):
        copies = e.shape[1] // len(batch)
        follower = batch.valid.clone()
        if e.shape[-1] == 1:  # who leads is as measured
            follower[:, torch.arange(len(batch)), batch.agent.sum(1) - 1] = False
        valid = follower.repeat(1, copies, 1)[..., None].expand(-1, -1, -1, e.shape[-1])
        own = np.tile(group, copies)
        # of short batches nothing is left
        parts = [(e[lag:] - e[: max(len(e) - lag, 0)], valid[lag:]) for lag in lags]
        for lag in short:
            bend = e[2 * lag :] - 2 * e[lag:][: max(len(e) - 2 * lag, 0)]
            parts.append((bend + e[: len(bend)], valid[2 * lag :]))
        parts.append((e[1:], valid[1:]))
        for j, (change, real) in enumerate(parts):
            total = torch.where(real, change.square(), 0.0).sum((0, 2, 3)).numpy()
            squares[:, j] += np.bincount(own, total, number)
            count[:, j] += np.bincount(own, real.sum((0, 2, 3)).numpy(), number)
    return _Sums(squares, count)


def _white(lags: int, error: float) -> np.ndarray:
    """``(M,)`` m², what an error of measurement of variance ``error`` adds to the moments."""
    # the start is taken as measured
    return error * np.array([2.0] * lags + [6.0] * min(_SHORT, lags) + [1.0])


@dataclass
class _Search:
    """The least distance of moments, of their logarithms: none counts more than another.

    Pushes and drivers are independent, and their moments proportional to their squares.

    Attributes:
        measured: moments.
        pushes: those of pushes of size ``unit``, by time.
        drivers: those of drivers of spread ``spread``; None: all are alike.
        white: ``(M,)`` m², of the measurement.
    """

    measured: _Sums
    pushes: list[_Sums]
    drivers: _Sums | None
    unit: float
    spread: float
    white: np.ndarray

    def __call__(
        self, weight: np.ndarray, starts: np.ndarray
    ) -> tuple[float, float, float, np.ndarray]:
        """Size, time, spread, and the moments ``(M,)`` m² that they make.

        Args:
            weight: ``(G,)`` of clusters.
            starts: times, s, that the search begins from: it may have more than one valley.
        """
        goal = np.log(np.maximum(self.measured.mean(weight), 1e-12))
        pushes = np.array([sums.mean(weight) for sums in self.pushes]) / self.unit**2
        at = PchipInterpolator(np.log(TIMES), np.log(pushes))
        rise = at.derivative()
        others = 0.0 * goal
        if self.drivers is not None:
            others = self.drivers.mean(weight) / self.spread**2

        def parts(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.exp(2 * p[0] + at(p[1])), np.exp(2 * p[2]) * others

        def moments(p: np.ndarray) -> np.ndarray:
            pushed, driven = parts(p)
            return np.asarray(pushed + self.white + driven)

        def slopes(p: np.ndarray) -> np.ndarray:
            pushed, driven = parts(p)
            columns = [2 * pushed, rise(p[1]) * pushed, 2 * driven]
            return np.stack(columns, -1) / (pushed + self.white + driven)[:, None]

        low, high = np.log(TIMES[[0, -1]])
        best = None
        for start in np.clip(np.log(starts), low + 1e-6, high - 1e-6):
            size = 0.5 * float(np.mean(goal - at(start)))
            found = least_squares(
                lambda p: np.log(moments(p)) - goal,
                [size, start, np.log(0.05)],
                slopes,
                x_scale="jac",
                bounds=([-20.0, low, -20.0], [20.0, high, 0.0]),
            )
            best = found if best is None or found.cost < best.cost else best
        assert best is not None
        sigma, tau, drivers = np.exp(best.x).tolist()
        return sigma, tau, drivers if self.spread else 0.0, moments(best.x)
