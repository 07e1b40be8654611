"""Smoothed paths of people and their windows."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from nnode.data.sequence import Sequence
from nnode.diagnosis.crowds.paths import Smoother
from nnode.diagnosis.crowds.windows import Windows
from nnode.errors import DataError
from tests.builders import people


def track(x: np.ndarray, name: str = "r/0", dt: float = 0.1) -> Sequence:
    return people(x, dt, name=name)


def test_noise_is_estimated_and_smoothed() -> None:
    t = 0.1 * np.arange(60)[:, None]
    phase = np.arange(12)
    true = np.stack([1.3 * t + 0.3 * np.sin(t + phase), 0.2 * np.cos(1.5 * t + phase)], -1)
    draw = np.random.default_rng(1)
    tracks = [track(true + 0.02 * draw.normal(size=true.shape), f"r/{i}") for i in range(4)]
    smoother = Smoother(tracks)
    assert np.sqrt(smoother.variance) == pytest.approx(0.02, rel=0.05)
    path = smoother.path(tracks[0], t[:, 0])
    assert np.sqrt(((path.x - true) ** 2).mean()) < 0.01
    speed = np.gradient(true, 0.1, axis=0, edge_order=2)
    assert np.sqrt(((path.v - speed)[5:-5] ** 2).mean()) < 0.05


def test_smoothing_keeps_parabola() -> None:
    t = 0.2 * np.arange(500)  # so long that the path is smoothed in pieces
    parabola = track(np.stack([1.0 + t - 0.01 * t**2, 0.3 * t], -1)[:, None], dt=0.2)
    path = Smoother([parabola]).path(parabola, t + 0.05)
    t = t[:-1] + 0.05
    np.testing.assert_allclose(path.x[:-1, 0, 0], 1 + t - 0.01 * t**2, atol=1e-8)
    np.testing.assert_allclose(path.v[:-1, 0, 0], 1 - 0.02 * t, atol=1e-6)


GAP = np.zeros((9, 1, 2))
GAP[4] = np.nan


@pytest.mark.parametrize(
    ("prepare", "x", "message"),
    [
        (Smoother, np.zeros((3, 1, 2)), "at least 4"),
        (Smoother, GAP, "no numbers"),
        (partial(Windows, window=1.5), np.zeros((4, 2, 2)), "longer sequences"),
    ],
)
def test_unusable_sequences_are_refused(
    prepare: Callable[[list[Sequence]], object], x: np.ndarray, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        prepare([track(x)])


def test_windows_do_not_overlap() -> None:
    x = np.zeros((100, 3, 2)) + np.arange(100)[:, None, None]
    short = track(x[:4], "r/short")
    windows = Windows([track(x), short], window=1.5)
    assert windows.length == 15
    assert windows.used == [0]
    assert windows.measured.shape == (15, 6, 3, 2)
    # six windows leave ten samples over: five are left out at each end
    np.testing.assert_array_equal(windows.measured[:, :, 0, 0].T.ravel(), np.arange(5, 95))
    assert windows.batch.start.tolist() == pytest.approx([0.5 + 1.5 * w for w in range(6)])


@pytest.mark.parametrize(
    ("samples", "dt", "expected"), [(100, 0.04, (16, 1, 0.08)), (30, 0.25, (6, 2, 0.125))]
)
def test_windows_of_fast_and_slow_cameras(
    samples: int, dt: float, expected: tuple[int, int, float]
) -> None:
    windows = Windows([track(np.zeros((samples, 2, 2)), dt=dt)], 1.5)
    assert (windows.length, windows.sub, windows.step) == expected


def test_windows_are_shortened_to_use_most_samples() -> None:
    windows = Windows([track(np.zeros((29, 2, 2)))], 2.0)
    assert windows.length == 14
    assert windows.number.tolist() == [0, 1]


def test_short_sequences_are_used_beside_a_long_one() -> None:
    short = [track(np.zeros((8, 2, 2)), f"r/{i}") for i in range(10)]
    windows = Windows([*short, track(np.zeros((40, 2, 2)), "r/long")], 1.5)
    assert windows.length == 8
    assert windows.used == list(range(11))
