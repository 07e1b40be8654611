"""Size and time of the drivers' noise, from how far vehicles come away from a model without it.

The residual of a vehicle is its measured minus its simulated place. Its mean square, and the mean
squares of its changes over several times, are compared with those of sampled motion minus the
motion without noise: the method of simulated moments (McFadden 1989). Both are averages over all
samples of all clusters; intervals come from clusters drawn with replacement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares
from torch import Tensor

from nnode.data.sequence import Batch
from nnode.discover.lanes.paths import noise_variance
from nnode.errors import DataError
from nnode.generate.noise import Noise, sample
from nnode.models import Traffic
from nnode.study.statistics import group_weights

#: s; times of the noise at which motion is sampled, between which moments are interpolated.
TIMES = np.geomspace(0.25, 128.0, 8)
#: Samples per sequence of each.
SAMPLES = 2
#: Pushes of the first round, m/s and m/s²; the second one has those that the first one found.
_FIRST = {1: 0.5, 2: 0.2}
#: Draws of the clusters.
DRAWS = 200
#: Number of times over which changes are looked at, from 1 s to a third of the longest sequence.
_LAGS = 8


@dataclass(frozen=True)
class FittedNoise:
    """Noise with 95 % intervals.

    Attributes:
        noise: size, time and measurement error.
        sigma, tau: 95 % intervals, clusters resampled; of at least two clusters, else None.
        clusters: their number.
        lags: s; over them changes of the residual were compared.
        measured, modelled: ``(L + 1,)`` m² mean squares of these changes, then of the residual.
    """

    noise: Noise
    sigma: tuple[float, float] | None
    tau: tuple[float, float] | None
    clusters: int
    lags: list[float]
    measured: list[float]
    modelled: list[float]


@dataclass
class _Sums:
    """Sums of squares and numbers of samples per cluster, ``(G, L + 1)`` each."""

    squares: np.ndarray
    number: np.ndarray

    def mean(self, weight: np.ndarray) -> np.ndarray:
        """``(L + 1,)`` m², clusters weighted."""
        found: np.ndarray = weight @ self.squares / (weight @ self.number)
        return found


def fit_noise(
    system: Traffic,
    batches: list[Batch],
    label: np.ndarray,
    *,
    seed: int = 0,
    dt: float | None = None,
    method: str | None = None,
) -> FittedNoise:
    """The noise with which sampled motion comes as far away from the model as measured motion.

    Args:
        system: of :func:`nnode.generate.noise.behind_measured`.
        batches: of sequences that the model was calibrated to.
        label: ``(S,)`` cluster of each sequence, in the order of the batches.
        seed: of what is sampled and resampled.
        dt, method: of the steps, see :func:`nnode.generate.noise.sample`.

    Raises:
        DataError: sequences too short to see changes, or no follower in them.
    """
    options: dict[str, Any] = {"dt": dt, "method": method}
    sampling, longest = batches[0].dt, max(batch.n_samples for batch in batches)
    lags = lags_of(sampling, longest)
    _, label = np.unique(label, return_inverse=True)
    groups = np.split(label, np.cumsum([len(batch) for batch in batches])[:-1])
    plain = [sample(system, batch, Noise(0.0, 1.0), 1, seed=seed, **options).x for batch in batches]
    error = _measurement(batches)
    number = int(label.max()) + 1
    measured = _sums(
        [(batch.x - x)[..., 0] for batch, x in zip(batches, plain, strict=True)],
        batches, groups, lags, number,
    )  # fmt: skip
    if not (measured.number.sum(0) > 0).all():
        raise DataError("the noise needs followers that are measured for more than 3 s")
    sigma = _FIRST[system.order]
    for _ in range(2):
        table = [
            _sums(
                [
                    (sample(system, batch, Noise(sigma, tau), SAMPLES, seed=seed, **options).x
                     - x.repeat(1, SAMPLES, 1, 1))[..., 0]
                    for batch, x in zip(batches, plain, strict=True)
                ],
                batches, groups, lags, number,
            )
            for tau in TIMES
        ]  # fmt: skip
        every = np.ones(number)
        unit = sigma
        sigma, tau, modelled = _matched(measured, table, every, unit, error, TIMES[1:-1:2])
    found = Noise(sigma, tau, error)
    fitted = FittedNoise(
        found, None, None, number, [lag * sampling for lag in lags],
        measured.mean(every).tolist(), modelled.tolist(),
    )  # fmt: skip
    if number < 2:
        return fitted
    weights = number * group_weights(np.arange(number), DRAWS, np.random.default_rng(seed))
    near = np.array([tau])
    draws = np.array([_matched(measured, table, w, unit, error, near)[:2] for w in weights])
    low, high = np.quantile(draws, [0.025, 0.975], axis=0).tolist()
    return replace(fitted, sigma=(low[0], high[0]), tau=(low[1], high[1]))


def lags_of(sampling: float, samples: int) -> list[int]:
    """Numbers of samples over which changes are looked at.

    Raises:
        DataError: sequences are too short.
    """
    first, last = max(1, round(1.0 / sampling)), (samples - 1) // 3
    if last <= first:
        raise DataError(
            f"the longest sequence has {samples} samples, {sampling:g} s apart; the noise shows in "
            "sequences of more than 3 s"
        )
    return sorted({round(lag) for lag in np.geomspace(first, last, _LAGS)})


def _measurement(batches: list[Batch]) -> float:
    """Variance of the measurement error, m², of followers' and leaders' places."""
    parts = [
        noise_variance(batch.x[batch.valid[:, b, i], b, i, 0].numpy())
        for batch in batches
        for b, i in batch.agent.nonzero().tolist()
    ]
    known = [part for part in parts if np.isfinite(part)]
    return float(np.mean(known)) if known else 0.0


def _sums(
    residuals: list[Tensor], batches: list[Batch], groups: list[np.ndarray], lags: list[int],
    number: int,
) -> _Sums:  # fmt: skip
    """Squares of residuals ``(K, S * B, N)`` and of their changes, by cluster."""
    squares, count = np.zeros((2, number, len(lags) + 1))
    for e, batch, group in zip(residuals, batches, groups, strict=True):
        copies = e.shape[1] // len(batch)
        follower = batch.valid.clone()
        last = batch.agent.sum(1) - 1
        follower[:, torch.arange(len(batch)), last] = False
        valid = follower.repeat(1, copies, 1)
        own = np.tile(group, copies)
        parts = [(e[lag:] - e[:-lag], valid[lag:]) for lag in lags if lag < len(e)]
        parts = [*parts, *[(e[:0], valid[:0])] * (len(lags) - len(parts)), (e[1:], valid[1:])]
        for j, (change, real) in enumerate(parts):
            total = torch.where(real, change.square(), 0.0).sum((0, 2)).numpy()
            squares[:, j] += np.bincount(own, total, number)
            count[:, j] += np.bincount(own, real.sum((0, 2)).numpy(), number)
    return _Sums(squares, count)


def _matched(
    measured: _Sums, table: list[_Sums], weight: np.ndarray, unit: float, error: float,
    starts: np.ndarray,
) -> tuple[float, float, np.ndarray]:  # fmt: skip
    """Size, time, and the moments ``(L + 1,)`` m² that they make.

    Args:
        table: of pushes of size ``unit``, by time.
        weight: ``(G,)`` of clusters.
        starts: times, s, that the search begins from: it may have more than one valley.
    """
    goal = np.log(np.maximum(measured.mean(weight), 1e-12))
    known = np.log(np.array([sums.mean(weight) for sums in table]) / unit**2)
    at = PchipInterpolator(np.log(TIMES), known)
    # a change has the error of two measurements, but the start is taken as measured
    white = np.full(len(goal), 2 * error)
    white[-1] = error

    def moments(p: np.ndarray) -> np.ndarray:
        return np.asarray(np.exp(2 * p[0] + at(p[1])) + white)

    low, high = np.log(TIMES[[0, -1]])
    best = None
    for start in np.clip(np.log(starts), low + 1e-6, high - 1e-6):
        size = 0.5 * float(np.mean(goal - at(start)))
        found = least_squares(
            lambda p: np.log(moments(p)) - goal, [size, start], x_scale="jac",
            bounds=([-20.0, low], [20.0, high]),
        )  # fmt: skip
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    return float(np.exp(best.x[0])), float(np.exp(best.x[1])), moments(best.x)
