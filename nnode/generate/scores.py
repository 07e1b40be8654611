"""Scores of sampled motion: the CRPS and the coverage of bands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nnode.calibrate.resampling import DRAWS, group_weights
from nnode.errors import ConfigError

#: Levels of the scored bands.
BANDS = (0.5, 0.95)
#: Smallest number of samples for which the outer band ends at sampled values.
LEAST = 39


def crps(samples: np.ndarray, value: np.ndarray) -> np.ndarray:
    """``(...)`` continuous ranked probability score, in the samples' unit; lower is better.

    It is the unbiased estimate of E|X - y| - E|X - X'|/2 from S samples, so its expectation does
    not depend on S. For equal samples it is the absolute error.

    Args:
        samples: ``(S, ...)``, S at least 2.
        value: ``(...)`` measured values.

    Source: Gneiting & Raftery 2007, equation (21); without bias: Ferro 2014.
    """
    number = len(samples)
    if number < 2:
        raise ConfigError(f"samples={number}: a score needs at least 2")
    ranks = np.arange(1, number + 1).reshape(-1, *[1] * value.ndim)
    # the sum of |x_i - x_j| over all pairs i < j, of sorted samples
    apart = ((2 * ranks - number - 1) * np.sort(samples, axis=0)).sum(0)
    near = np.abs(samples - value).mean(0)
    return np.asarray(near - apart / (number * (number - 1)))


def band(samples: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper end ``(...)`` of the central band of samples ``(S, ...)``.

    Its ends are the (S + 1) p-th smallest samples. It covers another sample of the distribution
    with the probability ``level``, for any continuous distribution.
    """
    ends = [(1 - level) / 2, (1 + level) / 2]
    low, high = np.quantile(samples, ends, axis=0, method="weibull")
    return low, high


@dataclass(frozen=True)
class Mean:
    """A mean over sequences with its 95 % interval by a bootstrap of clusters."""

    mean: float
    low: float | None
    high: float | None


def mean_of(total: np.ndarray, number: np.ndarray, label: np.ndarray) -> Mean:
    """The mean over all samples of several sequences.

    Args:
        total, number: ``(S,)`` sums over a sequence's samples, and their numbers.
        label: ``(S,)`` clusters; one cluster gives no interval.
    """
    mean = float(total.sum() / number.sum())
    _, label = np.unique(label, return_inverse=True)
    if label.max() < 1:
        return Mean(mean, None, None)
    weights = group_weights(label, DRAWS, np.random.default_rng(0))
    low, high = np.quantile((weights @ total) / (weights @ number), [0.025, 0.975])
    return Mean(mean, float(low), float(high))


#: Times after the start, s, for scores by horizon.
HORIZONS = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0)


def nearest(x: np.ndarray) -> np.ndarray:
    """``(K, N)`` distance to each person's nearest neighbour, m; ``(K, 0)`` for a single person.

    Args:
        x: ``(K, N, 2)`` m.
    """
    if x.shape[1] < 2:
        return np.zeros((len(x), 0))
    away = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
    away[:, range(x.shape[1]), range(x.shape[1])] = np.inf
    return np.asarray(away.min(2))


class Scores:
    """Scores of a sampled model, collected sequence by sequence.

    Args:
        dt: sampling interval, s.
    """

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self._names: list[str] = []
        self._parts: dict[str, list[tuple[float, int]]] = {}

    def add(self, name: str, samples: np.ndarray, measured: np.ndarray, error: np.ndarray) -> None:
        """Score one sequence.

        Args:
            name: name of the sequence.
            samples: ``(S, K, N, D)`` sampled positions, m. The last vehicle in a lane leads and is
                not scored. For people each component is scored separately, and the distance to the
                nearest person replaces the gap.
            measured: ``(K, N, D)`` measured positions, m.
            error: ``(S, K, N, D)`` measurement errors that are added to the samples, m.
        """
        self._names.append(name)
        observed = samples + error
        if measured.shape[2] == 1:
            observed, measured = observed[..., 0], measured[..., 0]
            observed[:, :, -1] = measured[:, -1]
            place, measured_positions = observed[:, 1:, :-1], measured[1:, :-1]
            apart = "gap"
            gap, measured_gap = np.diff(observed[:, 1:], axis=2), np.diff(measured[1:], axis=1)
        else:
            place, measured_positions = observed[:, 1:], measured[1:]
            apart = "nearest"
            gap, measured_gap = (
                np.stack([nearest(positions) for positions in place]),
                nearest(measured_positions),
            )
        scored = crps(place, measured_positions)
        self._put("crps_position_m", scored)
        self._put(f"crps_{apart}_m", crps(gap, measured_gap))
        for level in BANDS:
            for what, drawn, value in (
                ("position", place, measured_positions),
                (apart, gap, measured_gap),
            ):
                low, high = band(drawn, level)
                inside = (low <= value) & (value <= high)
                self._put(f"coverage_{what}_{100 * level:g}", inside)
                if what == "position":
                    self._at_horizons(f"coverage_{what}_{100 * level:g}", inside)
        self._at_horizons("crps_position_m", scored)

    def sequence_means(self) -> np.ndarray:
        """``(S,)`` CRPS of positions (m) by sequence, in the order of :meth:`add`."""
        return np.array([total / number for total, number in self._parts["crps_position_m"]])

    def means(self, label: np.ndarray) -> dict[str, Mean]:
        """Score to its mean over all samples; ``score@T`` is the score T s after the start.

        Args:
            label: ``(S,)`` clusters.
        """
        means = {}
        for name, parts in sorted(self._parts.items()):
            total, number = np.array(parts, float).T
            if number.sum():
                means[name] = mean_of(total[number > 0], number[number > 0], label[number > 0])
        return means

    def _at_horizons(self, name: str, values: np.ndarray) -> None:
        for horizon in HORIZONS:
            k = round(horizon / self.dt) - 1
            self._put(f"{name}@{horizon:g}s", values[k : k + 1])

    def _put(self, name: str, values: np.ndarray) -> None:
        self._parts.setdefault(name, []).append((float(values.sum()), values.size))
